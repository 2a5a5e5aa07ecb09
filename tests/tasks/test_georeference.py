import json

from pyproj import CRS

from flexroad.tools.export.georeference import Georeference

PLACE = Georeference("EPSG:25832", (295500.0, 5629250.0, 150.0), "EPSG:7837")


def test_sidecar_has_place_axes_and_other_entries():
    content = json.loads(PLACE.sidecar("x east", step_m=0.5))
    assert content == {
        "crs": "EPSG:25832",
        "crs_name": "ETRS89 / UTM zone 32N",
        "vertical_crs": "EPSG:7837",
        "origin": [295500.0, 5629250.0, 150.0],
        "axes": "x east",
        "step_m": 0.5,
    }


def test_lines_are_single_ascii_lines():
    wkt = 'PROJCRS["Réunion",\n BASEGEOGCRS["b"]]'
    lines = Georeference(wkt, PLACE.origin).lines()
    assert lines == [
        "origin 295500 5629250 150 (easting northing height, m)",
        'crs PROJCRS["R\\xe9union", BASEGEOGCRS["b"]]',
        "vertical crs unknown",
    ]


def test_prj_is_read_as_the_same_crs():
    text = PLACE.prj().decode()
    assert len(text.splitlines()) == 1
    assert CRS.from_user_input(text).to_epsg(20) == 25832
