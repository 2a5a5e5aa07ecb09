import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.binning import bins
from flexroad.tasks.acquire.points.dtm import averaged, reach_m, triangulated

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 60, 50)


def plane(easting, northing):
    return 150 + 0.1 * (easting - GRID.west) - 0.25 * (northing - GRID.north)


TRUTH = plane(GRID.eastings, GRID.northings[:, None])


def scattered(rng, n=6000, lopsided=1.0):
    """Points of the plane; above 1, ``lopsided`` crowds them in the north-west of their cells."""
    cell = rng.integers(0, [GRID.width, GRID.height], (n, 2))
    place = rng.random((n, 2)) ** lopsided
    easting, northing = GRID.west + cell[:, 0] + place[:, 0], GRID.north - cell[:, 1] - place[:, 1]
    return easting, northing, plane(easting, northing)


def tin(easting, northing, height, void_m=50.0):
    return triangulated(bins(easting, northing, GRID), easting, northing, height, GRID, void_m)


def test_a_plane_stays_a_plane_however_its_cells_were_sampled():
    points = scattered(np.random.default_rng(0), lopsided=3)
    inside = slice(2, -2), slice(2, -2)
    np.testing.assert_allclose(tin(*points)[inside], TRUTH[inside], atol=1e-8)
    off = averaged(bins(points[0], points[1], GRID), points[2], GRID, 50) - TRUTH
    # The mean per cell is that at the centroid, a quarter of a cell to the north-west.
    assert off.mean() == pytest.approx(-0.25 * 0.1 - 0.25 * 0.25, abs=2e-3)


def test_no_hole_where_every_cell_has_ground():
    found = tin(*scattered(np.random.default_rng(1), 40_000, lopsided=5), void_m=0)
    assert np.isfinite(found).all()


@pytest.mark.parametrize("wide", [8, 12])
def test_houses_are_bridged_and_halls_stay_void(wide):
    easting, northing, height = scattered(np.random.default_rng(2), 40_000)
    hall = (np.abs(easting - GRID.west - 30) < wide / 2) & (np.abs(northing - GRID.north + 25) < wide / 2)
    found = tin(easting[~hall], northing[~hall], height[~hall], void_m=8)
    known = np.isfinite(found)
    assert known[25, 30] == (wide == 8)
    assert known.sum() == known.size or wide == 12
    np.testing.assert_allclose(found[known], TRUTH[known], atol=0.2)


def test_bays_of_the_survey_stay_open_and_its_border_takes_the_means():
    easting, northing, height = scattered(np.random.default_rng(3), 40_000)
    bay = (easting > GRID.west + 20) & (northing < GRID.north - 10)
    found = tin(easting[~bay], northing[~bay], height[~bay], void_m=5)
    assert np.isnan(found[15:, 25:]).all()
    assert np.isfinite(found[:, :20]).all()
    assert np.isfinite(found[:10]).all()


def test_one_point_and_points_in_a_line_are_ground_of_their_cells_alone():
    line = GRID.west + np.arange(4) * 3 + 0.5, GRID.north - np.arange(4) * 3 - 0.5, np.arange(4) + 100.0
    for count in (1, 4):
        found = tin(*(axis[:count] for axis in line))
        assert np.isfinite(found).sum() == count
        np.testing.assert_array_equal(np.diag(found)[: 3 * count : 3], line[2][:count])


def test_a_triangle_can_be_as_long_as_the_reach():
    """A cell that takes its height from points in the outermost cells of the reach."""
    reach = reach_m(6, GRID.cell)
    centre = GRID.west + 30.5, GRID.north - 25.5
    east = np.array([0.2, -reach + 0.45, -reach + 0.45])
    points = centre[0] + east, centre[1] + np.array([0, 0.6, -0.6]), 100 + east
    found = tin(*points, void_m=6)
    assert found[25, 30] == pytest.approx(100, abs=1e-6)
    assert np.isfinite(found[[24, 26], 30 - round(reach)]).all()
    assert np.isfinite(found[25, 29])
    assert np.isnan(tin(*points, void_m=5.9)[25, 29])
