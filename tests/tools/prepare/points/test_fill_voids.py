import numpy as np
import pytest
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.points.tin import fill_voids, voids_reach_m

CELL = 0.2


def grid(cols, rows, west=295500.0, north=5629500.0):
    return Grid("EPSG:25832", west, north, CELL, cols, rows)


def plane(where: Grid):
    return 100 + 0.3 * (where.eastings - 295500) + 0.2 * (where.northings - 5629500)[:, None]


@pytest.mark.parametrize("cells", range(1, 9))
@pytest.mark.parametrize("shape", ["square", "strip"])
def test_fill_fills_voids_up_to_size_m(cells, shape):
    where = grid(40, 40)
    truth = plane(where)
    holed = truth.copy()
    holed[slice(20, 20 + cells), slice(10, 10 + cells) if shape == "square" else slice(5, 35)] = np.nan
    np.testing.assert_allclose(fill_voids(holed, where, cells * CELL), truth, atol=1e-9)
    assert np.isnan(fill_voids(holed, where, (cells - 1) * CELL)).any()


def test_fill_keeps_wide_voids_and_border_of_survey():
    where = grid(60, 60)
    row, col = np.indices(where.shape)
    lake = np.hypot(row - 30, col - 30) < 12
    beyond = col > 50
    holed = np.where(lake | beyond, np.nan, plane(where))
    filled = np.isfinite(fill_voids(holed, where, 5 * CELL))
    shore = ndimage.binary_erosion(lake)
    assert not filled[shore].any()
    assert not filled[beyond].any()


def test_fill_keeps_heights_and_all_void_stays_void():
    where = grid(9, 9)
    np.testing.assert_array_equal(fill_voids(plane(where), where, 5), plane(where))
    assert np.isnan(fill_voids(np.full(where.shape, np.nan), where, 5)).all()


@pytest.mark.parametrize("size_m", [0.0, 0.4, 0.7, 1.3])
@pytest.mark.parametrize("share", [0.2, 0.7])
def test_fill_cells_beyond_reach_m_have_no_effect(size_m, share):
    rng = np.random.default_rng(2)
    whole = grid(70, 60)
    heights = np.where(rng.random(whole.shape) < share, rng.uniform(100, 110, whole.shape), np.nan)
    expected = fill_voids(heights, whole, size_m)
    n = round(voids_reach_m(size_m, CELL) / CELL)
    for row, col in ((17, 19), (30, 41), (22, 33)):
        core = slice(row, row + 7), slice(col, col + 9)
        rim = slice(row - n, row + 7 + n), slice(col - n, col + 9 + n)
        part = grid(9 + 2 * n, 7 + 2 * n, whole.west + (col - n) * CELL, whole.north - (row - n) * CELL)
        result = fill_voids(heights[rim], part, size_m)[n : n + 7, n : n + 9]
        np.testing.assert_allclose(result, expected[core], rtol=0, atol=1e-9)
