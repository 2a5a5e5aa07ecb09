from itertools import combinations

import numpy as np
import pytest
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.points.binning import bins, means
from flexroad.tools.prepare.points.tin import (
    _acting,
    fill_voids,
    tin,
    tin_reach_m,
    triangulated,
    voids_reach_m,
)

CELL = 0.5
GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 60, 50)


def grid(cols, rows, west=295500.0, north=5629500.0):
    return Grid("EPSG:25832", west, north, CELL, cols, rows)


def nodes_of(where: Grid, position, height):
    """One node per cell; its position, (H, W, 2), is in cells from the north-west corner of the cell."""
    row, col = np.indices(where.shape)
    return (col + position[..., 0]) * CELL, -(row + position[..., 1]) * CELL, height


def reference_tin(east, north, height, where: Grid, widest_m):
    """The definition: all triangles whose circumcircle has no other node inside and is not too wide."""
    out = np.full(where.shape, np.nan)
    valid = np.isfinite(height)
    nodes = np.column_stack([east[valid], north[valid], height[valid]])
    for three in combinations(range(len(nodes)), 3):
        plan = nodes[list(three), :2]
        double = np.column_stack([2 * (plan[1:] - plan[0]), (plan[1:] ** 2).sum(1) - (plan[0] ** 2).sum()])
        centre = np.linalg.solve(double[:, :2], double[:, 2])
        radius = np.hypot(*(plan[0] - centre))
        others = np.delete(nodes[:, :2], three, axis=0)
        if 2 * radius > widest_m or (np.hypot(*(others - centre).T) < radius).any():
            continue
        for i, y in enumerate(where.northings - where.north):
            for j, x in enumerate(where.eastings - where.west):
                part = np.linalg.solve(np.vstack([plan.T, np.ones(3)]), [x, y, 1])
                if (part >= 0).all():
                    out[i, j] = part @ nodes[list(three), 2]
    return out


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("widest_m", [1.5, 2.5, 100])
def test_tin_matches_definition(seed, widest_m):
    rng = np.random.default_rng(seed)
    where = grid(7, 6)
    height = np.where(rng.random(where.shape) < 0.5, rng.uniform(100, 110, where.shape), np.nan)
    nodes = nodes_of(where, rng.random((*where.shape, 2)), height)
    expected = reference_tin(*nodes, where, widest_m)
    assert np.isfinite(expected).any()
    np.testing.assert_allclose(tin(*nodes, where, widest_m), expected, atol=1e-9)


def test_tin_plane_is_exact_for_nodes_anywhere_in_their_cells():
    where = grid(30, 20)
    rng = np.random.default_rng(0)
    east, north, _ = nodes_of(where, rng.random((*where.shape, 2)), None)
    result = tin(east, north, 100 + 0.3 * east - 0.2 * north, where, 3 * CELL)
    x, y = where.eastings - where.west, (where.northings - where.north)[:, None]
    inside = result[2:-2, 2:-2]
    np.testing.assert_allclose(inside, (100 + 0.3 * x - 0.2 * y)[2:-2, 2:-2], atol=1e-9)


