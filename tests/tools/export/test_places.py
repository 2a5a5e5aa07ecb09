"""Exports of tiles with odd ids, and exports into object storage."""

import json
import shutil
from dataclasses import replace

import pytest
import trimesh

from flexroad.catalog import Catalog
from flexroad.catalog.storage.paths import read
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.export.driver import BEGUN, export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.source import Options, select

from .conftest import CONFIG, OPTIONS, contents

IDS = ["a/b c", "../up", "Straße 1", "道路#?&=%20"]


@pytest.fixture(scope="module")
def odd_city(made_city, tmp_path_factory):
    """A run of two tiles whose ids are no file names."""
    folder = tmp_path_factory.mktemp("odd")
    shutil.copytree(made_city.survey, folder / "survey")
    catalog = Catalog.read(folder / "survey" / "catalog.parquet")
    named = tuple(replace(tile, id=name) for tile, name in zip(catalog.tiles, IDS, strict=True))
    run = Run.create(folder / "odd", compose(CONFIG, "small"), Catalog(named))
    assert run_tiles(run, SerialExecutor()).done == 3
    return run.path


@pytest.mark.parametrize("name", FORMATS)
def test_tiles_with_odd_ids(odd_city, tmp_path, name):
    out = tmp_path / "deep" / "out"
    chosen = replace(OPTIONS, drape=True)
    first = export(select(odd_city), out, [name], chosen, SerialExecutor())
    written = contents(out)
    assert written
    assert first["formats"][name]["files"] == len(written)
    # Nothing lies outside of the folder of the format.
    assert {path.name for path in (tmp_path / "deep").iterdir()} == {"out"}
    assert {path.split("/")[0] for path in written} == {name}
    assert export(select(odd_city), out, [name], chosen, SerialExecutor()) == first
    assert contents(out) == written


def test_obj_of_tile_with_odd_id_names_its_files(odd_city, tmp_path):
    export(select(odd_city), tmp_path, ["obj"], Options(drape=True), SerialExecutor())
    for file in (tmp_path / "obj").glob("*.obj"):
        for part in trimesh.load_scene(file, process=False).geometry.values():
            assert part.visual.material.image is not None


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_export_into_a_bucket_is_as_on_disk(made_city, whole, bucket, name):
    for _ in range(2):
        manifest = export(select(made_city.path), bucket / "out", [name], OPTIONS, SerialExecutor())
        for path, data in contents(whole / name).items():
            assert read(bucket / "out" / name / path) == data
    assert manifest["formats"][name] == json.loads((whole / "export.json").read_text())["formats"][name]
    assert manifest == json.loads(read(bucket / "out" / "export.json"))


@pytest.mark.slow
def test_command_writes_into_a_bucket(made_city, bucket, flexroad):
    said = flexroad("export", made_city.path, "--format", "landxml", "-o", bucket / "out").expected(0)
    assert f"landxml: 1 file, 0.1 MB in {bucket}/out/landxml" in said.out.splitlines()
    left = bucket.fs.find(bucket.path)
    assert {path.rpartition("/area/")[2] for path in left} == {
        "out/export.json",
        f"out/{BEGUN}",
        "out/.landxml.json",
        "out/landxml/city.xml",
    }
