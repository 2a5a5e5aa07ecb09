"""The kind of an input is told by the endings of its files; a mixture is refused."""

import pytest

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.scan.inputs import recognised


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Files of all kinds, and folders of them."""
    monkeypatch.chdir(tmp_path)
    names = (
        "a.laz", "b.jpg", "notes.txt", "scans/a.LAS", "scans/preview.png", "site/a.obj", "site/a.mtl",
        "site/a.jpg", "two/a.glb", "two/b.ply", "flight/1.JPG", "mixed/a.laz", "mixed/a.obj",
    )  # fmt: skip
    for path in map(tmp_path.joinpath, names):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (tmp_path / "project" / "odm_dem").mkdir(parents=True)
    return tmp_path


@pytest.mark.parametrize(
    ("inputs", "kind", "places"),
    [
        ("a.laz scans", "points", "a.laz scans"),
        ("site", "mesh", "site/a.obj"),
        ("two/b.ply", "mesh", "two/b.ply"),
        ("flight b.jpg", "photos", "flight b.jpg"),
        ("project", "odm", "project"),
    ],
)
def test_recognised_inputs_of_one_kind(inputs, kind, places, files):
    found = recognised([type(files)(name) for name in inputs.split()])
    assert found == (kind, [type(files)(name) for name in places.split()])


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        (
            "a.laz b.jpg",
            "^a.laz has point clouds, b.jpg has photographs; give inputs of one kind: ",
        ),
        ("mixed", r"^mixed has point clouds and a mesh; .* a mesh \(.obj, .ply, .glb, .gltf\), photographs"),
        ("a.laz notes.txt", "^a.laz has point clouds, notes.txt has no known input; give"),
        ("none.laz", "^none.laz does not exist; give point clouds"),
        ("two", "^two/a.glb, two/b.ply: give a mesh alone$"),
        ("project project/odm_dem/..", "give an OpenDroneMap project alone$"),
    ],
)
def test_recognised_refuses_other_inputs_in_one_line(inputs, message, files):
    with pytest.raises(CatalogError, match=message) as caught:
        recognised([type(files)(name) for name in inputs.split()])
    assert "\n" not in str(caught.value)
