import numpy as np
import pytest
from pyproj import CRS, Transformer

from flexroad.catalog import CatalogError
from flexroad.catalog.crs import in_plan, metric_twin, plan_unit
from flexroad.catalog.scan.point_clouds import inspect
from flexroad.catalog.to_metres import MetricTransform, agreed

OREGON = (637000.0, 852000.0)
COLOGNE = (6.95, 50.94)


def nameless(code: str, shift: float = 0) -> str:
    """The same CRS without its registered names and code; its false northing moved by ``shift``."""
    definition = CRS(code).to_json_dict()
    definition["name"], definition["conversion"]["name"] = "mine", "mine"
    definition.pop("id")
    definition["conversion"]["parameters"][-1]["value"] += shift
    return CRS.from_json_dict(definition).to_wkt()


@pytest.mark.parametrize(
    ("feet", "metres", "place"),
    [
        ("EPSG:2994", "EPSG:2993", OREGON),
        (nameless("EPSG:2994"), "EPSG:2993", OREGON),
        ("EPSG:2263", "EPSG:32118", (1e6, 2e5)),
        ("EPSG:2227+6360", "EPSG:26943", (6e6, 2.1e6)),
        ("EPSG:25832", "EPSG:25832", (356000, 5700000)),
        (nameless("EPSG:25832"), "EPSG:25832", (356000, 5700000)),
    ],
)
def test_projected_crs_target_is_its_twin_in_metres(feet, metres, place):
    assert MetricTransform.of(feet, place).target == metres


def test_metric_twin_not_in_register_is_wkt():
    twin = metric_twin(nameless("EPSG:2994", shift=1000), *OREGON)
    assert plan_unit(twin)[1] == 1
    there = Transformer.from_crs(twin, "EPSG:2993", always_xy=True).transform(200000, 260000)
    assert there == pytest.approx((200000, 260000 - 304.8), abs=1e-5)


def test_feet_to_metres_is_exact_multiplication():
    """PROJ gives the same, up to the digits of the twins' false eastings in the register."""
    frame = MetricTransform.of("EPSG:2994", OREGON)
    x, y, z = np.array([635652.69, 639003.73]), np.array([851377.98, 853537.66]), np.array([407.81, 598.15])
    got = frame.metres(x, y, z)
    assert np.array_equal(got, [x * 0.3048, y * 0.3048, z * 0.3048])
    proj = Transformer.from_crs("EPSG:2994", "EPSG:2993", always_xy=True).transform(x, y)
    assert np.abs(np.array(got[:2]) - proj).max() < 1e-5


def test_us_and_international_foot_differ():
    """2 ppm are 4 m in 6.5 million feet (California)."""
    x, zero = np.array([6.5e6]), np.zeros(1)
    survey = MetricTransform.of("EPSG:2227", (6.5e6, 2.1e6)).metres(x, zero, x)
    assert [survey[0][0], survey[2][0]] == pytest.approx([6.5e6 * 1200 / 3937] * 2, abs=1e-6)
    assert MetricTransform.of("EPSG:2994", OREGON).metres(x, zero, x)[0][0] == 6.5e6 * 0.3048


@pytest.mark.parametrize(
    ("crs", "unit", "metres", "notes"),
    [
        ("EPSG:2994", None, 0.3048, 1),
        ("EPSG:2994", "metre", 1.0, 0),
        ("EPSG:2994", "us-foot", 1200 / 3937, 0),
        ("EPSG:2994+5703", None, 1.0, 0),
        ("EPSG:2263+6360", "us-foot", 1200 / 3937, 0),
        ("EPSG:25832", None, 1.0, 0),
        ("EPSG:25832", "foot", 0.3048, 0),
    ],
)
def test_height_unit_from_crs_or_option(crs, unit, metres, notes):
    frame = MetricTransform.of(crs, OREGON, unit=unit)
    assert frame.height_m == pytest.approx(metres, rel=1e-12)
    assert len(frame.notes) == notes
    assert all("assumed to be in feet, like x and y; if not, use --height-unit" in n for n in frame.notes)


