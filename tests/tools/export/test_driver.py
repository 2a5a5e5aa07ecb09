"""An export has the surface of the run in each format, goes on after interruptions, and says what it is."""

import gzip
import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.progress import step_progress
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.errors import TaskError
from flexroad.tools.export import tile_outputs
from flexroad.tools.export.driver import check_formats, export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select
from flexroad.tools.synthetic.scenes import write_scenes
from tests.read_exports import OFFSET_M, off_surface, vertices

OPTIONS = Options(Datum("offset", str(OFFSET_M)))


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A run of two tiles of 60 m with one surface; a third tile is not computed."""
    folder = tmp_path_factory.mktemp("export")
    catalog = Catalog.read(write_scenes(folder / "survey", 3, seed=0, size_m=60))
    run = Run.create(folder / "city", load_config("production"), catalog)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile != catalog.tiles[2])
    return run.path


@pytest.fixture(scope="module")
def exported(city, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    export(select(city), out, list(FORMATS), OPTIONS, SerialExecutor())
    return out


def test_vertices_of_all_formats_lie_on_the_surface(city, exported):
    for name, points in vertices(exported).items():
        assert len(points) > 500
        error = off_surface(city, points)
        # On a slope, the error in plan is also one in height; vertices on borders may be just outside.
        assert np.nanmax(error) <= 2 * FORMATS[name].precision_m, name
        assert np.isfinite(error).mean() > 0.95


def test_step_has_a_file_per_tile(exported):
    """Its content is tested with its module."""
    assert len(list((exported / "step").glob("*.stp"))) == 2
    for file in (exported / "step").glob("*.stp"):
        assert file.read_text().startswith("ISO-10303-21;")


def test_manifest_says_what_was_written(city, exported):
    manifest = json.loads((exported / "export.json").read_text())
    assert manifest["tiles"] == 2
    assert manifest["left_out"] == [Catalog.read(city / "catalog.parquet").tiles[2].id]
    assert manifest["crs"] == "EPSG:25832"
    assert manifest["datum"] == "heights plus 47.5 m are above the ellipsoid"
    for name, written in manifest["formats"].items():
        files = [path for path in (exported / name).rglob("*") if path.is_file() and "/." not in str(path)]
        assert (written["files"], written["bytes"]) == (
            len(files),
            sum(path.stat().st_size for path in files),
        )


def test_export_again_writes_only_what_is_missing_or_of_other_options(city, tmp_path, monkeypatch):
    written = []
    write = tile_outputs._write

    def counted(job):
        written.append(job.tile.id)
        return write(job)

    monkeypatch.setattr(tile_outputs, "_write", counted)

    def again(options=OPTIONS):
        written.clear()
        export(select(city), tmp_path, ["3dtiles"], options, SerialExecutor())
        return len(written)

    # Two tiles, and a coarse mesh of both.
    assert again() == 3
    before = (tmp_path / "3dtiles" / "tileset.json").read_bytes()
    assert again() == 0
    next((tmp_path / "3dtiles" / "tiles").iterdir()).unlink()
    assert again() == 1
    next((tmp_path / "3dtiles" / ".pieces").rglob("*.json")).write_text("{")
    assert again() == 1
    assert (tmp_path / "3dtiles" / "tileset.json").read_bytes() == before
    assert again(replace(OPTIONS, datum=Datum("offset", "1"))) == 3


def test_compressed_landxml_has_the_same_content(city, exported, tmp_path):
    export(select(city), tmp_path, ["landxml"], Options(compress=True), SerialExecutor())
    (file,) = (tmp_path / "landxml").iterdir()
    assert file.name.endswith(".xml.gz")
    (plain,) = (exported / "landxml").iterdir()
    assert gzip.decompress(file.read_bytes()) == plain.read_bytes()


def test_selection_by_id_and_box(city):
    first, second, third = Catalog.read(city / "catalog.parquet").tiles
    assert select(city, ids=[second.id]).tiles == (second,)
    assert select(city, bbox=first.grid.bounds).tiles == (first,)
    with pytest.raises(ConfigError, match="has no finished tile to export; see `flexroad status"):
        select(city, ids=[third.id])


def test_error_ends_the_progress_lines(city, tmp_path, monkeypatch):
    def fail(source, tiles, folder, options, executor):
        next(iter(tiles))
        raise TaskError("no space")

    monkeypatch.setitem(FORMATS, "obj", replace(FORMATS["obj"], write=fail))
    before = threading.active_count()
    with pytest.raises(ConfigError, match="obj: no space") as raised:
        export(
            select(city),
            tmp_path,
            ["obj"],
            OPTIONS,
            SerialExecutor(),
            track=step_progress(Console(quiet=True)),
        )
    assert raised.tb  # It refers to the iterator of the tiles.
    assert threading.active_count() == before


def test_formats_that_cannot_be_written_are_refused_before_any_work():
    with pytest.raises(ConfigError, match="--format names no format; known are 3dtiles"):
        check_formats([], OPTIONS)
    with pytest.raises(ConfigError, match="--format gltf is unknown; known are 3dtiles, landxml"):
        check_formats(["landxml", "gltf"], OPTIONS)
    with pytest.raises(ConfigError, match="3dtiles needs heights above the ellipsoid .*--vertical METRES"):
        check_formats(["3dtiles"], Options())
