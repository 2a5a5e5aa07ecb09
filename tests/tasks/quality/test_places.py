"""The place of each flag is that of the deliberate fault."""

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.quality.assess import Options, assess
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.quality.flagged import places
from flexroad.tasks.types import RoadClusters, RoadMask, TileData

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 2.0, 120, 100)
ROW, COL = np.indices(GRID.shape)
STREET = np.abs(ROW - 50) < 6
LEVEL = np.full(GRID.shape, 100.0)
NOWHERE = np.zeros(GRID.shape, bool)


class GivenHeights:
    bounds = GRID.hull

    def __init__(self, heights):
        self.heights = heights

    def lattice(self, eastings, northings):
        return self.heights


def found(surface=LEVEL, dsm=LEVEL, dtm=LEVEL, kept=STREET):
    """Return raised flags and places."""
    data = TileData("made", GRID, GRID, dsm, dtm)
    given = data, RoadMask(GRID, GRID, STREET, NOWHERE), RoadClusters(GRID, kept.astype(np.int32), None)
    options = Options()
    cells = compare(*given, GivenHeights(surface), options.dsm_dtm_tolerance_m)
    return assess(*given, GivenHeights(surface), options).flags, places(
        cells, GRID, options.dsm_dtm_tolerance_m
    )


def changed(rows, cols, metres):
    heights = LEVEL.copy()
    heights[rows, cols] += metres
    return heights


def near(place, row, col, tolerance_cells=0):
    east, north = GRID.eastings[col], GRID.northings[row]
    return place == pytest.approx((east, north), abs=GRID.cell * tolerance_cells + 1e-9)


def test_place_without_fault_is_that_of_largest_estimate():
    flags, at = found()
    assert flags == ()
    assert at.keys() == {"error-estimate", "worst-error"}


def test_spike_and_step_are_at_the_pole():
    flags, at = found(surface=changed(50, 70, 3.0))
    assert "spike" in flags
    assert near(at["spike"], 50, 70)
    assert near(at["loose"], 50, 70)


def test_edge_step_is_on_the_last_road_cell():
    _, at = found(surface=changed(44, 90, 1.0))
    assert near(at["edge-step"], 45, 90)


def test_patch_estimate_and_dtm_are_in_the_middle_of_the_raised_part():
    rows, cols = slice(45, 56), slice(20, 41)
    flags, at = found(surface=changed(rows, cols, 1.0))
    assert {"patch", "error-estimate", "off-dtm"} <= set(flags)
    for flag in ("patch", "error-estimate", "off-dtm"):
        assert near(at[flag], 50, 30, 8), flag


def test_dropped_and_inferred_are_in_the_largest_patch():
    kept = STREET & ((COL < 10) | (COL > 100)) | (STREET & (COL == 50))
    hole = changed(slice(None), slice(60, 80), np.nan)
    flags, at = found(dsm=hole, dtm=hole, kept=kept)
    assert {"dropped", "inferred"} <= set(flags)
    assert near(at["inferred"], 50, 70, 6)
    assert 50 < GRID.cells(*map(np.atleast_1d, at["dropped"]))[1][0] <= 100
