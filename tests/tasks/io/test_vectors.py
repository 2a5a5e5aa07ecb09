"""Features from others: a coordinate that is no place costs its feature, nothing more."""

import geopandas
import numpy as np
import pytest
import shapely

from flexroad.tasks import TaskError, memory
from flexroad.tasks.io.vectors import Query, has_place, read_near
from tests.make_roads import write_osm

CRS = "EPSG:25832"
BOUNDS = (399_000.0, 5_699_000.0, 400_080.0, 5_700_100.0)
GOOD = shapely.box(400_010, 5_700_010, 400_030, 5_700_050)


def write(path, number, crs):
    """Write a good road between two with a coordinate that is no place; they cross the borders of squares."""
    corners = [(399_000, 5_699_000), (400_050, number), (405_000, 5_710_000)]
    shapes = geopandas.GeoSeries([shapely.LineString(corners), GOOD, shapely.Polygon(corners)], crs=CRS)
    if crs != CRS:
        degrees = [(7.55, 51.43), (7.56, number), (7.65, 51.6)]
        good = shapes.iloc[[1]].to_crs(crs).iloc[0]
        shapes = geopandas.GeoSeries([shapely.LineString(degrees), good, shapely.Polygon(degrees)], crs=crs)
    geopandas.GeoDataFrame({"id": [1, 2, 3]}, geometry=shapes).to_file(path)
    return Query(path, None, None, ("id",), None, CRS)


@pytest.mark.parametrize("crs", [CRS, "EPSG:4326"])
@pytest.mark.parametrize("suffix", ["gpkg", "fgb", "geojson"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e300])
def test_coordinate_that_is_no_place_costs_its_feature(tmp_path, number, suffix, crs):
    assert list(read_near(write(tmp_path / f"a.{suffix}", number, crs), BOUNDS)["id"]) == [2]


def test_file_to_be_read_as_a_whole_is_compared_with_memory(tmp_path, monkeypatch):
    query = write(tmp_path / "a.fgb", np.nan, "EPSG:4326")
    monkeypatch.setattr(memory, "limit", lambda: 100)
    with pytest.raises(
        TaskError, match=r"a.fgb, read as a whole, would need .*remove features with infinite"
    ):
        read_near(query, BOUNDS)


def test_has_place_looks_at_every_coordinate():
    lines = [shapely.LineString([(0, 0), (1, y), (2, 2)]) for y in (1, np.nan, np.inf, 1e12)]
    assert list(has_place(np.array([*lines, shapely.Point(), GOOD], object))) == [
        True,
        *[False] * 3,
        True,
        True,
    ]


@pytest.mark.parametrize("suffix", ["gpkg", "fgb", "geojson", "shp"])
@pytest.mark.parametrize(
    "where", ["kind = 'road'", "KIND = 'road'", "\"Kind\" LIKE 'ro%' AND lanes > 1", "lanes = 2 OR id = 7"]
)
def test_condition_may_name_columns_that_are_not_read(suffix, where, tmp_path):
    shapes = [shapely.box(400_000 + x, 5_700_010, 400_005 + x, 5_700_020) for x in (0, 10, 20)]
    columns = {"id": [1, 2, 3], "Kind": ["path", "road", None], "lanes": [1, 2, 3]}
    path = tmp_path / f"a.{suffix}"
    geopandas.GeoDataFrame(columns, geometry=shapes, crs=CRS).to_file(path)
    table = read_near(Query(path, None, where, ("id",), None, CRS), BOUNDS)
    assert list(table["id"]) == [2]
    assert sorted(table.columns) == ["geometry", "id"]


def test_condition_on_osm_file_may_name_columns_that_are_not_read(tmp_path):
    ways = {"highway=path;man_made=pier": (7.56, 51.43), "highway=path": (7.57, 51.44)}
    path = tmp_path / "map.osm"
    write_osm(path, {tags: [place, (place[0] + 0.01, place[1])] for tags, place in ways.items()})

    def read(where):
        return read_near(Query(path, None, where, ("highway",), None, CRS), (0, 0, 1e7, 1e7))

    assert len(read(None)) == 2
    assert list(read("man_made = 'pier'")["highway"]) == ["path"]
    assert list(read("man_made = 'pier'").columns) == list(read(None).columns)
