"""Centre lines have what the attributes of a table say of width, lanes, direction and name."""

import contextlib
import sqlite3

import geopandas
import numpy as np
import pytest
import shapely

from flexroad.tasks.roads.rasterise import Options
from flexroad.tasks.types import Source
from flexroad.tools.export.network import from_table, read_centre_lines
from tests.make_roads import GRID, on_grid, write

ALONG = shapely.LineString([(0, 0), (10, 0), (20, 5)])


def table(shapes, **columns):
    return geopandas.GeoDataFrame(columns or {"id": range(len(shapes))}, geometry=list(shapes), crs=GRID.crs)


def only(**values):
    (line,) = from_table(table([ALONG], **{name: [value] for name, value in values.items()}), Options()).lines
    return line


@pytest.mark.parametrize(
    ("values", "known"),
    [
        (
            {"highway": "residential", "lanes": "2", "oneway": "yes", "name": "Hauptstraße"},
            (7.0, 2, True, "Hauptstraße"),
        ),
        ({"id": 1}, (6.0, None, False, "")),
    ],
)
def test_from_table_has_the_attributes_or_the_default_width(values, known):
    line = only(**values)
    assert (line.width_m, line.lanes, line.oneway, line.name) == known
    assert line.points.tolist() == [[0, 0], [10, 0], [20, 5]]


@pytest.mark.parametrize(
    ("values", "oneway", "first"),
    [
        ({"oneway": "-1"}, True, 20),
        ({"oneway": "F"}, True, 0),
        ({"oneway": "T"}, True, 20),
        ({"oneway": "B"}, False, 0),
        ({"rijrichtng": "H"}, True, 0),
        ({"rijrichtng": "T"}, True, 20),
        ({"oneway": "reversible"}, False, 0),
        ({"highway": "motorway"}, True, 0),
        ({"highway": "motorway", "oneway": "no"}, False, 0),
        ({"highway": "primary", "junction": "roundabout"}, True, 0),
        ({"highway": "primary", "oneway": None}, False, 0),
    ],
)
def test_from_table_direction_of_traffic_is_that_of_the_line(values, oneway, first):
    line = only(**values)
    assert (line.oneway, line.points[0, 0]) == (oneway, first)


def test_from_table_areas_and_other_ways_are_left_out():
    shapes = [ALONG, ALONG, shapely.box(0, 0, 5, 5), shapely.MultiLineString([ALONG, ALONG.reverse()])]
    found = from_table(table(shapes, highway=["service", "footway", "service", "track"]), Options())
    assert [line.width_m for line in found.lines] == [4.0, 3.0, 3.0]
    assert found.areas == 1


def test_read_centre_lines_equal_lines_of_two_files_are_one(tmp_path):
    line, other = (shapely.LineString(on_grid((10, y), (90, y))) for y in (20, 50))
    far = shapely.LineString(on_grid((10, 9000), (90, 9000)))
    paths = (write(tmp_path / "a.gpkg", [line, far]), write(tmp_path / "b.gpkg", [line, other]))
    found = read_centre_lines({Source("roads", paths): GRID.bounds}, GRID.crs, Options())
    np.testing.assert_allclose([part.points[0] for part in found.lines], on_grid((10, 20), (10, 50)))


@pytest.mark.parametrize("suffix", ["shp", "fgb"])
def test_read_centre_lines_are_selected_by_any_column(suffix, tmp_path):
    shapes = [shapely.LineString(on_grid((0, y), (90, y))) for y in (20, 60)]
    path = write(tmp_path / f"a.{suffix}", shapes, surface=["gravel", "asphalt"])
    found = read_centre_lines(
        {Source("roads", (path,)): GRID.bounds}, GRID.crs, Options(where="surface = 'asphalt'")
    )
    (line,) = found.lines
    assert line.points.tolist() == [list(place) for place in on_grid((0, 60), (90, 60))]


def with_name(path, data):
    """A line whose name has these bytes, declared as UTF-8."""
    more = {} if path.suffix == ".shp" else {"layer_options": {"SPATIAL_INDEX": "NO"}}
    line = shapely.LineString(on_grid((0, 20), (90, 20)))
    table([line], name=["x" * len(data)]).to_file(path, **more)
    if path.suffix == ".shp":
        dbf = path.with_suffix(".dbf")
        dbf.write_bytes(dbf.read_bytes().replace(b"x" * len(data), data))
        path.with_suffix(".cpg").write_text("UTF-8")
    else:
        with contextlib.closing(sqlite3.connect(path)) as file:
            file.execute("UPDATE a SET name = CAST(? AS TEXT)", (data,))
            file.commit()
    return path


@pytest.mark.parametrize("suffix", ["shp", "gpkg"])
@pytest.mark.parametrize("data", ["Königsstraße".encode("cp1252"), b"Stra\xdfe \x81"])
def test_name_in_another_encoding_than_declared_is_read_with_a_note(suffix, data, tmp_path):
    """A byte that cp1252 does not have is latin1's, and GDAL leaves it out of a Shapefile's text."""
    path = with_name(tmp_path / f"a.{suffix}", data)
    found = read_centre_lines({Source("roads", (path,)): GRID.bounds}, GRID.crs, Options())
    encoding = "latin1" if b"\x81" in data and suffix == "gpkg" else "cp1252"
    text = data.decode("latin1")
    assert [line.name for line in found.lines] == [text if suffix == "gpkg" else text.removesuffix(" \x81")]
    (note,) = [note for note in found.notes if "encoding" in note]
    assert note.startswith(f"roads: the text of {path.name} is not in the encoding that it declares")
    assert f"was read as {encoding};" in note


def test_levels_are_read_and_tunnels_kept_if_they_are_asked_for():
    columns = {
        "highway": ["primary"] * 4,
        "bridge": ["yes", None, None, None],
        "tunnel": [None, "yes", None, None],
        "layer": ["2", None, "1", None],
        "level": [None, None, None, "7"],
    }
    streets = table([ALONG] * 4, **columns)
    plain = from_table(streets, Options())
    assert [line.level for line in plain.lines] == [0, 0, 0]
    found = from_table(streets, Options(), levels=True)
    assert [line.level for line in found.lines] == [2, -1, 0, 0]
    assert any("cannot be read as levels" in note for note in found.notes)
    assert found.lines[0].reverse.level == 2
