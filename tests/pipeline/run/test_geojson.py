"""Map of tile states: outlines and properties as other programs read them."""

from dataclasses import replace

import numpy as np
import pyogrio
import pytest
from pyproj import Transformer

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.run.collection import outlines, write_states
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.database import NAME, RunDatabase
from flexroad.pipeline.store.records import Failure, TileRecord


@pytest.fixture
def run(made_survey, quick_config, tmp_path) -> Run:
    """A run of four tiles: done, cached, failed and pending."""
    catalog = Catalog.read(made_survey / "catalog.parquet")
    run = Run.create(tmp_path / "run", load_config(quick_config), catalog)
    one, two, three, four = (tile.id for tile in catalog.tiles)
    states = [(one, "done"), (two, "cached"), (three, "failed"), (four, "pending")]
    rows = tuple(
        {"variant": name, "error_estimate_m": estimate, "flags": "patch" if name == "flexroad" else ""}
        for name, estimate in (("rgt", 9.0), ("flexroad", 0.25))
    )
    with RunDatabase(run.path / NAME, writable=True) as database:
        database.set_states(states)
        database.record(TileRecord(one, "done", "f", rows, finished="2026-11-21T02:00:00+00:00", seconds=1.5))
        database.record(
            TileRecord(three, "failed", "f", (), (Failure(three, "load", "TaskError", "no, file"),))
        )
        database.set_states(states)
    return run


def test_write_states_is_read_by_gdal(run, tmp_path):
    write_states(run, tmp_path / "tiles.geojson")
    table = pyogrio.read_dataframe(tmp_path / "tiles.geojson")
    assert table.crs.to_epsg() == 4326
    assert table["id"].tolist() == [tile.id for tile in run.catalog.tiles]
    assert table.state.tolist() == ["done", "cached", "failed", "pending"]
    done, _, failed, pending = table.itertuples()
    # The error estimate is that of the exported surface, not of the baselines.
    assert (done.error_estimate_m, done.flags, done.seconds) == (0.25, "patch", 1.5)
    assert done.finished.isoformat() == "2026-11-21T02:00:00+00:00"
    assert failed.error == "load: TaskError: no, file"
    assert table.loc[pending.Index, ["error", "seconds", "error_estimate_m", "finished"]].isna().all()
    crs = run.catalog.tiles[0].grid.crs
    for tile, outline in zip(run.catalog.tiles, table.to_crs(crs).geometry, strict=True):
        assert outline.bounds == pytest.approx(tile.grid.bounds, abs=0.02)
        assert outline.exterior.is_ccw


def test_outlines_of_several_crs_are_transformed(made_survey):
    one, two, *_ = Catalog.read(made_survey / "catalog.parquet").tiles
    other = replace(two, grid=replace(two.grid, crs="EPSG:32633"))
    rings = np.array([polygon.exterior.coords for polygon in outlines([one, other, one])])
    assert rings.shape == (3, 5, 2)
    assert np.array_equal(rings[0], rings[2])
    to_wgs84 = Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    west, south, east, north = other.grid.bounds
    expected = [
        to_wgs84.transform(*corner) for corner in ((east, south), (east, north), (west, north), (west, south))
    ]
    assert rings[1, :4] == pytest.approx(np.array(expected), abs=1e-7)


def test_write_states_without_tiles_is_empty(run, tmp_path):
    write_states(replace(run, catalog=Catalog(())), tmp_path / "tiles.geojson")
    assert pyogrio.read_info(tmp_path / "tiles.geojson")["features"] == 0
