"""Map tiles of heights read back within half a step, and lie where Web Mercator has them."""

import io

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

from flexroad.tasks.export import terrarium
from flexroad.tasks.export.terrarium import SIZE


def decoded(data):
    """The heights of a PNG by the definition of Terrarium."""
    red, green, blue = np.moveaxis(np.asarray(Image.open(io.BytesIO(data)), float), -1, 0)
    return red * 256 + green + blue / 256 - 32768


def test_heights_read_back_within_half_a_step():
    heights = np.random.default_rng(0).uniform(-500, 9000, (SIZE, SIZE))
    heights[:7] = np.nan
    read = decoded(terrarium.encode_png(heights, -501.0))
    assert (read[:7] == -501).all()
    assert 0.0019 < np.abs(read[7:] - heights[7:]).max() <= 1 / 512


def test_pixels_lie_where_the_map_has_them():
    """The tile of the Cologne cathedral at zoom 14, from the formula of slippy maps."""
    longitude, latitude = 6.9583, 50.9413
    column = int((longitude + 180) / 360 * 2**14)
    row = int((1 - np.arcsinh(np.tan(np.radians(latitude))) / np.pi) / 2 * 2**14)
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(longitude, latitude)
    assert terrarium.touched(14, (x, y, x + 1e-6, y + 1e-6)) == [(column, row)]
    xs, ys = terrarium.pixel_centres(14, column, row)
    assert xs[0] < x < xs[-1]
    assert ys[0] > y > ys[-1]
    # Neighbouring tiles continue with the same distance of pixels.
    beside, _ = terrarium.pixel_centres(14, column + 1, row)
    assert beside[0] - xs[-1] == pytest.approx(xs[1] - xs[0])


def test_zoom_has_pixels_as_fine_as_asked_for():
    world = 2 * terrarium.HALF
    for zoom in (0, 5, 16):
        assert terrarium.zoom_of(world / SIZE / 2**zoom) == zoom
        assert terrarium.zoom_of(world / SIZE / 2**zoom * 0.99) == zoom + 1
    assert terrarium.zoom_of(1e9) == 0
    assert terrarium.zoom_of(1e-9) == terrarium.MAX_ZOOM


def test_overview_zoom_has_tiles_of_the_size_of_the_bounds():
    side = 2 * terrarium.HALF / 2**12
    assert terrarium.overview_zoom((0, 0, side * 0.9, 10)) == 12
    assert terrarium.overview_zoom((0, 0, 10, side * 1.1)) == 11


def test_touched_tiles_are_within_the_map():
    everything = (-3e7, -3e7, 3e7, 3e7)
    assert terrarium.touched(1, everything) == [(0, 0), (1, 0), (0, 1), (1, 1)]


def test_halved_is_the_mean_of_known_heights():
    heights = np.array([[1.0, 2.0, np.nan, np.nan], [3.0, np.nan, np.nan, np.nan]])
    np.testing.assert_array_equal(terrarium.halved(heights), [[2.0, np.nan]])
