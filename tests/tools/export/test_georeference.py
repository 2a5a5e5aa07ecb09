"""Coordinates of exported files: origins, local projections, and heights above the ellipsoid."""

import json

import numpy as np
import pyproj
import pytest
import rasterio
from pyproj import CRS, Transformer

from flexroad.catalog.crs import CatalogError
from flexroad.tools.export.georeference import Datum, Georeference, LocalFrame, geocentric

PLACE = Georeference("EPSG:25832", (295500.0, 5629250.0, 150.0), "EPSG:7837")


def test_sidecar_lines_and_prj_have_the_place():
    assert json.loads(PLACE.sidecar("x east", step_m=0.5)) == {
        "crs": "EPSG:25832",
        "crs_name": "ETRS89 / UTM zone 32N",
        "vertical_crs": "EPSG:7837",
        "origin": [295500.0, 5629250.0, 150.0],
        "axes": "x east",
        "step_m": 0.5,
    }
    wkt = 'PROJCRS["Réunion",\n BASEGEOGCRS["b"]]'
    assert Georeference(wkt, PLACE.origin).lines() == [
        "origin 295500 5629250 150 (easting northing height, m)",
        'crs PROJCRS["R\\xe9union", BASEGEOGCRS["b"]]',
        "vertical crs unknown",
    ]
    (line,) = PLACE.prj().decode().splitlines()
    assert CRS.from_user_input(line).to_epsg(20) == 25832


PLACES = {
    "EPSG:25832": (366_000.0, 5_621_000.0, "GRS80"),
    # No ellipsoid of GNSS.
    "EPSG:27700": (532_400.0, 181_800.0, "WGS84"),
    "EPSG:26910": (5e5, 4.2e6, "GRS80"),
}


def test_local_frame_lengths_are_those_on_the_ellipsoid():
    frame = LocalFrame.around("EPSG:25832", 366_000.0, 5_621_000.0)
    easting, northing = np.array([366_000.0, 367_000.0]), np.array([5_621_000.0, 5_621_000.0])
    x, y = frame.to_local(easting, northing)
    to_degrees = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True)
    truth = pyproj.Geod(ellps="GRS80").line_length(*to_degrees.transform(easting, northing))
    assert np.hypot(x[1] - x[0], y[1] - y[0]) == pytest.approx(truth, abs=1e-4)
    assert truth - 1000 > 0.1  # UTM is that much off here


@pytest.mark.parametrize("crs", PLACES)
def test_local_frame_is_described_by_its_proj_string_and_leads_back_to_the_run(crs):
    easting, northing, ellipsoid = PLACES[crs]
    frame = LocalFrame.around(crs, easting, northing)
    places = easting + np.array([0.0, 900.0, 3000.0]), northing + np.array([0.0, -400.0, -700.0])
    x, y = frame.to_local(*places)
    assert np.hypot(x[0], y[0]) < 1.5
    np.testing.assert_allclose(frame.to_run(x, y), places, atol=1e-5)
    words = dict(word.lstrip("+").split("=") for word in frame.proj.split())
    assert (words["k"], words["ellps"]) == ("1", ellipsoid)
    assert "+no_defs" not in frame.proj
    # The same ellipsoid, without a datum that could shift the result.
    degrees = pyproj.Proj(frame.proj)(x, y, inverse=True)
    geodetic = "EPSG:4326" if ellipsoid == "WGS84" else pyproj.CRS(crs).geodetic_crs
    truth = pyproj.Transformer.from_crs(crs, geodetic, always_xy=True).transform(*places)
    np.testing.assert_allclose(degrees, truth, atol=1e-9)


POINT = np.array([500_000.0]), np.array([5_600_000.0]), np.array([100.0])


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


def test_offset_or_geoid_is_added_at_each_place(geoid):
    east = np.array([460_000.0, 500_000.0, 540_000.0])
    north, level = np.full(3, 5_600_000.0), np.array([0.0, 100.0, 200.0])
    place = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(east, north)
    *found, height = Datum("offset", "47.5").geographic("EPSG:25832", east, north, level)
    np.testing.assert_allclose(found, place, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(height, level + 47.5)
    longitude, _, height = Datum("geoid", str(geoid)).geographic("EPSG:25832", east, north, level)
    np.testing.assert_allclose(height - level, 47 + (longitude - 9), atol=1e-4)


def test_geocentric_agrees_with_the_equations_of_the_ellipsoid():
    longitude, latitude, height = Datum("offset", "0").geographic("EPSG:25832", *POINT)
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


def test_datum_is_a_number_a_geoid_or_a_crs(geoid):
    assert Datum.of("-47.50") == Datum("offset", "-47.5")
    assert Datum.of(str(geoid)) == Datum("geoid", str(geoid))
    assert Datum.of("EPSG:7837") == Datum("crs", "EPSG:7837")


@pytest.mark.parametrize(
    ("value", "crs", "message"),
    [
        ("none.gtx", "EPSG:25832", "--vertical none.gtx"),
        ("nan", "EPSG:25832", "--vertical nan"),
        # The geoid does not cover the area.
        ("GEOID", "EPSG:25833", r"no exact conversion from EPSG:25833 .*--vertical FILE"),
        # PROJ has no grid of this datum.
        ("EPSG:7837", "EPSG:25832", r"heights of EPSG:7837 .*; give the geoid's grid with --vertical"),
    ],
)
def test_datum_that_cannot_be_used_raises(geoid, value, crs, message):
    with pytest.raises(CatalogError, match=message):
        Datum.of(value.replace("GEOID", str(geoid))).geographic(crs, *POINT)
