"""The worst piece of road is a climbed object, not a sound deck, and has the size of the true error."""

import numpy as np
import pytest
import scipy

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import nurbs
from flexroad.tasks.quality.assess import Options, assess
from flexroad.tasks.quality.flagged import PIECE_M2, flag_names, worst_piece
from flexroad.tasks.types import RoadClusters, RoadMask, TileData

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 120, 120)
ROW, COL = np.indices(GRID.shape)
EVERY = np.ones(GRID.shape, bool)
STREET = np.abs(ROW - 60) < 10
GROUND = 150 + 0.02 * COL
NOISE = 0.03 * np.random.default_rng(2).standard_normal(GRID.shape)
AWAY = np.hypot(ROW - 60, COL - 60)
HEAPS = {
    "cone": np.clip(6 - 0.5 * AWAY, 0, None),
    "flat top": np.clip(6 - 0.5 * np.clip(AWAY - 6, 0, None), 0, None),
    "half cosine": np.where(AWAY < 12, 3 * (1 + np.cos(np.pi * np.minimum(AWAY, 12) / 12)), 0.0),
}
FIT = nurbs.Options(control_points=(40, 40), weights="unit")


class GivenHeights:
    """A surface with given heights."""

    bounds = GRID.hull

    def __init__(self, heights):
        self.heights = heights

    def lattice(self, eastings, northings):
        return self.heights


def assessed(above, road=EVERY, dtm=GROUND, exact=False):
    """Return the quality of a surface on the ground with something above it, all of which the filter kept.

    The surface is fitted to the heights, or has them exactly.
    """
    data = TileData("made", GRID, GRID, GROUND + above + NOISE, dtm)
    clusters = RoadClusters(GRID, road.astype(np.int32), None)
    mask = RoadMask(GRID, GRID, road, np.zeros(GRID.shape, bool))
    surface = GivenHeights(GROUND + above) if exact else nurbs.fit(data, clusters, FIT)
    return assess(data, mask, clusters, surface, Options())


@pytest.mark.parametrize("name", HEAPS)
def test_worst_error_of_climbed_heap_is_its_height_and_at_the_heap(name):
    heap = HEAPS[name]
    quality = assessed(heap)
    # What 25 m2 of the heap reach, of the true error: the surface is on the heap, and the road below it.
    true = np.sort(heap[heap > 0])[-int(PIECE_M2)]
    assert quality.worst_error_estimate_m == pytest.approx(true, abs=0.5)
    col, row = quality.worst_easting - GRID.west, GRID.north - quality.worst_northing
    assert np.hypot(col - 60, row - 60) < 12
    assert "worst-error" in quality.flags
    # The mean over the tile hides it.
    assert quality.error_estimate_m < 0.25
    passed = flag_names(int(np.bitwise_or.reduce(quality.flagged[60, 48:73])))
    assert "worst-error" in passed
    assert flag_names(int(np.bitwise_or.reduce(quality.flagged[90]))) == ()


def test_worst_error_of_sound_street_is_small_and_raises_no_flag():
    quality = assessed(np.zeros(GRID.shape))
    assert quality.flags == ()
    assert quality.error_estimate_m < quality.worst_error_estimate_m < 0.1
    assert not quality.flagged.any()


@pytest.mark.parametrize("grade", [0.06, 0.1])
@pytest.mark.parametrize("ramps_in_dtm", [True, False])
def test_worst_error_of_deck_on_ramps_is_small(grade, ramps_in_dtm):
    deck = np.clip(4 - grade * np.clip(np.abs(COL - 60) - 12, 0, None), 0, None)
    dtm = GROUND + np.where(ramps_in_dtm & (np.abs(COL - 60) > 18), deck, 0)
    quality = assessed(deck, STREET, dtm, exact=True)
    assert quality.worst_error_estimate_m < 0.3
    assert "worst-error" not in quality.flags


def test_worst_error_of_level_bridge_above_steep_banks_is_small():
    valley = np.interp(np.abs(COL - 60), [8, 20], [-8, 0])
    quality = assessed(np.zeros(GRID.shape), STREET, GROUND + valley, exact=True)
    assert quality.worst_error_estimate_m < 0.3
    assert not {"worst-error", "patch", "error-estimate"} & set(quality.flags)


def test_worst_error_of_steep_street_with_dtm_too_low_is_small():
    street = 0.2 * COL
    quality = assessed(street, STREET, GROUND + street - 1, exact=True)
    assert quality.worst_error_estimate_m < 0.3


def naive(estimate, road, cells):
    """Return the largest value that a connected piece of so many cells reaches, from all thresholds."""
    for value in sorted(set(estimate[road].tolist()), reverse=True):
        parts, _ = scipy.ndimage.label(road & (estimate >= value), np.ones((3, 3)))
        if np.bincount(parts[parts > 0]).max() >= cells:
            return value
    return None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("cell", [0.5, 1.0, 2.0])
def test_worst_piece_equals_search_over_all_thresholds(seed, cell):
    rng = np.random.default_rng(seed)
    grid = Grid("EPSG:25832", 0.0, 100.0, cell, 30, 24)
    road = rng.random(grid.shape) < 0.7
    estimate = scipy.ndimage.gaussian_filter(rng.random(grid.shape), 1).round(2)
    value, (easting, northing) = worst_piece(estimate, road, grid)
    largest = np.bincount(scipy.ndimage.label(road, np.ones((3, 3)))[0][road]).max()
    assert value == naive(estimate, road, min(PIECE_M2 / cell**2, largest))
    cells = grid.cells(np.array([easting]), np.array([northing]))
    assert road[cells][0]
    assert estimate[cells][0] >= value


def test_worst_piece_of_small_road_is_that_road():
    road = np.zeros(GRID.shape, bool)
    road[10:12, 10:15] = True
    estimate = np.where(road, 0.2, 9.0)
    estimate[11, 12] = 0.4
    assert worst_piece(estimate, road, GRID) == (0.2, (GRID.west + 12.5, GRID.north - 11.5))
    assert np.isnan(worst_piece(estimate, ~EVERY, GRID)[0])


def test_single_wrong_cells_are_no_worst_piece():
    values = np.full(GRID.shape, 0.05)
    values[::7, ::7] = 5.0
    assert worst_piece(values, EVERY, GRID)[0] == 0.05
