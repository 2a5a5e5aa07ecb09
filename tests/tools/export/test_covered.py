import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import RoadMask
from flexroad.tools.export.step import covered

CORE = Grid("EPSG:25832", 295500.0, 5629500.0, 2.0, 5, 4)


def road(outside: np.ndarray, grid: Grid = CORE) -> RoadMask:
    return RoadMask(grid, CORE, np.zeros(grid.shape, bool), outside)


def test_covered_is_the_rectangle_around_the_covered_cells():
    outside = np.ones(CORE.shape, bool)
    outside[1:3, 2:4] = False
    outside[1, 2] = True
    assert covered(road(outside)) == ((295504.0, 5629494.0, 295508.0, 5629498.0), 4.0)


def test_covered_of_a_complete_tile_is_its_core():
    assert covered(road(np.zeros(CORE.shape, bool))) == (CORE.bounds, 0.0)


def test_covered_of_a_tile_beyond_the_survey_is_its_core():
    assert covered(road(np.ones(CORE.shape, bool))) == (CORE.bounds, 80.0)


def test_covered_counts_the_core_alone():
    """A halo of one cell is beyond the survey."""
    halo = Grid(CORE.crs, CORE.west - 2, CORE.north + 2, 2.0, 7, 6)
    outside = np.ones(halo.shape, bool)
    outside[1:-1, 1:-1] = False
    assert covered(road(outside, halo)) == (CORE.bounds, 0.0)
