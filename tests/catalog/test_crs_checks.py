"""Parts and names of a CRS, coordinates that cannot be in it, and metres of another length."""

import math

import pytest
from pyproj import CRS

from flexroad.catalog import CatalogError
from flexroad.catalog.crs import code, compound, datum, esri, in_plan, name, vertical
from flexroad.catalog.crs_checks import angle_fault, crs_of, elsewhere, require_scale

UNKNOWN = (math.nan,) * 4
METRES = (499_975.0, 5_600_010.0, 500_105.0, 5_600_010.0)


@pytest.mark.parametrize(
    ("crs", "x", "y"),
    [
        ("EPSG:25832", 500_000, 5_600_000),
        ("EPSG:25832", 0, 0),
        ("EPSG:4647", 32_500_000, 5_600_000),
        ("EPSG:31467", 3_500_000, 5_600_000),
        ("EPSG:2154", 650_000, 6_860_000),
        ("EPSG:27700", 530_000, 180_000),
        ("EPSG:2056", 2_600_000, 1_200_000),
        ("EPSG:28992", 120_000, 480_000),
        ("EPSG:2180", 500_000, 500_000),
        ("EPSG:5514", -740_000, -1_040_000),
        ("EPSG:3035", 4_321_000, 3_210_000),
        ("EPSG:3857", 1_113_000, 0),  # at the equator a metre of Web Mercator is one
        ("EPSG:4326", 10, 51),  # not projected
    ],
)
def test_scale_of_a_crs_at_home_is_right(crs, x, y):
    require_scale("dsm.tif", crs, (x - 50, y - 50, x + 50, y + 50), "")


@pytest.mark.parametrize(
    ("crs", "x", "y", "metres"),
    [
        # cos(51 degrees) is 0.6293; on the ellipsoid it is 0.6292 to 0.6306.
        ("EPSG:3857", 1_113_195, 6_621_294, "0.629"),
        ("EPSG:3395", 1_113_195, 6_588_000, "0.631"),
        ("EPSG:6933", 964_862, 5_700_000, "0.727 to 1.38"),
        ("EPSG:4087", 1_113_195, 5_677_294, "0.631 to 0.999"),
        ("EPSG:3035", 2_700_000, 1_950_000, "0.987 to 1.01"),  # Lisbon, far from the centre of the projection
    ],
)
def test_metres_that_are_none_on_the_ground_are_refused_with_the_zone(crs, x, y, metres):
    bounds = (x - 50.0, y - 50.0, x + 50.0, y + 50.0)
    zone = "EPSG:32629" if crs == "EPSG:3035" else "EPSG:32632"
    with pytest.raises(CatalogError) as error:
        require_scale("dsm.tif", crs, bounds, "use {zone}")
    text = str(error.value)
    assert text.startswith(f"dsm.tif: a metre of {crs} is {metres} m on the ground at longitude ")
    assert text.endswith(f"; use {zone}")


def test_eastings_with_the_number_of_the_zone_are_no_place_in_a_crs_without():
    with pytest.raises(
        CatalogError, match="dsm: 32500000 5600000 is no place in EPSG:25832; declare EPSG:4647"
    ):
        require_scale("dsm", "EPSG:25832", (32_499_999, 5_599_999, 32_500_001, 5_600_001), "")


@pytest.mark.parametrize(
    ("declared", "given", "bounds", "expected"),
    [
        ("EPSG:4326", "EPSG:25832", METRES, "EPSG:25832"),
        ("EPSG:4326", "EPSG:25832", (9.9, 50.5, 10.1, 50.6), "EPSG:4326"),
        ("EPSG:4326", "EPSG:25832", UNKNOWN, "EPSG:4326"),
        ("EPSG:4326", None, METRES, "EPSG:4326"),
        ("EPSG:25833", "EPSG:25832", METRES, "EPSG:25833"),
        (None, "EPSG:25832", METRES, "EPSG:25832"),
        (None, None, METRES, None),
    ],
)
def test_given_crs_replaces_one_in_degrees_that_cannot_be(declared, given, bounds, expected):
    assert crs_of(declared, given, bounds) == expected


@pytest.mark.parametrize(
    ("crs", "bounds", "expected"),
    [
        ("EPSG:4326", METRES, "has the CRS EPSG:4326, but 500105 is no longitude"),
        ("EPSG:4326", (35.0, 139.0, 36.0, 140.0), "has the CRS EPSG:4326, but 140 is no latitude"),
        ("EPSG:4326", (-180.25, -90.25, 180.25, 90.25), None),
        ("EPSG:4807", (0.0, 54.0, 2.0, 99.0), None),  # grads, of which 100 are a right angle
        ("EPSG:25832", METRES, None),
        ("EPSG:4326", UNKNOWN, None),
    ],
)
def test_angle_fault_names_the_value_that_is_no_angle(crs, bounds, expected):
    assert angle_fault(crs, bounds) == expected


SHIFTED = "its eastings differ by {}32000000, the number of a zone: {}"
SWAPPED = "its axes are swapped: give easting before northing"


@pytest.mark.parametrize(
    ("crs", "x", "y", "side", "why"),
    [
        ("EPSG:25832", 32_500_000, 5_600_000, 100, SHIFTED.format("", "declare EPSG:4647")),
        ("EPSG:4647", 500_000, 5_600_000, 100, SHIFTED.format("-", "move it by 32000000 m")),
        ("EPSG:25832", 5_600_000, 500_000, 100, SWAPPED),
        ("EPSG:4326", 50.551, 9, 0.001, SWAPPED),
        ("EPSG:25832", 9, 50.551, 0.001, "its coordinates are degrees: declare EPSG:4326"),
        ("EPSG:25832", 600_000, 5_600_000, 100, "correct its CRS"),
    ],
)
def test_layer_elsewhere_is_named_with_both_places_and_the_known_mistake(crs, x, y, side, why):
    bounds = (x, y, x + side, y + side)
    text = elsewhere(crs, bounds, "EPSG:25832", (500_000.0, 5_600_000.0, 500_250.0, 5_600_250.0), 200.0)
    place = " ".join(f"{value:.10g}" for value in bounds)
    tiles = "the tiles at 500000 5600000 500250 5600250 in EPSG:25832"
    assert text == f"lies at {place} in {crs}, {tiles}; {why}"


@pytest.mark.parametrize(
    ("crs", "expected"),
    [
        ("EPSG:25832", None),
        ("EPSG:25832+7837", "EPSG:7837"),
        ("EPSG:2994+6360", "EPSG:5703"),  # NAVD88 in US survey feet: the same datum in metres
        (compound("EPSG:25832", "EPSG:7837"), "EPSG:7837"),
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


def test_parts_name_and_datum_are_those_of_the_register():
    assert in_plan(compound("EPSG:25832", "EPSG:7837")) == "EPSG:25832"
    assert (name("EPSG:27700"), name("EPSG:7837")) == ("OSGB36 / British National Grid", "DHHN2016 height")
    assert datum("EPSG:7837") == "Deutsches Haupthoehennetz 2016"


def test_esri_is_read_as_the_same_crs():
    text = esri("EPSG:25832")
    assert "\n" not in text
    assert text.startswith('PROJCS["ETRS_1989_UTM_Zone_32N"')
    assert CRS(text).to_epsg(20) == 25832
