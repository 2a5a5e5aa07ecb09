"""Heights above the ellipsoid: by a constant, by a geoid, by a vertical CRS; never by a guess."""

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from flexroad.catalog.crs import CatalogError
from flexroad.tools.export.ellipsoidal import Datum, Ellipsoidal, geocentric

PLACE = np.array([500_000.0]), np.array([5_600_000.0]), np.array([100.0])


@pytest.fixture
def geoid(tmp_path):
    """A geoid around 9 E, 50.55 N: 47 m above the ellipsoid at 9 E, and 1 m per degree of longitude."""
    path = tmp_path / "geoid.gtx"
    longitude = np.linspace(7, 11, 41)
    values = np.tile(47 + (longitude - 9), (41, 1)).astype(np.float32)
    place = rasterio.Affine(0.1, 0, 6.95, 0, -0.1, 52.55)
    form = {"driver": "GTX", "dtype": "float32", "count": 1, "width": 41, "height": 41}
    with rasterio.open(path, "w", **form, crs="EPSG:4326", transform=place) as raster:
        raster.write(values, 1)
    return path


def test_offset_is_added_and_the_place_is_that_of_pyproj():
    longitude, latitude, height = Ellipsoidal("EPSG:25832", Datum("offset", "47.5")).geographic(*PLACE)
    expected = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(*PLACE[:2])
    np.testing.assert_allclose((longitude, latitude), expected, atol=1e-12)
    assert height == 147.5


def test_geoid_is_added_at_each_place(geoid):
    east = np.array([460_000.0, 500_000.0, 540_000.0])
    north, level = np.full(3, 5_600_000.0), np.array([0.0, 100.0, 200.0])
    conversion = Ellipsoidal("EPSG:25832", Datum("geoid", str(geoid)))
    longitude, _, height = conversion.geographic(east, north, level)
    np.testing.assert_allclose(height - level, 47 + (longitude - 9), atol=1e-4)


def test_geoid_that_does_not_cover_the_area_raises(geoid):
    with pytest.raises(CatalogError, match=r"no exact conversion from EPSG:25833 .*--geoid FILE"):
        Ellipsoidal("EPSG:25833", Datum("geoid", str(geoid))).geographic(*PLACE)


def test_vertical_crs_without_its_grid_raises_and_is_not_ignored():
    with pytest.raises(CatalogError, match=r"heights of EPSG:7837 .*; give the geoid's grid with --geoid"):
        Ellipsoidal("EPSG:25832", Datum("crs", "EPSG:7837")).geographic(*PLACE)


def test_geocentric_agrees_with_the_equations_of_the_ellipsoid():
    conversion = Ellipsoidal("EPSG:25832", Datum("offset", "0"))
    longitude, latitude, height = conversion.geographic(*PLACE)
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    lam, phi = np.radians(longitude), np.radians(latitude)
    n = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    expected = [
        (n + height) * np.cos(phi) * np.cos(lam),
        (n + height) * np.cos(phi) * np.sin(lam),
        (n * (1 - e2) + height) * np.sin(phi),
    ]
    np.testing.assert_allclose(geocentric(longitude, latitude, height)[0], np.ravel(expected), atol=1e-6)


@pytest.mark.parametrize(("kind", "value"), [("geoid", "none.gtx"), ("offset", "nan")])
def test_datum_that_cannot_be_used_raises(kind, value):
    with pytest.raises(CatalogError, match=value):
        Datum(kind, value)
