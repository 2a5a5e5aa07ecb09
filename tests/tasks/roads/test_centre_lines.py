"""Centre lines have what the attributes of a table say of width, lanes, direction and name."""

import geopandas
import numpy as np
import pytest
import shapely

from flexroad.tasks.roads.centre_lines import from_table, read_centre_lines
from flexroad.tasks.roads.rasterise import Options
from flexroad.tasks.types import Source
from tests.make_roads import GRID, on_grid, write

ALONG = shapely.LineString([(0, 0), (10, 0), (20, 5)])


def table(shapes, **columns):
    return geopandas.GeoDataFrame(columns or {"id": range(len(shapes))}, geometry=list(shapes), crs=GRID.crs)


def only(**values):
    (line,) = from_table(table([ALONG], **{name: [value] for name, value in values.items()}), Options()).lines
    return line


def test_from_table_osm_attributes_are_known():
    line = only(highway="residential", lanes="2", oneway="yes", name="Hauptstraße")
    assert (line.width_m, line.lanes, line.oneway, line.name) == (7.0, 2, True, "Hauptstraße")
    assert line.points.tolist() == [[0, 0], [10, 0], [20, 5]]


def test_from_table_without_attributes_has_the_default_width_alone():
    line = only(id=1)
    assert (line.width_m, line.lanes, line.oneway, line.name) == (6.0, None, False, "")


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
    found = read_centre_lines(Source("roads", paths), GRID.bounds, GRID.crs, Options())
    np.testing.assert_allclose([part.points[0] for part in found.lines], on_grid((10, 20), (10, 50)))


@pytest.mark.parametrize("suffix", ["shp", "fgb"])
def test_read_centre_lines_are_selected_by_any_column(suffix, tmp_path):
    shapes = [shapely.LineString(on_grid((0, y), (90, y))) for y in (20, 60)]
    path = write(tmp_path / f"a.{suffix}", shapes, surface=["gravel", "asphalt"])
    found = read_centre_lines(
        Source("roads", (path,)), GRID.bounds, GRID.crs, Options(where="surface = 'asphalt'")
    )
    (line,) = found.lines
    assert line.points.tolist() == [list(place) for place in on_grid((0, 60), (90, 60))]
