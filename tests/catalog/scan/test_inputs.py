"""The kind of an input is told by the endings of its files; a mixture is refused."""

from pathlib import Path

import pytest

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.scan.inputs import recognised


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    """Files of all kinds, and folders of them."""
    monkeypatch.chdir(tmp_path)
    for name in (
        "a.laz", "b.jpg", "notes.txt", "scans/a.LAS", "scans/preview.png", "site/a.obj", "site/a.mtl",
        "site/a.jpg", "two/a.glb", "two/b.ply", "flight/1.JPG", "mixed/a.laz", "mixed/a.obj", "odm/odm_dem/a",
    ):  # fmt: skip
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).touch()


@pytest.mark.parametrize(
    ("inputs", "kind", "places"),
    [
        ("a.laz scans", "points", "a.laz scans"),
        ("site", "mesh", "site/a.obj"),
        ("two/b.ply", "mesh", "two/b.ply"),
        ("flight b.jpg", "photos", "flight b.jpg"),
        ("odm", "odm", "odm"),
    ],
)
def test_recognised_inputs_of_one_kind(inputs, kind, places):
    assert recognised([*map(Path, inputs.split())]) == (kind, [*map(Path, places.split())])


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ("a.laz b.jpg", "^a.laz has point clouds, b.jpg has photographs; give inputs of one kind: "),
        ("mixed", r"^mixed has point clouds and a mesh; .* a mesh \(.obj, .ply, .glb, .gltf\), photographs"),
        ("a.laz notes.txt", "^a.laz has point clouds, notes.txt has no known input; give"),
        ("none.laz", "^none.laz does not exist; give point clouds"),
        ("two", "^two/a.glb, two/b.ply: give a mesh alone$"),
        ("odm odm/odm_dem/..", "give an ODM project alone$"),
    ],
)
def test_recognised_refuses_other_inputs(inputs, message):
    with pytest.raises(CatalogError, match=message):
        recognised([*map(Path, inputs.split())])
