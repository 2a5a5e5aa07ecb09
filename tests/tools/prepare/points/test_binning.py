import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.points.binning import Points, bins, highest, means, photo, spikes, top_layer
from tests.make_clouds import Top

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 0.5, 7, 5)
# Positions in quarters of a cell, many of them on borders of cells; some are outside the grid.
clouds = st.lists(st.tuples(st.integers(-8, 36), st.integers(-8, 28), st.integers(0, 12)), max_size=60)
DEPTH_M = 0.5


def points(cloud):
    x, y, z = np.array(cloud, float).reshape(-1, 3).T
    return GRID.west + x / 8, GRID.north - y / 8, z / 4


def by_cell(cloud) -> dict[tuple[int, int], list[float]]:
    heights: dict[tuple[int, int], list[float]] = {}
    for x, y, z in cloud:
        if 0 <= x < 4 * GRID.width and 0 <= y < 4 * GRID.height:
            heights.setdefault((y // 4, x // 4), []).append(z / 4)
    return heights


def raster(values: dict[tuple[int, int], float]):
    out = np.full(GRID.shape, np.nan)
    for at, value in values.items():
        out[at] = value
    return out


@given(clouds)
def test_highest_and_means_match_definition(cloud):
    easting, northing, height = points(cloud)
    cells = bins(easting, northing, GRID)
    by_index = by_cell(cloud)
    tops = highest(cells, height, GRID.shape)
    np.testing.assert_array_equal(tops, raster({at: max(zs) for at, zs in by_index.items()}))
    (mean,) = means(cells, GRID.shape, height)
    np.testing.assert_allclose(
        mean, raster({at: sum(zs) / len(zs) for at, zs in by_index.items()}), rtol=1e-14
    )


@given(clouds, st.sampled_from([0.25, 1.0]))
def test_spikes_match_definition(cloud, despike_m):
    by_index = by_cell(cloud)
    expected = []
    for (row, col), zs in by_index.items():
        near = [(row + r, col + c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)]
        others = sorted(zs)[:-1] + [z for at in near for z in by_index.get(at, [])]
        if others and max(zs) > max(others) + despike_m:
            expected.append((row * GRID.width + col, max(zs)))
    easting, northing, height = points(cloud)
    cells = bins(easting, northing, GRID)
    indices = spikes(cells, height, GRID.shape, despike_m)
    assert sorted(zip(cells[indices], height[indices], strict=True)) == sorted(expected)


def test_bins_points_on_borders_are_in_same_cells_of_all_grids():
    lines = 295500 + np.arange(0, 400) * 0.2
    other = Grid("EPSG:25832", 295500 - 13 * 0.2, 5629500 + 29 * 0.2, 0.2, 450, 450)
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 0.2, 400, 400)
    northing = 5629500 - np.arange(0, 400) * 0.2
    row, col = np.divmod(bins(lines, northing, grid), 400)
    np.testing.assert_array_equal(col, np.arange(400))
    np.testing.assert_array_equal(row, np.arange(400))
    row, col = np.divmod(bins(lines, northing, other), 450)
    np.testing.assert_array_equal(col, np.arange(400) + 13)
    np.testing.assert_array_equal(row, np.arange(400) + 29)


def layer_of(easting, northing, height, grid=GRID, depth_m=DEPTH_M):
    cells = bins(easting, northing, grid)
    return Top(*top_layer(cells, height, highest(cells, height, grid.shape), depth_m, grid.shape))


@given(clouds)
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


COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 0, 1)]
cells_around = st.tuples(st.integers(-3, GRID.width + 2), st.integers(-3, GRID.height + 2))
coloured = st.lists(st.tuples(cells_around, st.integers(0, 2), st.sampled_from(COLOURS)), max_size=25)


@given(coloured, st.sampled_from([0, 1, 2, 3]))
@settings(max_examples=60)
def test_photo_matches_definition(cloud, pixels):
    col, row = np.array([place for place, _, _ in cloud], float).reshape(-1, 2).T
    z, colour = np.array([z for _, z, _ in cloud], float), np.array([c for *_, c in cloud], np.uint8)
    kind = np.zeros(len(z), np.uint8)
    points = Points(GRID.west + (col + 0.5) / 2, GRID.north - (row + 0.5) / 2, z, kind, colour.reshape(-1, 3))
    tops = {}
    for place, z, colour in cloud:
        tops[place] = max(tops.get(place, (-1, ())), (z, colour))
    result = photo(points, GRID, pixels * GRID.cell)
    for row, col in np.ndindex(GRID.shape):
        near = [((r - row) ** 2 + (c - col) ** 2, r, c) for c, r in tops]
        distance, r, c = min(near, default=(np.inf, 0, 0))
        known = distance <= pixels**2
        assert result.known[row, col] == known
        assert tuple(result.colour[:, row, col]) == (tops[c, r][1] if known else (0, 0, 0))
