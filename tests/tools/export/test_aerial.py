"""Coarse images have the mean colour of what they show, and know what they do not show."""

import numpy as np
import pytest

from flexroad.tools.export.tileset import Aerial, joined, of_classes

BLACK, WHITE = (0, 0, 0), (255, 255, 255)


def ramp(bounds, rows, columns):
    """An image whose red is its easting, and green its northing."""
    west, south, east, north = bounds
    x = west + (np.arange(columns) + 0.5) * (east - west) / columns
    y = north - (np.arange(rows) + 0.5) * (north - south) / rows
    red, green = np.meshgrid(x, y)
    return Aerial(bounds, np.stack([red, green, np.full_like(red, 9)], axis=-1), np.ones(red.shape))


def square(west, south, east, north):
    points = np.array([[west, south, 1], [east, south, 1], [east, north, 1], [west, north, 1]], float)
    return points, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def test_of_classes_pixel_has_the_share_of_road():
    """Road is the triangle south-east of the diagonal."""
    points, faces = square(0, 0, 40, 40)
    image = of_classes(points, faces, np.array([True, False]), (BLACK, WHITE), (0, 0, 40, 40), 4.0)
    assert image.colour.shape == (10, 10, 3)
    row, column = np.indices((10, 10))
    assert (image.colour[row + column > 9] == 0).all()
    assert (image.colour[row + column < 9] == 255).all()
    # Places on the diagonal count as road.
    np.testing.assert_allclose(image.colour[row + column == 9], 255 * 6 / 16)
    assert (image.share == 1).all()


def test_of_classes_pixel_beside_the_mesh_is_unknown():
    points, faces = square(0, 0, 20, 40)
    image = of_classes(points, faces, np.ones(2, bool), (BLACK, WHITE), (0, 0, 40, 40), 8.0)
    np.testing.assert_array_equal(image.share, np.tile([1, 1, 0.5, 0, 0], (5, 1)))
    assert (image.complete() == 0).all()


@pytest.mark.parametrize("pixel", [4.0, 7.0, 3.3])
def test_joined_pixels_are_means_over_their_area(pixel):
    bounds = (0.0, 0.0, 64.0, 32.0)
    parts = [ramp((0.0, 0.0, 32.0, 32.0), 64, 64), ramp((32.0, 0.0, 64.0, 32.0), 128, 128)]
    image = joined(parts, bounds, pixel)
    expected = ramp(bounds, *image.share.shape)
    np.testing.assert_allclose(image.colour, expected.colour, atol=0.02)
    np.testing.assert_allclose(image.share, 1)


def test_joined_area_without_parts_is_unknown_and_takes_the_nearest_colour():
    image = joined([ramp((0.0, 0.0, 10.0, 10.0), 10, 10)], (0.0, 0.0, 20.0, 10.0), 1.0)
    np.testing.assert_array_equal(image.share, np.tile([1.0] * 10 + [0.0] * 10, (10, 1)))
    complete = image.complete()
    np.testing.assert_array_equal(complete[:, 10:], np.repeat(complete[:, 9:10], 10, axis=1))


def test_joined_weighs_colours_by_what_is_known():
    part = Aerial((0.0, 0.0, 2.0, 1.0), np.array([[[100.0] * 3, [200.0] * 3]]), np.array([[1.0, 0.25]]))
    image = joined([part], (0.0, 0.0, 2.0, 1.0), 2.0)
    np.testing.assert_allclose(image.colour, [[[120.0] * 3]])
    np.testing.assert_allclose(image.share, [[0.625]])
