"""The commands of docs/levels.md that give roads of other data sets a level, run by GDAL on small files."""

import re
import shlex
from pathlib import Path

import geopandas
import pyogrio
import pytest
from shapely import LineString, box

from flexroad.tasks.roads.attributes import level_numbers

PAGE = Path(__file__).parents[3] / "docs" / "levels.md"
COMMANDS = [
    shlex.split(line)
    for line in re.findall(r"^ogr2ogr .*", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
]


@pytest.fixture
def converted(tmp_path, monkeypatch):
    """Run the command that reads a file with some layers; return the roads that it writes."""
    monkeypatch.chdir(tmp_path)

    def run(source: str, crs: str, **layers):
        for name, (geometry, columns) in layers.items():
            table = geopandas.GeoDataFrame(columns, geometry=geometry, crs=crs)
            pyogrio.write_dataframe(table, source, layer=name)
        (words,) = (words for words in COMMANDS if words[2] == source)
        options = dict(zip(words[3::2], words[4::2], strict=True))
        assert options.keys() == {"-nln", "-dialect", "-sql"}
        sql, dialect = options["-sql"], options["-dialect"]
        return pyogrio.read_dataframe(source, sql=sql, sql_dialect=dialect)

    return run


def places(roads):
    """Return the levels of features by their bounds."""
    numbers, notes = level_numbers(roads.rename(columns=str.lower))
    assert notes == ()
    parts = zip(roads.geometry, numbers.tolist(), strict=True)
    return {tuple(round(edge, 6) for edge in part.bounds): number for part, number in parts}


def test_bgt_bridge_below_its_street_becomes_level_1(converted):
    """A street of level 0 lies on a deck of -1, and the street below it is cut along the deck."""
    streets = [box(0, 40, 100, 48), box(45, 0, 55, 39), box(45, 39, 55, 49), box(45, 49, 55, 100)]
    roads = converted(
        "bgt.gpkg",
        "EPSG:28992",
        wegdeel=(streets, {"bgt_functie": 4 * ["rijbaan"], "relatievehoogteligging": [0, 0, -1, 0]}),
        overbruggingsdeel=(
            [box(40, 39, 60, 49), box(49, 43, 50, 44)],
            {"class": ["dek", "pijler"], "relatievehoogteligging": [-1, -1]},
        ),
    )
    assert places(roads) == {
        (0, 40, 100, 48): 0,
        (45, 0, 55, 39): 0,
        (45, 39, 55, 49): 0,
        (45, 49, 55, 100): 0,
        (40, 39, 60, 49): 1,
    }
    street = roads.geometry[0]
    assert street.area == 8 * 80
    assert not street.intersects(box(41, 41, 59, 47))


def test_bgt_bridge_above_its_street_keeps_the_levels(converted):
    parts = [box(0, 40, 40, 48), box(40, 40, 60, 48), box(45, 0, 55, 100)]
    roads = converted(
        "bgt.gpkg",
        "EPSG:28992",
        wegdeel=(parts, {"bgt_functie": 3 * ["rijbaan"], "relatievehoogteligging": [0, 1, -2]}),
        overbruggingsdeel=([box(40, 39, 60, 49)], {"class": ["dek"], "relatievehoogteligging": [2]}),
    )
    assert places(roads) == {
        (0, 40, 40, 48): 0,
        (40, 40, 60, 48): 1,
        (45, 0, 55, 100): -2,
        (40, 39, 60, 49): 2,
    }
    assert roads.geometry[2].equals(parts[2])


def test_atkis_road_on_a_bridge_becomes_level_1(converted):
    lines = [
        LineString([(0, 44), (40, 44)]),
        LineString([(40, 44), (60, 44)]),
        LineString([(50, 0), (50, 100)]),
    ]
    roads = converted(
        "atkis.gpkg",
        "EPSG:25832",
        ax_strassenachse=(lines, {"brf": [7.0, 7.5, 6.0]}),
        ax_bauwerkimverkehrsbereich=(
            [box(40, 39, 60, 49), box(0, 40, 30, 48)],
            {"bauwerksfunktion": [1800, 1845]},
        ),
    )
    assert places(roads) == {(0, 44, 40, 44): 0, (40, 44, 60, 44): 1, (50, 0, 50, 100): 0}
    assert roads.brf.tolist() == [7.0, 7.5, 6.0]


def test_every_conversion_of_the_page_has_a_test():
    assert [words[2] for words in COMMANDS] == ["bgt.gpkg", "atkis.gpkg"]
