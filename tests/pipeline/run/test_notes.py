"""The notes of a tile are those of its sources, whichever results are computed and whichever are stored."""

import json
from collections import Counter

import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.products import TileProducts
from tests.builders import LIGHT

CLEANED = "dsm: 2 cells outside -500..9000 m taken as nodata"
"""The note of `load` on the survey."""
ROADLESS = "segment: the road mask has no road cell on this tile"
"""The begin of the note of `segment`."""


@pytest.fixture
def run(survey, tmp_path):
    """A finished run of one tile, with a note of each of two stages."""
    catalog = Catalog(Catalog.read(survey).tiles[:1])
    (tile,) = catalog.tiles
    for name, values in (("dsm", [[1e6, 1e6]]), ("road_mask", np.zeros(tile.grid.shape))):
        (path,) = tile.paths(tile.layer(name).reaching(tile.grid.bounds))
        with rasterio.open(path, "r+") as raster:
            array = raster.read(1)
            rows, columns = np.shape(values)
            array[:rows, :columns] = values
            raster.write(array, 1)
    made = Run.create(tmp_path / "run", compose(LIGHT, "light"), catalog)
    run_tiles(made, SerialExecutor())
    load, segment = notes(made)
    assert load == CLEANED
    assert segment.startswith(ROADLESS)
    return made


def notes(run) -> list[str]:
    item = run.folder(run.catalog.tiles[0].id).path / "item.json"
    return json.loads(item.read_text())["properties"]["flexroad:notes"]


def computed(run, force=()) -> Counter:
    results = []
    run_tiles(run, SerialExecutor(), force=frozenset(force), watch=results.append)
    (result,) = results
    assert list(result.notes) == notes(run)
    return Counter(result.computed)


@pytest.mark.parametrize(
    ("changes", "force", "stage"),
    [
        ({}, "export", "export"),
        ({"export": {"formats": ["ply"]}}, None, "export"),
        ({"ecsrc": {"theta_z_m": 0.1}}, None, "ecsrc"),
        ({"evaluate": {"nearest": True}}, None, "evaluate"),
    ],
    ids=["exported again", "another format", "another filter", "another evaluation"],
)
def test_notes_of_stored_results_are_kept(changes, force, stage, run):
    before = notes(run)
    again = Run.create(run.path, compose({**LIGHT, **changes}, "changed"), run.catalog)
    parts = computed(again, filter(None, [force]))
    assert stage in parts
    assert "segment" not in parts
    assert notes(again) == before


def test_notes_of_tile_that_failed_in_between_are_kept(run, monkeypatch):
    before = notes(run)

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(TileProducts, "finish", full)
        assert run_tiles(run, SerialExecutor(), force=frozenset({"export"})).failed == 1
    assert computed(run) == {"export": 1}
    assert notes(run) == before


def test_notes_of_shared_store_are_those_of_the_other_run(run, tmp_path):
    other = Run.create(tmp_path / "other", run.config, run.catalog, run.store)
    assert computed(other) == {"export": 1}
    assert notes(other) == notes(run)


def test_notes_of_corrected_source_are_gone(run):
    (tile,) = run.catalog.tiles
    (path,) = tile.paths(tile.layer("dsm").reaching(tile.grid.bounds))
    with rasterio.open(path, "r+") as raster:
        heights = raster.read(1)
        heights[0, :2] = heights[0, 2]
        raster.write(heights, 1)
    assert computed(run)["load"] == 1
    assert len(notes(run)) == 1
    assert notes(run)[0].startswith(ROADLESS)