@pytest.mark.parametrize("spread", [0.0, 1e-6, 1.0])
def test_tin_of_a_block_equals_that_of_all_nodes(spread):
    """Nodes farther than the widest circle have no effect, although lattice squares are cocircular."""
    rng = np.random.default_rng(1)
    whole = grid(60, 50, west=295500.25, north=5629500.25)
    # Nodes at the cell centres; so near them that centres are almost on edges; anywhere.
    position = 0.5 + spread * (rng.random((*whole.shape, 2)) - 0.5)
    height = np.where(rng.random(whole.shape) < 0.2, rng.uniform(100, 110, whole.shape), np.nan)
    widest = 5 * CELL
    nodes = nodes_of(whole, position, height)
    expected = tin(*nodes, whole, widest)
    assert 0.05 < np.isnan(expected).mean() < 0.95
    for row, col in ((11, 7), (23, 30), (36, 41)):
        core = slice(row, row + 9), slice(col, col + 8)
        rim = slice(row - 5, row + 14), slice(col - 5, col + 13)
        part = grid(18, 19, whole.west + (col - 5) * CELL, whole.north - (row - 5) * CELL)
        part_nodes = nodes_of(part, position[rim], height[rim])
        result = tin(*part_nodes, part, widest)[5:-5, 5:-5]
        np.testing.assert_allclose(result, expected[core], rtol=0, atol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("seed", range(3))
def test_tin_of_inner_cells_is_the_same_without_nodes_that_cannot_act(seed, share):
    """Voids of all sizes, some of which lead from the inner cells to the border."""
    rng = np.random.default_rng(seed)
    where = grid(90, 80)
    rough = ndimage.gaussian_filter(rng.random(where.shape), 3)
    is_node = (rough > np.quantile(rough, share)) & (rng.random(where.shape) < 0.95)
    height = np.where(is_node, rng.uniform(100, 110, where.shape), np.nan)
    nodes = nodes_of(where, rng.random((*where.shape, 2)), height)
    inner = slice(30, 50), slice(32, 58)
    expected = tin(*nodes, where, 25 * CELL)
    np.testing.assert_array_equal(tin(*nodes, where, 25 * CELL, inner)[inner], expected[inner])
    kept = (_acting(is_node, inner) & is_node).sum() / is_node.sum()
    assert kept < 0.3 or share > 0


@pytest.mark.parametrize(
    "cells", [[], [(3, 3)], [(3, 3), (4, 4)], [(2, 1), (2, 3), (2, 4)], [(1, 1), (2, 2), (5, 5)]]
)
def test_tin_too_few_or_collinear_nodes_give_nan(cells):
    where = grid(8, 8)
    height = np.full(where.shape, np.nan)
    for cell in cells:
        height[cell] = 100
    nodes = nodes_of(where, np.full((8, 8, 2), 0.5), height)
    assert np.isnan(tin(*nodes, where, 100)).all()


def plane(easting, northing):
    return 150 + 0.1 * (easting - GRID.west) - 0.25 * (northing - GRID.north)


TRUTH = plane(GRID.eastings, GRID.northings[:, None])


def scattered(rng, n=6000, lopsided=1.0):
    """Points of the plane; with ``lopsided`` above 1 most are in the north-west of their cells."""
    cell = rng.integers(0, [GRID.width, GRID.height], (n, 2))
    position = rng.random((n, 2)) ** lopsided
    easting, northing = GRID.west + cell[:, 0] + position[:, 0], GRID.north - cell[:, 1] - position[:, 1]
    return easting, northing, plane(easting, northing)


def dtm_of(easting, northing, height, void_m=50.0):
    cells = bins(easting, northing, GRID)
    centroids = means(cells, GRID.shape, easting - GRID.west, northing - GRID.north, height)
    return triangulated(np.stack(centroids), GRID, void_m)


def test_triangulated_plane_is_exact_for_any_sampling():
    points = scattered(np.random.default_rng(0), lopsided=3)
    inside = slice(2, -2), slice(2, -2)
    np.testing.assert_allclose(dtm_of(*points)[inside], TRUTH[inside], atol=1e-8)
    (mean,) = means(bins(points[0], points[1], GRID), GRID.shape, points[2])
    difference = fill_voids(mean, GRID, 50) - TRUTH
    # The mean per cell is the height at the centroid, a quarter of a cell to the north-west.
    assert difference.mean() == pytest.approx(-0.25 * 0.1 - 0.25 * 0.25, abs=2e-3)


def test_triangulated_cells_with_ground_have_no_voids():
    result = dtm_of(*scattered(np.random.default_rng(1), 40_000, lopsided=5), void_m=0)
    assert np.isfinite(result).all()


@pytest.mark.parametrize("wide", [8, 12])
def test_triangulated_fills_voids_up_to_void_m(wide):
    easting, northing, height = scattered(np.random.default_rng(2), 40_000)
    hall = (np.abs(easting - GRID.west - 30) < wide / 2) & (np.abs(northing - GRID.north + 25) < wide / 2)
    result = dtm_of(easting[~hall], northing[~hall], height[~hall], void_m=8)
    valid = np.isfinite(result)
    assert valid[25, 30] == (wide == 8)
    assert valid.sum() == valid.size or wide == 12
    np.testing.assert_allclose(result[valid], TRUTH[valid], atol=0.2)


def test_triangulated_bays_stay_void_and_border_has_means():
    easting, northing, height = scattered(np.random.default_rng(3), 40_000)
    bay = (easting > GRID.west + 20) & (northing < GRID.north - 10)
    result = dtm_of(easting[~bay], northing[~bay], height[~bay], void_m=5)
    assert np.isnan(result[15:, 25:]).all()
    assert np.isfinite(result[:, :20]).all()
    assert np.isfinite(result[:10]).all()


def test_triangulated_single_and_collinear_points_fill_only_their_cells():
    line = GRID.west + np.arange(4) * 3 + 0.5, GRID.north - np.arange(4) * 3 - 0.5, np.arange(4) + 100.0
    for count in (1, 4):
        result = dtm_of(*(axis[:count] for axis in line))
        assert np.isfinite(result).sum() == count
        np.testing.assert_array_equal(np.diag(result)[: 3 * count : 3], line[2][:count])


def test_reach_m_includes_all_points_that_change_a_cell():
    """The height of a cell depends on points in the outermost cells within reach."""
    reach = tin_reach_m(6, GRID.cell)
    centre = GRID.west + 30.5, GRID.north - 25.5
    east = np.array([0.2, -reach + 0.45, -reach + 0.45])
    points = centre[0] + east, centre[1] + np.array([0, 0.6, -0.6]), 100 + east
    result = dtm_of(*points, void_m=6)
    assert result[25, 30] == pytest.approx(100, abs=1e-6)
    assert np.isfinite(result[[24, 26], 30 - round(reach)]).all()
    assert np.isfinite(result[25, 29])
    assert np.isnan(dtm_of(*points, void_m=5.9)[25, 29])


FINE_M = 0.2


def fine(cols, rows, west=295500.0, north=5629500.0):
    return Grid("EPSG:25832", west, north, FINE_M, cols, rows)


def slope(where: Grid):
    return 100 + 0.3 * (where.eastings - 295500) + 0.2 * (where.northings - 5629500)[:, None]


@pytest.mark.parametrize("cells", range(1, 9))
@pytest.mark.parametrize("shape", ["square", "strip"])
def test_fill_fills_voids_up_to_size_m(cells, shape):
    where = fine(40, 40)
    truth = slope(where)
    holed = truth.copy()
    holed[slice(20, 20 + cells), slice(10, 10 + cells) if shape == "square" else slice(5, 35)] = np.nan
    np.testing.assert_allclose(fill_voids(holed, where, cells * FINE_M), truth, atol=1e-9)
    assert np.isnan(fill_voids(holed, where, (cells - 1) * FINE_M)).any()


def test_fill_keeps_wide_voids_and_border_of_survey():
    where = fine(60, 60)
    row, col = np.indices(where.shape)
    lake = np.hypot(row - 30, col - 30) < 12
    beyond = col > 50
    holed = np.where(lake | beyond, np.nan, slope(where))
    filled = np.isfinite(fill_voids(holed, where, 5 * FINE_M))
    shore = ndimage.binary_erosion(lake)
    assert not filled[shore].any()
    assert not filled[beyond].any()


def test_fill_keeps_heights_and_all_void_stays_void():
    where = fine(9, 9)
    np.testing.assert_array_equal(fill_voids(slope(where), where, 5), slope(where))
    assert np.isnan(fill_voids(np.full(where.shape, np.nan), where, 5)).all()


@pytest.mark.parametrize("size_m", [0.0, 0.4, 0.7, 1.3])
@pytest.mark.parametrize("share", [0.2, 0.7])
def test_fill_cells_beyond_reach_m_have_no_effect(size_m, share):
    rng = np.random.default_rng(2)
    whole = fine(70, 60)
    heights = np.where(rng.random(whole.shape) < share, rng.uniform(100, 110, whole.shape), np.nan)
    expected = fill_voids(heights, whole, size_m)
    n = round(voids_reach_m(size_m, FINE_M) / FINE_M)
    for row, col in ((17, 19), (30, 41), (22, 33)):
        core = slice(row, row + 7), slice(col, col + 9)
        rim = slice(row - n, row + 7 + n), slice(col - n, col + 9 + n)
        part = fine(9 + 2 * n, 7 + 2 * n, whole.west + (col - n) * FINE_M, whole.north - (row - n) * FINE_M)
        result = fill_voids(heights[rim], part, size_m)[n : n + 7, n : n + 9]
        np.testing.assert_allclose(result, expected[core], rtol=0, atol=1e-9)
