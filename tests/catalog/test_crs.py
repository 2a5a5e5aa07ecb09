import pytest
from pyproj import CRS

from flexroad.catalog.crs import code, compound, datum, esri, in_plan, name, vertical


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:25832", None),
        ("EPSG:25832+7837", "EPSG:7837"),
        ("EPSG:2994+6360", "EPSG:5703"),  # NAVD88 in US survey feet: the same datum in metres
        ("EPSG:25832+5715", None),  # depths
    ],
)
def test_vertical_is_the_datum_of_heights_in_metres(crs, expected):
    assert vertical(crs) == expected


def test_vertical_without_a_code_is_wkt_in_metres():
    definition = CRS("EPSG:6360").to_json_dict() | {"name": "heights of a site (ftUS)"}
    definition.pop("id")
    found = CRS(vertical(compound("EPSG:25832", CRS.from_json_dict(definition).to_wkt())))
    assert found.name == "heights of a site"
    assert found.axis_info[0].unit_name == "metre"


def test_compound_has_both_parts():
    assert in_plan(compound("EPSG:25832", "EPSG:7837")) == "EPSG:25832"
    assert vertical(compound("EPSG:25832", "EPSG:7837")) == "EPSG:7837"


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:25832", "25832"),
        (compound("EPSG:25832", "EPSG:5783"), "5555"),  # registered as a whole
        (compound("EPSG:25832", "EPSG:7837"), None),
        (CRS("EPSG:25832").to_wkt(), "25832"),
    ],
)
def test_code_is_that_of_the_whole_crs(crs, expected):
    assert code(crs) == expected


def test_name_and_datum_are_those_of_the_register():
    assert (name("EPSG:27700"), name("EPSG:7837")) == ("OSGB36 / British National Grid", "DHHN2016 height")
    assert datum("EPSG:7837") == "Deutsches Haupthoehennetz 2016"


def test_esri_is_read_as_the_same_crs():
    text = esri("EPSG:25832")
    assert "\n" not in text
    assert text.startswith('PROJCS["ETRS_1989_UTM_Zone_32N"')
    assert CRS(text).to_epsg(20) == 25832
