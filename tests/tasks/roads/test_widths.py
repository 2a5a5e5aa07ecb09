import math

import numpy as np
import pandas
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from shapely import LineString

from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.attributes import Options, metres, widths
from flexroad.tasks.roads.rasterise import roads
from tests.make_roads import GRID, on_grid, tile, write


@pytest.mark.parametrize(
    ("text", "width"),
    [
        ("7.5", 7.5),
        ("7,5", 7.5),
        (" 2 m ", 2.0),
        ("2m", 2.0),
        ("3 Meters", 3.0),
        ("350 cm", 3.5),
        ("7 ft", 2.1336),
        ("24'", 7.3152),
        ("24'6\"", 7.4676),
        ("24’ 6”", 7.4676),
        ("24 ft 6 in", 7.4676),
        ("30\"", 0.762),
        (".5", 0.5),
        ("6.", 6.0),
    ],
)  # fmt: skip
def test_metres_common_notations(text, width):
    assert metres(text) == pytest.approx(width, abs=1e-9)


@pytest.mark.parametrize(
    "text", ["", "wide", "3-4", "3;4", "-5", "~5", "5 km/h", "1e3", "6'7", "m", "5 6", "."]
)
def test_metres_not_a_width_is_nan(text):
    assert math.isnan(metres(text))


@given(
    st.floats(0.01, 99), st.sampled_from([("", 1), (" m", 1), ("cm", 0.01), ("ft", 0.3048), ("'", 0.3048)])
)
def test_metres_any_number_and_unit(number, unit):
    assert metres(f"{number:.3f}{unit[0]}") == pytest.approx(round(number, 3) * unit[1])


@given(st.text())
def test_metres_any_text_gives_nan_or_positive(text):
    width = metres(text)
    assert math.isnan(width) or width >= 0


def test_widths_from_width_lanes_class_or_default():
    table = pandas.DataFrame(
        {
            "width": ["7.5", None, "0", "wide", None, "80", "0.5"],
            "width_m": [9.0, np.nan, np.nan, np.nan, 4.5, np.nan, np.nan],
            "lanes": ["2", "3", "2", "many", "2", None, "0"],
        }
    )
    classes = ["primary"] * 3 + ["service", "service", "service", "service"]
    options = Options(class_width_m={"service": 3.5})
    result, notes = widths(table, classes, options)
    assert result.tolist() == [7.5, 10.25, 7.0, 3.5, 4.5, 40.0, 2.0]
    assert notes == ("1 widths of lines cannot be read ('wide'): lanes or class are used instead",)


def test_widths_lines_without_attributes_are_noted():
    result, notes = widths(pandas.DataFrame(index=range(3)), ["residential", "", "aisle"], Options())
    assert result.tolist() == [5.5, 6.0, 6.0]
    assert notes == ("2 of 3 lines have no width, lanes or known class: taken as 6 m wide",)


def test_widths_without_unit_may_be_feet():
    table = pandas.DataFrame({"surf_width": [24, 30], "width": ["7 m", "20"]})
    result, _ = widths(table, ["", ""], Options(width_unit="ft", width_columns=("width", "SURF_WIDTH")))
    assert result == pytest.approx([7.0, 6.096])


def test_class_widths_replace_built_in_ones():
    options = Options(class_width_m={"service": 3.5})
    assert options.class_width_m == Options().class_width_m | {"service": 3.5}
    with pytest.raises(ValidationError, match="above 0"):
        Options(class_width_m={"service": 0})


ROADS = {
    "OSM": {
        "highway": ["residential", "primary", "tertiary", "service", "footway"],
        "width": ["6.1", None, None, None, "2"],
        "est_width": [None, "9", None, None, None],
        "lanes": [None, "4", "2", None, None],
    },
    # Shapefiles shorten the names of attributes; 9998 is "not known".
    "ATKIS": {
        "BRF": [6.5, 0, 9998, 0, 0],
        "FSZ": [2, 2, 0, 0, 9998],
        "BRV": [12, 12, 9, 6, 9998],
    },
    "ATKIS in full": {
        "breiteDerFahrbahn": ["6.5", None, None, None, None],
        "anzahlDerFahrstreifen": [None, 2, None, None, None],
        "breiteDesVerkehrsweges": [None, 12, 9, 6, None],
    },
    "TIGER": {"MTFCC": ["S1100", "S1200", "S1400", "S1730", "S1820"], "FULLNAME": list("abcde")},
    "NWB": {"BST_CODE": ["RB", "RB", "HR", "OPR", "FP"], "WVK_ID": [1, 2, 3, 4, 5]},
}
EXPECTED = {
    # Measured, estimated, two lanes of 3.25 m with 0.25 m beside them, by class; a footway is no road.
    "OSM": [6.1, 9, 7, 4],
    # Carriageway, lanes, the middle of 6 to 9 m and of 0 to 6 m, the default.
    "ATKIS": [6.5, 7, 7.5, 3, 6],
    "ATKIS in full": [6.5, 7, 7.5, 3, 6],
    "TIGER": [11.5, 9, 8, 4.5],
    "NWB": [6, 6, 6, 6],
}


@pytest.mark.parametrize("name", ROADS)
def test_widths_by_the_attributes_of_a_dataset(tmp_path, name):
    """Five parallel roads of 80 m in a file with the columns of each dataset."""
    lines = [LineString(on_grid((10, 10 + 18 * k), (90, 10 + 18 * k))) for k in range(5)]
    path = write(tmp_path / "r.gpkg", lines, **ROADS[name])
    found = roads(tile(path).roads, GRID, rasterise.Options())
    assert sorted(shapely.area(found.areas) / 80) == pytest.approx(sorted(EXPECTED[name]))


def test_foot_and_bike_paths_of_bgt_are_no_roads(tmp_path):
    kinds = ["rijbaan lokale weg", "voetpad", "fietspad", "parkeervlak", "voetgangersgebied"]
    areas = [shapely.box(*on_grid((10, 10 + 18 * k))[0], *on_grid((90, 15 + 18 * k))[0]) for k in range(5)]
    path = write(tmp_path / "bgt.gpkg", areas, bgt_functie=kinds)
    assert len(roads(tile(path).roads, GRID, rasterise.Options()).areas) == 2
