"""Formats without a mesh where the survey ends on a tile: no heights of ground that nobody measured."""

import json

import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.export.driver import export
from flexroad.tools.export.source import Options, select
from flexroad.tools.synthetic.scenes import write_scenes
from tests.tools.export.test_step import read_surface

COLUMNS, ROWS, SIZE_M = 40, 45, 60
"""Cells with data of the eastern tile: the western columns, without the rows in the north."""
MISSING = SIZE_M - ROWS


def ground(easting, west):
    """A slope of 10% to the east."""
    return 125 + 0.1 * (easting - west)


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """A run of two tiles of 60 m; of the eastern one, 40 m x 45 m in the south-west have data."""
    folder = tmp_path_factory.mktemp("survey_end")
    catalog = Catalog.read(write_scenes(folder / "survey", 2, seed=3, size_m=SIZE_M))
    west = min(tile.grid.west for tile in catalog.tiles)
    for tile in catalog.tiles:
        plane = np.tile(ground(tile.grid.eastings, west), (SIZE_M, 1)).astype(np.float32)
        if tile.grid.west > west:
            plane[:MISSING] = plane[:, COLUMNS:] = np.nan
        for layer in ("dsm", "dtm"):
            with rasterio.open(folder / "survey" / layer / f"{tile.id}.tif", "r+") as raster:
                raster.nodata = np.nan
                raster.write(plane, 1)
    run = Run.create(folder / "run", load_config("production"), catalog)
    assert run_tiles(run, SerialExecutor()).done == 2
    return run.path


@pytest.fixture(scope="module")
def exported(survey, tmp_path_factory):
    out = tmp_path_factory.mktemp("exported")
    formats = ["step", "obj"]
    return out, export(select(survey), out, formats, Options(), SerialExecutor())["formats"]


@pytest.fixture(scope="module")
def tiles(survey):
    """The western tile and the eastern one."""
    return sorted((tile.tile for tile in select(survey).finished()), key=lambda tile: tile.grid.west)


def test_step_ends_with_the_survey_and_tiles_lie_side_by_side(exported, survey, tiles):
    """The eastern tile begins where the western one ends, as all have one origin."""
    out, manifest = exported
    origin = Run.open(survey).origin
    ends = []
    for tile in tiles:
        place = json.loads((out / "step" / f"{tile.id}_stp.json").read_text())
        assert (place["origin"], place["beyond_survey_m2"]) == ([*origin, 0.0], 0.0)
        surface = read_surface((out / "step" / f"{tile.id}.stp").read_text())
        low, high = (np.array(surface.evaluate_single(corner)) for corner in ((0, 0), (1, 1)))
        np.testing.assert_allclose([*(low[:2] + origin), *(high[:2] + origin)], place["bounds"], atol=1e-6)
        heights = ground(np.array([low[0], high[0]]) + origin[0], tiles[0].grid.west)
        np.testing.assert_allclose([low[2], high[2]], heights, rtol=0, atol=2e-3)
        ends.append((low, high))
    (_, (across, _, _)), (low, high) = ends
    assert low[0] == pytest.approx(across, abs=1e-9)
    np.testing.assert_allclose((high - low)[:2], (COLUMNS, ROWS), rtol=0, atol=1e-6)
    note = "1 tile: surface cut to the rectangle that the survey covers"
    assert manifest["step"]["notes"] == [note]


def test_obj_of_all_tiles_has_one_origin(exported, survey, tiles):
    out, _ = exported
    origin = Run.open(survey).origin
    for tile in tiles:
        assert json.loads((out / "obj" / f"{tile.id}.json").read_text())["origin"] == [*origin, 0.0]
        lines = (out / "obj" / f"{tile.id}.obj").read_text().splitlines()
        x, y, z = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float).T
        assert x.min() == pytest.approx(tile.grid.west - origin[0], abs=1e-4)
        assert y.min() == pytest.approx(tile.grid.south - origin[1], abs=1e-4)
        np.testing.assert_allclose(z, ground(x + origin[0], tiles[0].grid.west), rtol=0, atol=2e-3)
