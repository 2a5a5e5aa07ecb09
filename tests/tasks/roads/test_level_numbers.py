import numpy as np
import pandas
import pytest
import shapely

from flexroad.tasks.io.vectors import Query, read_near
from flexroad.tasks.roads.attributes import LEVEL_COLUMNS, level_numbers
from flexroad.tools.synthetic.crossings import Crossings
from tests.make_town import CRS, OPTIONS, write_streets


def numbers(rows: list[dict]) -> list[int]:
    """Return the levels of some rows that all can be read."""
    levels, notes = level_numbers(pandas.DataFrame(rows))
    assert notes == ()
    return levels.tolist()


def one(**row) -> int:
    """Return the level of one row; missing values and notes are the table's."""
    return numbers([row])[0]


@pytest.mark.parametrize(
    ("tags", "level"),
    [
        ({"bridge": "yes"}, 1),
        ({"bridge": "yes", "layer": "1"}, 1),
        ({"bridge": "viaduct", "layer": "2"}, 2),
        ({"bridge": "yes", "layer": "0"}, 1),
        ({"bridge": "yes", "layer": "-1"}, 1),
        ({"bridge": "yes", "layer": "1;2"}, 1),
        ({"bridge": "yes", "layer": None}, 1),
        ({"bridge": "no", "layer": "1"}, 0),
        ({"tunnel": "yes"}, -1),
        ({"tunnel": "yes", "layer": "-2"}, -2),
        ({"tunnel": "building_passage", "layer": "0"}, -1),
        ({"tunnel": "no", "layer": "-1"}, 0),
        ({"covered": "yes"}, 0),
        ({"covered": "yes", "layer": "1"}, 0),
        ({"covered": "yes", "layer": "-1"}, -1),
        ({"layer": "3"}, 0),
        ({"highway": "primary"}, 0),
        # The extracts of Geofabrik have letters, and layers as numbers.
        ({"bridge": "T", "tunnel": "F", "layer": 2}, 2),
        ({"bridge": "F", "tunnel": "T", "layer": -1}, -1),
    ],
)
def test_level_numbers_osm(tags, level):
    assert one(**tags) == level


@pytest.mark.parametrize(
    ("row", "level"),
    [
        # BGT, Netherlands
        ({"relatievehoogteligging": 1}, 1),
        ({"relatievehoogteligging": -1}, -1),
        ({"relatieve_hoogteligging": "0"}, 0),
        # BD TOPO, France
        ({"position_par_rapport_au_sol": "1"}, 1),
        ({"position_par_rapport_au_sol": "-1"}, -1),
        ({"pos_sol": "Gué ou radier"}, 0),
        # swissTLM3D
        ({"kunstbaute": "Keine"}, 0),
        ({"kunstbaute": "Bruecke"}, 1),
        ({"kunstbaute": "Brücke"}, 1),
        ({"kunstbaute": "Gedeckte Bruecke"}, 1),
        ({"kunstbaute": "Unterführung mit Treppe"}, -1),
        ({"kunstbaute": "Tunnel"}, -1),
        ({"kunstbaute": "Staumauer"}, 0),
        ({"kunstbaute": "Bruecke", "stufe": 2}, 2),
        ({"kunstbaute": "Bruecke", "stufe": 999998}, 1),
        # ATKIS and ALKIS, Germany
        ({"bauwerksfunktion": 1800}, 1),
        ({"bauwerksfunktion": 1830.0}, 1),
        ({"bwf": "1870"}, -1),
        ({"bwf": "1840"}, 0),
        # INSPIRE
        ({"verticalposition": "suspendedOrElevated"}, 1),
        ({"verticalposition": "onGroundSurface"}, 0),
        ({"verticalposition": "http://inspire.ec.europa.eu/codelist/VerticalPositionValue/underground"}, -1),
        # drawn by hand
        ({"level": 2}, 2),
        ({"level": "+1"}, 1),
        ({"level": " -1.0 "}, -1),
        ({"level": "1,0"}, 1),
        ({"level": -5}, -5),
        ({"level": 1.0}, 1),
    ],
)  # fmt: skip
def test_level_numbers_other_data_sets(row, level):
    assert one(**row) == level


@pytest.mark.parametrize("missing", [None, np.nan, "", " ", pandas.NA])
def test_level_numbers_no_value_takes_the_next_column(missing):
    assert one(level=missing, relatievehoogteligging=2) == 2
    assert one(level=missing, kunstbaute="Tunnel") == -1
    assert one(level=missing) == 0


@pytest.mark.parametrize("bad", [7, -6, "1;2", "upper", 0.5, "1e0", True])
def test_level_numbers_unreadable_number_is_not_used_and_noted(bad):
    table = pandas.DataFrame({"level": [1, bad, bad], "verticalposition": [None, "underground", None]})
    levels, notes = level_numbers(table.astype(object))
    assert levels.tolist() == [1, -1, 0]
    assert notes == (
        f"2 values of the column level cannot be read as levels of roads ({str(bad)!r}): not used; "
        "correct them, or name the level in a column `level`",
    )


def test_level_numbers_unknown_word_is_noted():
    levels, (note,) = level_numbers(pandas.DataFrame({"kunstbaute": ["200", "Bruecke"]}))
    assert levels.tolist() == [0, 1]
    assert note.startswith("1 value of the column kunstbaute cannot be read as levels of roads ('200')")


def test_level_numbers_order_of_columns():
    assert one(bridge="yes", level=0) == 1
    assert one(bridge="no", level=2) == 2
    assert one(level=0, pos_sol=1) == 0
    assert one(level=0, kunstbaute="Bruecke") == 0


def test_level_numbers_mixed_rows_and_empty_table():
    rows = [{"bridge": "yes", "layer": "2"}, {"level": 1.0}, {}, {"kunstbaute": "Tunnel"}]
    assert numbers(rows) == [2, 1, 0, -1]
    levels, notes = level_numbers(pandas.DataFrame({"level": []}))
    assert levels.shape == (0,)
    assert levels.dtype == np.int64
    assert notes == ()


def test_level_numbers_of_an_osm_file_are_those_of_its_decks_and_tunnels(tmp_path):
    """GDAL packs most of the tags into one column."""
    around = (500_000, 5_600_000, 500_500, 5_600_500)
    query = Query(write_streets(tmp_path / "town.osm", around), None, None, LEVEL_COLUMNS, None, CRS)
    town = read_near(query, around)
    levels, notes = level_numbers(town)
    assert notes == ()
    assert len(town) >= 30
    assert set(levels) == {-1, 0, 1}
    world = Crossings(1, OPTIONS)
    for level in (-1, 1):
        areas = world.areas(level, around)
        on_it = [shapely.contains(areas, line.centroid).any() for line in town.geometry[levels == level]]
        assert on_it
        assert all(on_it)
