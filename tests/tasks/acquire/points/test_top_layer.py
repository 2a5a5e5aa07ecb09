import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.binning import bins, highest, top_layer

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 0.5, 7, 5)
DEPTH_M = 0.5
# Positions in quarters of a cell, many of them on borders of cells; heights in steps of half the depth.
clouds = st.lists(st.tuples(st.integers(-8, 36), st.integers(-8, 28), st.integers(0, 12)), max_size=60)


def layer_of(easting, northing, height, grid=GRID, depth_m=DEPTH_M):
    cells = bins(easting, northing, grid)
    return top_layer(cells, height, highest(cells, height, grid.shape), depth_m, grid.shape)


@given(clouds)
@settings(deadline=None)
def test_top_layer_matches_definition(cloud):
    x, y, z = np.array(cloud, float).reshape(-1, 3).T
    layer = layer_of(GRID.west + x / 8, GRID.north - y / 8, z / 4)
    for row in range(GRID.height):
        for col in range(GRID.width):
            heights = z[(x // 4 == col) & (y // 4 == row)] / 4
            if not heights.size:
                assert np.isnan(layer.height[row, col])
                assert layer.count[row, col] == 0
                continue
            top = heights[heights >= heights.max() - DEPTH_M]
            assert layer.count[row, col] == top.size
            assert abs(layer.height[row, col] - top.mean()) < 1e-12
            assert abs(layer.spread[row, col] - top.std()) < 1e-7


def test_top_layer_of_noisy_slope_is_unbiased_and_the_highest_point_is_not():
    grid, noise = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 60, 60), 0.03
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 60, (2, 12 * 60 * 60))
    height = 150 + 0.05 * x + rng.normal(0, noise, x.size)
    # Ground below the surface, as under a deck, does not count.
    below = rng.random(x.size) < 0.2
    height[below] -= 4
    layer = layer_of(grid.west + x, grid.north - y, height, grid, depth_m=0.25)
    truth = 150 + 0.05 * (grid.eastings - grid.west)
    cells = bins(grid.west + x, grid.north - y, grid)
    assert abs(np.nanmean(layer.height - truth)) < 0.002
    assert np.nanmean(highest(cells, height, grid.shape) - truth) > 1.5 * noise
