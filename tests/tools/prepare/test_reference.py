"""The paper's DSC3D reference: ECSRC replaces outliers of terrain and road, and nothing else."""

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.from_mesh import reference, refine

CRS = "EPSG:25832"
N = 60
GRID = Grid(CRS, 400_000.0, 5_700_060.0, 1.0, N, N)


def slope():
    """A plane that falls by 10 % to the east and 5 % to the south."""
    col, row = np.meshgrid(np.arange(N), np.arange(N))
    return 200 - 0.1 * col - 0.05 * row


def test_refine_block_on_flat_ground_is_interpolated():
    ground = np.full((N, N), 200.0) + 0.01 * np.arange(N)
    dtm = ground.copy()
    dtm[20:26, 30:36] += 3
    np.testing.assert_allclose(refine(dtm, np.isfinite(dtm), GRID, 20), ground, atol=1e-9)


def test_refine_ground_only_is_unchanged():
    dtm = slope()
    dtm[:7, :9] = np.nan
    np.testing.assert_array_equal(refine(dtm, np.isfinite(dtm), GRID, 20), dtm)


def test_refine_interpolated_slopes_do_not_connect_roof_to_ground():
    """Cells between a roof and its garden have no ground points; the interpolated slope is gentle."""
    ground = np.full((N, N), 200.0)
    dtm, is_ground = ground.copy(), np.ones((N, N), bool)
    for ring in range(12):
        dtm[14 + ring : 38 - ring, 24 + ring : 48 - ring] = 200 + min(ring, 9) / 3
    is_ground[14:38, 24:48] = False
    is_ground[23:29, 33:39] = True
    np.testing.assert_array_equal(refine(dtm, np.ones((N, N), bool), GRID, 50), dtm)
    np.testing.assert_allclose(refine(dtm, is_ground, GRID, 50), ground, atol=1e-9)


def test_refine_interpolated_voids_away_from_removed_cells_are_unchanged():
    dtm, is_ground = np.full((N, N), 200.0), np.ones((N, N), bool)
    dtm[5:9, 5:9], is_ground[5:9, 5:9] = 200.3, False
    dtm[40:44, 40:44] += 3
    refined = refine(dtm, is_ground, GRID, 20)
    assert (refined[5:9, 5:9] == 200.3).all()
    assert (refined[40:44, 40:44] == 200.0).all()


def test_refine_keeps_roof_larger_than_min_area():
    """By the paper's thresholds, 50 m2 are a cluster."""
    dtm = np.full((N, N), 200.0)
    dtm[20:28, 30:38] += 3
    np.testing.assert_array_equal(refine(dtm, np.isfinite(dtm), GRID, 20), dtm)


def test_refine_gaps_wider_than_fill_m_become_nan():
    dtm = np.full((N, N), 200.0)
    dtm[20:27, 30:37] += 3
    assert np.isnan(refine(dtm, np.isfinite(dtm), GRID, 3)[22:25, 32:35]).all()
    assert np.isfinite(refine(dtm, np.isfinite(dtm), GRID, 10)).all()


def test_reference_is_dsm_on_filtered_road_and_dtm_elsewhere():
    dtm = slope()
    dsm = dtm + 0.02
    road = np.zeros((N, N), bool)
    road[25:33] = True
    # A crown far above the road, and a fragment of the mask too far away to merge with its cluster.
    dsm[27:31, 40:45] += 8
    road[50:53, 10:13] = True
    heights, kept = reference(dsm, dtm, road, GRID)
    truth = road.copy()
    truth[27:31, 40:45] = truth[50:53, 10:13] = False
    assert np.array_equal(kept, truth)
    np.testing.assert_array_equal(heights, np.where(kept, dsm, dtm))


def test_reference_without_road_is_dtm():
    dtm = slope()
    heights, kept = reference(dtm + 1, dtm, np.zeros((N, N), bool), GRID)
    assert not kept.any()
    np.testing.assert_array_equal(heights, dtm)