def test_geographic_crs_target_is_utm_zone_of_point():
    frame = MetricTransform.of("EPSG:4326", COLOGNE)
    assert (frame.target, frame.height_m, frame.notes) == ("EPSG:32632", 1.0, ())
    east, north = np.array([COLOGNE[0], 6.96]), np.array([COLOGNE[1], 50.95])
    got = frame.metres(east, north, np.array([50.0, 60.0]))
    want = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(east, north)
    assert np.array_equal(got[:2], want)
    assert np.array_equal(got[2], [50.0, 60.0])


def test_to_crs_overrides_target():
    frame = MetricTransform.of("EPSG:2994", OREGON, to_crs="EPSG:32610")
    x, y = np.array([OREGON[0]]), np.array([OREGON[1]])
    want = Transformer.from_crs("EPSG:2994", "EPSG:32610", always_xy=True).transform(x, y)
    assert np.array_equal(frame.metres(x, y, x)[:2], want)
    assert MetricTransform.of("EPSG:2994", OREGON, to_crs="EPSG:2993").plan_m == 0.3048


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"to_crs": "EPSG:2994"}, "--to-crs EPSG:2994 is in feet; give a projected CRS in metres"),
        ({"to_crs": "EPSG:4326"}, "--to-crs EPSG:4326 is in degrees; give a projected CRS in metres"),
        ({"to_crs": "EPSG:0"}, "unknown CRS 'EPSG:0'"),
        ({"unit": "yard"}, "--height-unit yard: must be one of metre, foot, us-foot"),
        ({"source": "EPSG:2994+5703", "unit": "foot"}, "--height-unit foot, but heights of .* are in metre;"),
        ({"source": "EPSG:4978"}, "neither projected nor geographic; reproject"),
    ],
)
def test_invalid_crs_or_unit_raises_error(arguments, message):
    with pytest.raises(CatalogError, match=message):
        MetricTransform.of(**{"source": "EPSG:2994", "place": OREGON, **arguments})


def test_point_outside_target_crs_raises_error():
    frame = MetricTransform.of("EPSG:4326", COLOGNE, to_crs="EPSG:25832")
    with pytest.raises(
        CatalogError, match="a point at .* in EPSG:4326 has no position in EPSG:25832; .* --to-crs"
    ):
        frame.metres(np.array([7.0]), np.array([95.0]), np.zeros(1))


def test_agreed_mixed_crs_raises_error():
    feet = CRS("EPSG:2994").to_wkt()
    assert in_plan(agreed([("a", feet), ("b", None)], "EPSG:2994")) == "EPSG:2994"
    assert agreed([("a", None), ("b", None)], "EPSG:25832") == "EPSG:25832"
    with pytest.raises(CatalogError, match="b.laz carries no CRS; give it with --crs"):
        agreed([("a.laz", feet), ("b.laz", None)], None)
    with pytest.raises(CatalogError, match="mixed CRS: a.laz is in EPSG:2994, b.laz in EPSG:25832; .* apart"):
        agreed([("a.laz", feet), ("b.laz", "EPSG:25832")], None)
    with pytest.raises(CatalogError, match="mixed CRS: .* b.laz in EPSG:2994 with heights in metre"):
        agreed([("a.laz", feet), ("b.laz", "EPSG:2994+5703")], None)
    with pytest.raises(CatalogError, match="mixed CRS: a.laz is in EPSG:2994, --crs in EPSG:25832; leave"):
        agreed([("a.laz", feet)], "EPSG:25832")


@pytest.mark.real
def test_real_survey_without_code_target_has_code(real_data):
    cloud = inspect(real_data / "autzen" / "autzen_north.laz")
    assert MetricTransform.of(cloud.crs, cloud.bounds[:2]).target == "EPSG:2993"
    assert inspect(real_data / "autzen" / "autzen-thin.las").crs is None
