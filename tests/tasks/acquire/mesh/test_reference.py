"""The paper's DSC3D reference: what ECSRC takes out of terrain and road; the rest it leaves alone."""

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.mesh.reference import reference, refine

CRS = "EPSG:25832"
N = 60
GRID = Grid(CRS, 400_000.0, 5_700_060.0, 1.0, N, N)


def slope():
    """A plane that falls by 10 % east and 5 % south."""
    col, row = np.meshgrid(np.arange(N), np.arange(N))
    return 200 - 0.1 * col - 0.05 * row


def test_a_block_on_flat_ground_is_replaced_by_the_ground_around():
    ground = np.full((N, N), 200.0) + 0.01 * np.arange(N)
    dtm = ground.copy()
    dtm[20:26, 30:36] += 3
    np.testing.assert_allclose(refine(dtm, np.isfinite(dtm), GRID, 20), ground, atol=1e-9)


def test_ground_alone_stays_as_it_is():
    dtm = slope()
    dtm[:7, :9] = np.nan
    np.testing.assert_array_equal(refine(dtm, np.isfinite(dtm), GRID, 20), dtm)


def test_inferred_slopes_do_not_tie_a_roof_to_the_ground():
    """Between a roof and its garden no ground was found; what was inferred there falls gently."""
    ground = np.full((N, N), 200.0)
    dtm, found = ground.copy(), np.ones((N, N), bool)
    for ring in range(12):
        dtm[14 + ring : 38 - ring, 24 + ring : 48 - ring] = 200 + min(ring, 9) / 3
    found[14:38, 24:48] = False
    found[23:29, 33:39] = True
    np.testing.assert_array_equal(refine(dtm, np.ones((N, N), bool), GRID, 50), dtm)
    np.testing.assert_allclose(refine(dtm, found, GRID, 50), ground, atol=1e-9)


def test_bridged_voids_away_from_what_was_dropped_stay_as_they_are():
    dtm, found = np.full((N, N), 200.0), np.ones((N, N), bool)
    dtm[5:9, 5:9], found[5:9, 5:9] = 200.3, False
    dtm[40:44, 40:44] += 3
    refined = refine(dtm, found, GRID, 20)
    assert (refined[5:9, 5:9] == 200.3).all()
    assert (refined[40:44, 40:44] == 200.0).all()


def test_a_roof_large_enough_for_ground_stays():
    """The thresholds are the paper's: what has 50 m2 counts as a cluster of its own."""
    dtm = np.full((N, N), 200.0)
    dtm[20:28, 30:38] += 3
    np.testing.assert_array_equal(refine(dtm, np.isfinite(dtm), GRID, 20), dtm)


def test_gaps_wider_than_asked_become_unknown():
    dtm = np.full((N, N), 200.0)
    dtm[20:27, 30:37] += 3
    assert np.isnan(refine(dtm, np.isfinite(dtm), GRID, 3)[22:25, 32:35]).all()
    assert np.isfinite(refine(dtm, np.isfinite(dtm), GRID, 10)).all()


def test_the_reference_is_the_surface_on_the_filtered_road_and_the_terrain_elsewhere():
    dtm = slope()
    dsm = dtm + 0.02
    road = np.zeros((N, N), bool)
    road[25:33] = True
    # A crown far above the road, and a shred of mask farther from it than clusters merge.
    dsm[27:31, 40:45] += 8
    road[50:53, 10:13] = True
    heights, kept = reference(dsm, dtm, road, GRID)
    truth = road.copy()
    truth[27:31, 40:45] = truth[50:53, 10:13] = False
    assert np.array_equal(kept, truth)
    np.testing.assert_array_equal(heights, np.where(kept, dsm, dtm))


def test_no_road_is_a_reference_of_terrain():
    dtm = slope()
    heights, kept = reference(dtm + 1, dtm, np.zeros((N, N), bool), GRID)
    assert not kept.any()
    np.testing.assert_array_equal(heights, dtm)
