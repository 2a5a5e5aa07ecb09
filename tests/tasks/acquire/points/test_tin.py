from itertools import combinations

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.tin import tin

CELL = 0.5


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
