"""The grid triangulation against matplotlib's interpolation on the same triangles."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.tri import LinearTriInterpolator, Triangulation

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import raster
from tests.builders import make_clusters, make_grid, make_tile

GRID = make_grid(13, 9, 0.5)
RNG = np.random.default_rng(0)
DSM, DTM = RNG.normal(160, 2, GRID.shape), RNG.normal(150, 2, GRID.shape)
WEST, SOUTH, EAST, NORTH = GRID.hull


def surface(heights=DSM):
    return raster.RasterSurface(crs=GRID.crs, bounds=GRID.hull, grid=GRID, heights=heights)


def points(count=500):
    return RNG.uniform(WEST, EAST, count), RNG.uniform(SOUTH, NORTH, count)


def peer():
    """Return matplotlib's interpolator on the triangles (sw, se, ne) and (sw, ne, nw), local coordinates."""
    index = np.arange(DSM.size).reshape(DSM.shape)
    nw, ne, sw, se = (x.ravel() for x in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    triangles = np.concatenate([np.stack([sw, se, ne], 1), np.stack([sw, ne, nw], 1)])
    e, n = np.meshgrid(GRID.eastings - WEST, GRID.northings - SOUTH)
    return LinearTriInterpolator(Triangulation(e.ravel(), n.ravel(), triangles), DSM.ravel())


@pytest.mark.parametrize(
    ("road", "terrain"), [("dsm", "dsm"), ("dsm", "dtm"), ("dtm", "dtm"), ("dtm", "dsm")]
)
def test_fit_takes_heights_from_chosen_rasters(road, terrain):
    labels = np.zeros(GRID.shape, np.int32)
    labels[3:5] = 2
    options = raster.Options(road=road, terrain=terrain)
    fitted = raster.fit(make_tile(DSM, DTM, 0.5), make_clusters(labels, 0.5), options)
    source = {"dsm": DSM, "dtm": DTM}
    np.testing.assert_array_equal(fitted.heights[3:5], source[road][3:5])
    np.testing.assert_array_equal(fitted.heights[5:], source[terrain][5:])


def test_height_between_centres_is_linear_on_triangles():
    e, n = points()
    heights = peer()(e - WEST, n - SOUTH)
    assert not np.ma.is_masked(heights)
    np.testing.assert_allclose(surface().height(e, n), heights, atol=1e-6)


def test_normal_equals_triangle_normal():
    e, n = points()
    by_e, by_n = peer().gradient(e - WEST, n - SOUTH)
    expected = np.stack([-by_e, -by_n, np.ones_like(by_e)], -1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(surface().normal(e, n), expected, atol=1e-6)


def test_height_at_centres_equals_raster_beside_nodata():
    heights = DSM.copy()
    heights[RNG.random(GRID.shape) < 0.4] = np.nan
    np.testing.assert_array_equal(surface(heights).lattice(GRID.eastings, GRID.northings), heights)
    large = replace(GRID, west=3.2e5 + 0.1, north=5.6e6 + 0.7, cell=0.3)
    shifted = replace(surface(heights), grid=large, bounds=large.hull)
    np.testing.assert_allclose(shifted.lattice(large.eastings, large.northings), heights, atol=1e-6)


def test_height_is_nan_only_on_triangles_with_nodata_corner():
    heights = DSM.copy()
    heights[4, 6] = np.nan
    e, n = points(2000)
    missing = np.isnan(surface(heights).height(e, n))
    x, y = (e - GRID.eastings[6]) / GRID.cell, (n - GRID.northings[4]) / GRID.cell
    # The six triangles around a centre: the square of neighbours without its nw and se corner triangles.
    hexagon = (np.abs(x) < 1) & (np.abs(y) < 1) & (np.abs(x - y) < 1)
    np.testing.assert_array_equal(missing, hexagon)
    np.testing.assert_array_equal(np.isnan(surface(heights).normal(e, n)).any(axis=-1), hexagon)


def test_height_up_to_tile_edge_is_linear():
    e, n = np.meshgrid(GRID.eastings, GRID.northings)
    plane = surface(100 + 0.2 * (e - WEST) - 0.1 * (n - SOUTH))
    west, south, east, north = GRID.bounds
    x, y = np.array([west, east, west, east, west + 1]), np.array([south, south, north, north, north])
    np.testing.assert_allclose(plane.height(x, y), 100 + 0.2 * (x - WEST) - 0.1 * (y - SOUTH), atol=1e-8)
    # Continuous across the hull's edge and between neighbours beyond it.
    s = surface()
    for k in range(1, GRID.height - 1):
        a, b = (s.height(west, GRID.northings[k] + d) for d in (-1e-4, 1e-4))
        assert a == pytest.approx(b, abs=0.02)


def test_height_single_row_or_cell():
    row = Grid(GRID.crs, WEST, NORTH, 1.0, 4, 1)
    one = Grid(GRID.crs, WEST, NORTH, 1.0, 1, 1)
    for grid, heights in ((row, np.arange(4.0)[None, :]), (one, np.array([[7.0]]))):
        s = raster.RasterSurface(crs=grid.crs, bounds=grid.hull, grid=grid, heights=heights)
        np.testing.assert_array_equal(s.lattice(grid.eastings, grid.northings), heights)
        assert s.height(grid.west, grid.south) == pytest.approx(heights[0, 0] - (0.5 if grid is row else 0))
