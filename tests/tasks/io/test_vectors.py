"""Features from others: a coordinate that is no place costs its feature, nothing more."""

import contextlib
import shutil
import sqlite3
from dataclasses import replace

import geopandas
import numpy as np
import pytest
import shapely

from flexroad.tasks import TaskError, memory
from flexroad.tasks.io.vectors import Query, read_near
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
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e300, 1e12])
def test_coordinate_that_is_no_place_costs_its_feature(tmp_path, number, suffix, crs):
    assert list(read_near(write(tmp_path / f"a.{suffix}", number, crs), BOUNDS)["id"]) == [2]


def test_file_to_be_read_as_a_whole_is_compared_with_memory(tmp_path, monkeypatch):
    query = write(tmp_path / "a.fgb", np.nan, "EPSG:4326")
    monkeypatch.setattr(memory, "limit", lambda: 100)
    with pytest.raises(
        TaskError, match=r"a.fgb, read as a whole, would need .*remove features with infinite"
    ):
        read_near(query, BOUNDS)


ROADS = [shapely.box(399_000 + x, 5_699_500, 399_004 + x, 5_699_510) for x in range(0, 1000, 10)]
AROUND = (398_990.0, 5_699_400.0, 399_500.0, 5_699_600.0)
STALE = {
    "rows are missing": ["DELETE FROM {index} WHERE {id} > 20"],
    "rows are missing and others are too many": [
        "UPDATE {index} SET {id} = {id} + 1000 WHERE {id} BETWEEN 20 AND 40"
    ],
    "rows are elsewhere": [
        "CREATE TEMP TABLE old AS SELECT * FROM {index} WHERE {id} > 20",
        "DELETE FROM {index} WHERE {id} > 20",
        "INSERT INTO {index} SELECT {id}, 0, 1, 0, 1 FROM old",
    ],
    "is empty": ["DELETE FROM {index}"],
}


def roads(path, **options):
    table = geopandas.GeoDataFrame({"id": range(len(ROADS))}, geometry=ROADS, crs=CRS)
    table.to_file(path, layer="roads", engine="pyogrio", SPATIAL_INDEX="YES", **options)
    return Query(path, None, None, ("id",), None, CRS)


def change(path, statements):
    with contextlib.closing(sqlite3.connect(path)) as file:
        for statement in statements:
            file.execute(statement)
        file.commit()


@pytest.mark.parametrize("statements", STALE.values(), ids=STALE)
@pytest.mark.parametrize("kind", ["gpkg", "sqlite"])
def test_roads_that_an_index_hides_are_read(tmp_path, statements, kind):
    path = tmp_path / f"a.{kind}"
    query = roads(path, **({"driver": "SQLite", "SPATIALITE": "YES"} if kind == "sqlite" else {}))
    names = {"gpkg": ("rtree_roads_geom", "id"), "sqlite": ("idx_roads_GEOMETRY", "pkid")}
    index, key = names[kind]
    change(path, [statement.format(index=index, id=key) for statement in statements])
    assert sorted(read_near(query, AROUND)["id"]) == list(range(51))


def test_roads_of_a_view_that_an_index_hides_are_read(tmp_path):
    query = roads(tmp_path / "a.gpkg")
    copied = "SELECT 'v', {} FROM {} WHERE table_name = 'roads'"
    columns = "column_name, geometry_type_name, srs_id, z, m"
    statements = [
        *STALE["rows are missing"],
        "CREATE VIEW v AS SELECT fid, geom, id FROM roads",
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
        + copied.format("'features', 'v', srs_id", "gpkg_contents"),
        "INSERT INTO gpkg_geometry_columns " + copied.format(columns, "gpkg_geometry_columns"),
    ]
    change(query.path, [statement.format(index="rtree_roads_geom", id="id") for statement in statements])
    assert sorted(read_near(replace(query, layer="v"), AROUND)["id"]) == list(range(51))


def test_roads_of_a_shapefile_with_an_old_index_are_read(tmp_path):
    """The index is of roads elsewhere: other programs do not remove it when they edit the Shapefile."""
    other = tmp_path / "other.shp"
    moved = geopandas.GeoSeries(ROADS).translate(5000, 5000)
    geopandas.GeoDataFrame({"id": range(len(ROADS))}, geometry=moved, crs=CRS).to_file(
        other, SPATIAL_INDEX="YES"
    )
    query = roads(tmp_path / "a.shp")
    shutil.copyfile(other.with_suffix(".qix"), tmp_path / "a.qix")
    assert sorted(read_near(query, AROUND)["id"]) == list(range(51))


def test_file_with_an_index_that_lacks_roads_is_compared_with_memory(tmp_path, monkeypatch):
    query = roads(tmp_path / "a.gpkg")
    change(query.path, ["DELETE FROM rtree_roads_geom WHERE id = 1"])
    monkeypatch.setattr(memory, "limit", lambda: 100)
    with pytest.raises(TaskError, match=r"a.gpkg, read as a whole because its spatial index may lack"):
        read_near(query, BOUNDS)


def test_complete_index_is_used(tmp_path, monkeypatch):
    query = roads(tmp_path / "a.gpkg")
    monkeypatch.setattr(memory, "limit", lambda: 100)
    assert sorted(read_near(query, AROUND)["id"]) == list(range(51))


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
