import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog import Grid
from flexroad.tasks.segment.dinov2.windows import blend, corners, cover, taper

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 30, 20)
SIZES = st.integers(4, 40).flatmap(lambda size: st.tuples(st.just(size), st.integers(0, size // 2)))
PLACES = st.integers(-24000, 24000).map(lambda quarters: quarters / 4)


def ground_image(pixels: Grid) -> np.ndarray:
    """An image that is a function of map coordinates, the same on every grid."""
    x, y = np.meshgrid(pixels.eastings, pixels.northings)
    return np.stack([np.sin(x / 3) * np.cos(y / 5), np.sin(x / 1.3 + y / 2.1)]).astype(np.float32)


def inside(values: np.ndarray, pixels: Grid, grid: Grid) -> np.ndarray:
    """Values of the pixels whose centres lie on the grid."""
    rows = (pixels.northings < grid.north) & (pixels.northings > grid.south)
    cols = (pixels.eastings > grid.west) & (pixels.eastings < grid.east)
    return values[np.ix_(rows, cols)]


def blended(predict, grid: Grid, size: int, overlap: int, gsd: float = 0.5) -> np.ndarray:
    pixels = cover(grid, gsd, size, overlap)
    image = ground_image(pixels)
    return inside(blend(predict, image, np.ones(pixels.shape, bool), size, overlap, batch=3), pixels, grid)


@given(SIZES, st.floats(0.1, 3), PLACES, PLACES, st.integers(1, 40), st.integers(1, 40))
def test_cover_contains_grid_and_weights_sum_to_one(window, gsd, west, north, width, height):
    size, overlap = window
    grid = Grid("EPSG:25832", west, north, 1.0, width, height)
    pixels = cover(grid, gsd, size, overlap)
    assert pixels.west <= grid.west + 1e-6
    assert pixels.east >= grid.east - 1e-6
    assert pixels.south <= grid.south + 1e-6
    assert pixels.north >= grid.north - 1e-6
    total = np.zeros(pixels.shape)
    for row, col in corners(pixels.shape, size, overlap):
        total[row : row + size, col : col + size] += np.outer(taper(size, overlap), taper(size, overlap))
    np.testing.assert_allclose(inside(total, pixels, grid), 1, atol=1e-6)


@given(SIZES, SIZES)
def test_blend_pixelwise_model_does_not_depend_on_windows(first, second):
    def predict(windows):
        return windows[:, 0] ** 2 + windows[:, 1]

    np.testing.assert_allclose(blended(predict, GRID, *first), blended(predict, GRID, *second), atol=2e-6)


def test_blend_neighbouring_tiles_agree_on_overlap():
    """For any model: windows are fixed to the ground, not to the tile."""

    def predict(windows):
        mean = windows.mean(axis=(1, 2, 3))[:, None, None]
        return mean + np.linspace(0, 1, windows.shape[-1], dtype=np.float32)[None, :, None] * windows[:, 0]

    east = Grid(GRID.crs, GRID.west + 13, GRID.north - 4, 1.0, 30, 16)
    overlap = blended(predict, GRID, 24, 8)[8:, 26:]
    np.testing.assert_allclose(blended(predict, east, 24, 8)[:, :34], overlap, atol=1e-5)


def test_blend_different_windows_has_no_step():
    """Different predictions change smoothly into each other over the overlap."""

    def predict(windows):
        values = np.arange(len(windows), dtype=np.float32)[:, None, None]
        return values + np.zeros(windows[:, 0].shape, np.float32)

    image = np.zeros((1, 20, 36), np.float32)
    valid = np.ones(image.shape[1:], bool)
    row = blend(predict, image, valid, 20, 4, batch=9)[10]
    np.testing.assert_allclose(row[4:32], [*12 * [0], *taper(20, 4)[:4], *12 * [1]], atol=1e-6)


@pytest.mark.parametrize("batch", [1, 3, 100])
def test_blend_skips_windows_without_data(batch):
    batches = []

    def predict(windows):
        batches.append(len(windows))
        return np.ones(windows[:, 0].shape, np.float32)

    valid = np.zeros((40, 60), bool)
    valid[:20, :40] = True
    result = blend(predict, np.zeros((3, 40, 60), np.float32), valid, 20, 0, batch)
    np.testing.assert_array_equal(result, valid)
    assert sum(batches) == 2
    assert max(batches) <= batch
