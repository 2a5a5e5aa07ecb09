import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.binning import bins
from flexroad.tasks.acquire.points.tin import averaged, reach_m, triangulated

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 60, 50)


def plane(easting, northing):
    return 150 + 0.1 * (easting - GRID.west) - 0.25 * (northing - GRID.north)


TRUTH = plane(GRID.eastings, GRID.northings[:, None])


def scattered(rng, n=6000, lopsided=1.0):
    """Points of the plane; with ``lopsided`` above 1 most are in the north-west of their cells."""
    cell = rng.integers(0, [GRID.width, GRID.height], (n, 2))
    position = rng.random((n, 2)) ** lopsided
    easting, northing = GRID.west + cell[:, 0] + position[:, 0], GRID.north - cell[:, 1] - position[:, 1]
    return easting, northing, plane(easting, northing)


def tin(easting, northing, height, void_m=50.0):
    return triangulated(bins(easting, northing, GRID), easting, northing, height, GRID, void_m)


def test_triangulated_plane_is_exact_for_any_sampling():
    points = scattered(np.random.default_rng(0), lopsided=3)
    inside = slice(2, -2), slice(2, -2)
    np.testing.assert_allclose(tin(*points)[inside], TRUTH[inside], atol=1e-8)
    difference = averaged(bins(points[0], points[1], GRID), points[2], GRID, 50) - TRUTH
    # The mean per cell is the height at the centroid, a quarter of a cell to the north-west.
    assert difference.mean() == pytest.approx(-0.25 * 0.1 - 0.25 * 0.25, abs=2e-3)


def test_triangulated_cells_with_ground_have_no_voids():
    result = tin(*scattered(np.random.default_rng(1), 40_000, lopsided=5), void_m=0)
    assert np.isfinite(result).all()


@pytest.mark.parametrize("wide", [8, 12])
def test_triangulated_fills_voids_up_to_void_m(wide):
    easting, northing, height = scattered(np.random.default_rng(2), 40_000)
    hall = (np.abs(easting - GRID.west - 30) < wide / 2) & (np.abs(northing - GRID.north + 25) < wide / 2)
    result = tin(easting[~hall], northing[~hall], height[~hall], void_m=8)
    valid = np.isfinite(result)
    assert valid[25, 30] == (wide == 8)
    assert valid.sum() == valid.size or wide == 12
    np.testing.assert_allclose(result[valid], TRUTH[valid], atol=0.2)


def test_triangulated_bays_stay_void_and_border_has_means():
    easting, northing, height = scattered(np.random.default_rng(3), 40_000)
    bay = (easting > GRID.west + 20) & (northing < GRID.north - 10)
    result = tin(easting[~bay], northing[~bay], height[~bay], void_m=5)
    assert np.isnan(result[15:, 25:]).all()
    assert np.isfinite(result[:, :20]).all()
    assert np.isfinite(result[:10]).all()


def test_triangulated_single_and_collinear_points_fill_only_their_cells():
    line = GRID.west + np.arange(4) * 3 + 0.5, GRID.north - np.arange(4) * 3 - 0.5, np.arange(4) + 100.0
    for count in (1, 4):
        result = tin(*(axis[:count] for axis in line))
        assert np.isfinite(result).sum() == count
        np.testing.assert_array_equal(np.diag(result)[: 3 * count : 3], line[2][:count])


def test_reach_m_includes_all_points_that_change_a_cell():
    """The height of a cell depends on points in the outermost cells within reach."""
    reach = reach_m(6, GRID.cell)
    centre = GRID.west + 30.5, GRID.north - 25.5
    east = np.array([0.2, -reach + 0.45, -reach + 0.45])
    points = centre[0] + east, centre[1] + np.array([0, 0.6, -0.6]), 100 + east
    result = tin(*points, void_m=6)
    assert result[25, 30] == pytest.approx(100, abs=1e-6)
    assert np.isfinite(result[[24, 26], 30 - round(reach)]).all()
    assert np.isfinite(result[25, 29])
    assert np.isnan(tin(*points, void_m=5.9)[25, 29])
