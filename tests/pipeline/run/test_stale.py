"""Products of a tile that fails stay, are marked as stale, and are part of no export, mosaic or view."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

import flexroad as library
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.cleanup import find_garbage
from flexroad.pipeline.run.collection import write_states
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.sampler import RunSampler
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import load_checked
from flexroad.tools.export.source import select
from flexroad.tools.report.content import gather
from flexroad.tools.synthetic.scenes import write_scenes
from flexroad.tools.view.driver import write_viewer
from tests.builders import copy_run, finish_run

ALL = frozenset({"load", "segment", "ecsrc", "fit", "sample", "evaluate", "assess", "export"})


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    """A finished run of two tiles, beside its survey."""
    folder = tmp_path_factory.mktemp("made")
    write_scenes(folder / "survey", 2, seed=3, size_m=60)
    return finish_run(folder / "run", folder / "survey", load_config("production"))


@pytest.fixture
def run(made, tmp_path) -> Run:
    """A copy with its own survey, which the test may change."""
    run = copy_run(made, made.path.parent / "survey", tmp_path)
    run_tiles(run, SerialExecutor())
    return run


def source(run: Run) -> Path:
    """The DSM of the first tile."""
    tile = run.catalog.tiles[0]
    return tile.paths(tile.layer("dsm").reaching(tile.grid.bounds))[0]


def products(run: Run, number: int = 0) -> dict[str, bytes]:
    folder = run.folder(run.catalog.tiles[number].id).path
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".json"}


def failed(run: Run) -> dict:
    return load_checked((run.folder(run.catalog.tiles[0].id).path / "failed.json").read_bytes())


def marked(run: Run, number: int = 0) -> tuple[str, bool]:
    """State of a tile on the map, and whether it is stale there."""
    write_states(run, run.path / "tiles.geojson")
    about = json.loads((run.path / "tiles.geojson").read_text())["features"][number]["properties"]
    return about["state"], about["stale"]


def broken(run: Run) -> Run:
    """Break a source of the first tile, and run it again."""
    source(run).write_bytes(b"no raster")
    assert run_tiles(run, SerialExecutor()).failed == 1
    return run


def test_products_of_failed_tile_stay_and_are_marked(run):
    before = products(run)
    assert len(before) > 3
    assert marked(run) == ("cached", False)
    broken(run)
    assert products(run) == before
    assert failed(run)["stale"] == sorted(before)
    assert not (run.folder(run.catalog.tiles[0].id).path / "item.json").exists()
    assert marked(run) == ("failed", True)
    # Its neighbour, which shares a border with it, was computed again.
    assert marked(run, 1) == ("done", False)
    # A further failure does not forget them, nor does a lost database.
    source(run).write_bytes(b"no raster either")
    run_tiles(run, SerialExecutor())
    (run.path / "database.txt").unlink()
    run_tiles(run, SerialExecutor(), only=lambda tile: False)
    assert (failed(run)["stale"], marked(run)) == (sorted(before), ("failed", True))
    assert not [file for file in find_garbage([run]) if file.kind == "products"]


def test_stale_products_are_used_by_nothing(run, tmp_path):
    write_viewer(run, tmp_path / "viewer", SerialExecutor())
    tile, other = run.catalog.tiles
    x, y = (tile.grid.west + tile.grid.east) / 2, (tile.grid.south + tile.grid.north) / 2
    assert library.open_run(run.path).height(x, y) > 0
    broken(run)
    text = (run.path / "collection.json").read_text()
    assert f"tiles/{other.id}/" in text
    assert f"tiles/{tile.id}/" not in text
    for name in ("height.vrt", "road.vrt", "height_source.vrt"):
        text = (run.path / name).read_text()
        assert (tile.id in text, other.id in text) == (False, True), name
    chosen = select(run.path)
    assert ([one.id for one in chosen.tiles], chosen.left_out) == ([other.id], (tile.id,))
    view = library.open_run(run.path)
    assert np.isnan(view.height(x, y))
    height = view.to_xarray().height.sel(x=slice(tile.grid.west, tile.grid.east))
    assert height.isnull().all() or not np.isfinite(height.sel(x=x, y=y, method="nearest"))
    # `query` answers from the last finished state of a tile only if it has not failed since.
    assert RunSampler.open(run.path, earlier=True).at([x], [y]).tile.tolist() == [""]
    assert gather(run).tiles == (other.id,)
    write_viewer(run, tmp_path / "viewer", SerialExecutor())
    index = (tmp_path / "viewer" / "run.js").read_text()
    columns = json.loads(index[index.index("(") + 1 : index.rindex(")")])["tiles"]
    assert dict(zip(columns["id"], columns["stale"], strict=True)) == {tile.id: True, other.id: False}
    assert [path.name for path in (tmp_path / "viewer" / "tiles").glob("*.js")] == [f"{other.id}.js"]


def test_tile_that_is_done_again_has_no_stale_products(run):
    whole, before = source(run).read_bytes(), products(run)
    broken(run)
    source(run).write_bytes(whole)
    assert marked(run) == ("failed", True)
    run_tiles(run, SerialExecutor())
    assert marked(run) == ("done", False)
    assert products(run) == before
    assert not (run.folder(run.catalog.tiles[0].id).path / "failed.json").exists()


def test_products_that_were_half_written_are_stale(run, monkeypatch):
    """The item was removed, some products are new and some are old."""
    names = sorted(products(run))
    (run.folder(run.catalog.tiles[0].id).path / "of another program.txt").write_text("mine")
    mark = TileProducts._mark

    def full(self, name, *rest):
        if name == "item.json":
            raise OSError(28, "No space left on device")
        mark(self, name, *rest)

    monkeypatch.setattr(TileProducts, "_mark", full)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile == run.catalog.tiles[0], force=ALL)
    assert failed(run)["stale"] == names
    assert marked(run) == ("failed", True)


def test_failed_tile_without_products_is_not_stale(run):
    shutil.rmtree(run.folder(run.catalog.tiles[0].id).path)
    broken(run)
    assert failed(run)["stale"] == []
    assert marked(run) == ("failed", False)


def test_products_of_pending_tile_are_stale(run):
    os.utime(source(run), ns=(1, 1))
    run_tiles(run, SerialExecutor(), only=lambda tile: False)
    assert marked(run) == ("pending", True)
