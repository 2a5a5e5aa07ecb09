import numpy as np
import pyproj
import pytest

from flexroad.tools.export.local_frame import LocalFrame

PLACES = {
    "EPSG:25832": (366_000.0, 5_621_000.0),
    "EPSG:27700": (532_400.0, 181_800.0),
    "EPSG:26910": (5e5, 4.2e6),
}


@pytest.mark.parametrize("crs", PLACES)
def test_local_frame_there_and_back_is_the_same_point(crs):
    easting, northing = (at + np.array([0.0, 3000.0, -700.0]) for at in PLACES[crs])
    frame = LocalFrame.around(crs, easting[0], northing[0])
    x, y = frame.to_local(easting, northing)
    assert np.hypot(x[0], y[0]) < 1.5
    back = frame.to_run(x, y)
    np.testing.assert_allclose(back, (easting, northing), atol=1e-5)


def test_local_frame_lengths_are_those_on_the_ellipsoid():
    frame = LocalFrame.around("EPSG:25832", 366_000.0, 5_621_000.0)
    easting, northing = np.array([366_000.0, 367_000.0]), np.array([5_621_000.0, 5_621_000.0])
    x, y = frame.to_local(easting, northing)
    to_degrees = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True)
    truth = pyproj.Geod(ellps="GRS80").line_length(*to_degrees.transform(easting, northing))
    assert np.hypot(x[1] - x[0], y[1] - y[0]) == pytest.approx(truth, abs=1e-4)
    assert truth - 1000 > 0.1  # UTM is that much off here


@pytest.mark.parametrize("crs", PLACES)
def test_local_frame_proj_string_describes_its_coordinates(crs):
    easting, northing = PLACES[crs]
    frame = LocalFrame.around(crs, easting, northing)
    x, y = frame.to_local(np.array([easting + 900]), np.array([northing - 400]))
    words = dict(word.lstrip("+").split("=") for word in frame.proj.split())
    assert words["k"] == "1"
    assert "+no_defs" not in frame.proj
    # The same ellipsoid, without a datum that could shift the result.
    degrees = pyproj.Proj(frame.proj)(x[0], y[0], inverse=True)
    geodetic = "EPSG:4326" if words["ellps"] == "WGS84" else pyproj.CRS(crs).geodetic_crs
    truth = pyproj.Transformer.from_crs(crs, geodetic, always_xy=True).transform(
        easting + 900, northing - 400
    )
    np.testing.assert_allclose(degrees, truth, atol=1e-9)


def test_local_frame_other_ellipsoid_than_that_of_gnss_uses_wgs_84():
    assert "+ellps=WGS84" in LocalFrame.around("EPSG:27700", 532_400.0, 181_800.0).proj
    assert "+ellps=GRS80" in LocalFrame.around("EPSG:25832", 366_000.0, 5_621_000.0).proj
