"""The place of each flag, and the worst piece of road: a climbed object, not a sound deck."""

import numpy as np
import pytest
import scipy

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import nurbs
from flexroad.tasks.quality.assess import Options, assess
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.quality.flagged import PIECE_M2, flag_names, places, worst_piece
from tests.builders import given_heights, make_clusters, make_grid, make_mask, make_tile

GRID = make_grid(120, 120)
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


def assessed(above, road=EVERY, dtm=GROUND, exact=False):
    """Return the quality of a surface on the ground with something above it, all of which the filter kept.

    The surface is fitted to the heights, or has them exactly.
    """
    data, clusters = make_tile(GROUND + above + NOISE, dtm), make_clusters(road)
    surface = given_heights(GROUND + above, GRID) if exact else nurbs.fit(data, clusters, FIT)
    return assess(data, make_mask(road), clusters, surface, Options())


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


VALLEY = np.interp(np.abs(COL - 60), [8, 20], [-8, 0])


@pytest.mark.parametrize(
    ("street", "dtm"),
    [(np.zeros(GRID.shape), GROUND + VALLEY), (0.2 * COL, GROUND + 0.2 * COL - 1)],
    ids=["level bridge above steep banks", "steep street with a DTM too low"],
)
def test_worst_error_of_street_away_from_its_dtm_is_small(street, dtm):
    quality = assessed(street, STREET, dtm, exact=True)
    assert quality.worst_error_estimate_m < 0.3
    assert not {"worst-error", "patch", "error-estimate"} & set(quality.flags)


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


def test_single_wrong_cells_are_no_worst_piece():
    values = np.full(GRID.shape, 0.05)
    values[::7, ::7] = 5.0
    assert worst_piece(values, EVERY, GRID)[0] == 0.05
    assert np.isnan(worst_piece(values, ~EVERY, GRID)[0])


PLACES = make_grid(120, 100, 2.0)
PLACE_ROW, PLACE_COL = np.indices(PLACES.shape)
ROAD = np.abs(PLACE_ROW - 50) < 6
FLAT = np.full(PLACES.shape, 100.0)


def found(surface=FLAT, dsm=FLAT, dtm=FLAT, kept=ROAD):
    """Return raised flags and places."""
    given = make_tile(dsm, dtm, 2.0), make_mask(ROAD, 2.0), make_clusters(kept, 2.0)
    inputs, options = (*given, given_heights(surface, PLACES)), Options()
    cells = compare(*inputs, options.dsm_dtm_tolerance_m)
    return assess(*inputs, options).flags, places(cells, PLACES, options.dsm_dtm_tolerance_m)


def changed(rows, cols, metres):
    heights = FLAT.copy()
    heights[rows, cols] += metres
    return heights


def near(place, row, col, tolerance_cells=0):
    east, north = PLACES.eastings[col], PLACES.northings[row]
    return place == pytest.approx((east, north), abs=PLACES.cell * tolerance_cells + 1e-9)


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
    kept = ROAD & ((PLACE_COL < 10) | (PLACE_COL > 100)) | (ROAD & (PLACE_COL == 50))
    hole = changed(slice(None), slice(60, 80), np.nan)
    flags, at = found(dsm=hole, dtm=hole, kept=kept)
    assert {"dropped", "inferred"} <= set(flags)
    assert near(at["inferred"], 50, 70, 6)
    assert 50 < PLACES.cells(*map(np.atleast_1d, at["dropped"]))[1][0] <= 100
