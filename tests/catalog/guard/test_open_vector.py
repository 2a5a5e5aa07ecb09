"""Vector files are opened only in known formats, none of which leads to other files or to the web."""

import contextlib
import itertools
import json
import os
import sqlite3
import subprocess
import sys

import geopandas
import pyogrio
import pytest
from shapely import LineString

from flexroad.catalog import CatalogError
from flexroad.catalog.guard import vector_contents
from flexroad.catalog.guard.open_vector import vector_name
from flexroad.catalog.guard.source_files import InputRejected
from flexroad.catalog.scan.vectors import opened
from tests.make_rasters import UTM
from tests.make_roads import write

DIAGONAL = LineString([(0, 0), (9, 9)])
LINE = {"type": "LineString", "coordinates": [[7.0, 51.0], [7.1, 51.1]]}
FEATURE = {"type": "Feature", "properties": {"type": "link", "name": "crs"}, "geometry": LINE}
ROADS = {"type": "FeatureCollection", "features": [FEATURE]}
OSM = (
    '<?xml version="1.0"?>\n<osm version="0.6"><note>by hand</note><meta osm_base="2020"/>'
    '<node id="1" lat="51" lon="7"/><node id="2" lat="51.1" lon="7"/>'
    '<way id="3"><nd ref="1"/><nd ref="2"/><tag k="highway" v="service"/></way></osm>'
)


def check_refused(path, content, match):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputRejected, match=match):
        vector_name(path)
    with pytest.raises(CatalogError, match=match):
        opened(path, UTM)


@pytest.mark.parametrize("suffix", ["gpkg", "fgb", "shp", "geojson"])
def test_formats_are_read(tmp_path, suffix):
    path = tmp_path / f"roads.{suffix}"
    write(path, [DIAGONAL])
    assert len(pyogrio.read_dataframe(vector_name(path))) == 1
    assert opened(path, None).extents


@pytest.mark.parametrize("part", ["shp", "shx", "dbf"])
@pytest.mark.parametrize("damage", ["zeroed", "cut off", "empty"])
def test_damaged_part_of_shapefile_is_refused(tmp_path, part, damage):
    """GDAL reads features without geometries, or without attributes, and no error."""
    path = tmp_path / "roads.shp"
    write(path, [LineString([(k, 0), (9, 9)]) for k in range(20)])
    file = path.with_suffix(f".{part}")
    data = file.read_bytes()
    left = {"zeroed": data[:8] + bytes(len(data) - 8), "cut off": data[:-40], "empty": b""}[damage]
    file.write_bytes(left)
    with pytest.raises(
        InputRejected, match=f"roads.{part} is shorter than its header says|is not a vector file"
    ):
        vector_name(path)
    file.write_bytes(data)
    assert len(pyogrio.read_dataframe(vector_name(path))) == 20


def test_osm_is_read(tmp_path):
    path = tmp_path / "roads.osm"
    path.write_text(OSM)
    assert vector_name(path) == str(path)
    assert opened(path, None).extents is None


@pytest.mark.parametrize(
    "crs", [None, {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}]
)
def test_geojson_with_named_crs_is_read(tmp_path, crs):
    path = tmp_path / "roads.json"
    path.write_text("\ufeff \n" + json.dumps(ROADS | {"crs": crs}, indent=1), encoding="utf-8")
    assert pyogrio.read_info(vector_name(path))["driver"] == "GeoJSON"


LINKS = {
    "link": '"crs": {"type": "link", "properties": {"href": "WEB/crs", "type": "proj4"}}',
    "url": '"CRS" : {"properties": {"url": "WEB/crs"}, "TYPE": "URL"}',
    "escaped": '"c\\u0072s": {"type": "l\\u0069nk", "properties": {"href": "WEB/crs"}}',
    "quotes": "'crs': {'type': 'link', 'properties': {'href': 'WEB/crs'}}",
    "comment": '"crs" /* : */ : {"type": "link", "properties": {"href": "WEB/crs"}}',
    "brace": '"crs": {"a": "}", "type": "link", "properties": {"href": "WEB/crs"}}',
    "twice": '"crs": null, "crs": {"type": "name", "type": "link", "properties": {"href": "WEB/crs"}}',
}


@pytest.mark.parametrize("text", LINKS.values(), ids=LINKS)
@pytest.mark.parametrize("first", [True, False])
def test_linked_crs_of_geojson_asks_no_server(tmp_path, web, text, first):
    text, roads = text.replace("WEB", web.url), json.dumps(ROADS)[1:-1]
    content = "{" + ", ".join([text, roads] if first else [roads, text]) + "}"
    check_refused(tmp_path / "roads.geojson", content, "has its CRS by a link")
    assert web.requests == []


OTHERS = {
    "ogr vrt": '<OGRVRTDataSource><OGRVRTLayer name="x"><SrcDataSource>/vsicurl/URL/x.geojson</SrcDataSource>'
    "</OGRVRTLayer></OGRVRTDataSource>",
    "wfs": "<OGRWFSDataSource><URL>URL/wfs</URL></OGRWFSDataSource>",
    "kml": "<kml><NetworkLink><Link><href>URL/a.kml</href></Link></NetworkLink></kml>",
    "gml": '<FeatureCollection xmlns:gml="http://www.opengis.net/gml" '
    'xsi:schemaLocation="a URL/a.xsd"></FeatureCollection>',
    "osm with a vrt": "<osm><!-- <OGRVRTDataSource><OGRVRTLayer name='x'>"
    "<SrcDataSource>/vsicurl/URL/x.geojson</SrcDataSource></OGRVRTLayer></OGRVRTDataSource> --></osm>",
    "sqlite": b"SQLite format 3\0" + b"\0" * 99,
    "zip": b"PK\3\4" + b"\0" * 99,
    "empty": b"",
    "text": "easting,northing\n1,2\n",
}


@pytest.mark.parametrize("content", OTHERS.values(), ids=OTHERS)
@pytest.mark.parametrize("name", ["roads.geojson", "roads.gpkg", "roads.osm"])
def test_other_formats_ask_no_server(tmp_path, web, content, name):
    if isinstance(content, str):
        content = content.replace("URL", web.url)
    check_refused(tmp_path / name, content, "it is no GeoPackage.*ogr2ogr")
    assert web.requests == []


def test_json_of_another_format_asks_no_server(tmp_path, web):
    path = tmp_path / "roads.geojson"
    command = f"gdal vector pipeline ! read /vsicurl/{web.url}/x.geojson"
    source = f"/vsicurl/{web.url}/x.geojson"
    hidden = f"<OGRVRTDataSource><OGRVRTLayer name='x'><SrcDataSource>{source}</SrcDataSource></OGRVRTLayer>"
    path.write_text(json.dumps({"type": "gdal_streamed_alg", "command_line": command}))
    with pytest.raises(CatalogError, match="is not a vector file"):
        opened(path, UTM)
    path.write_text(json.dumps(ROADS | {"a": hidden + "</OGRVRTDataSource>"}))
    assert opened(path, UTM).has_crs
    assert web.requests == []


def test_only_regular_files_are_opened(tmp_path):
    pipe = tmp_path / "roads.gpkg"
    os.mkfifo(pipe)
    with pytest.raises(InputRejected, match="is not a regular file"):
        vector_name(pipe)
    with pytest.raises(InputRejected, match="is not a regular file"):
        vector_name(tmp_path)
    path = tmp_path / "roads.shp"
    write(path, [DIAGONAL])
    path.with_suffix(".prj").unlink()
    os.mkfifo(path.with_suffix(".prj"))
    with pytest.raises(InputRejected, match="has the part roads.prj, which is not a regular file"):
        vector_name(path)


@pytest.mark.parametrize(
    ("name", "part"),
    [("roads.shp", "roads.dbf"), ("roads.gpkg", "roads.gpkg-wal"), ("roads.shp", "roads.cpg")],
)
def test_part_is_no_link_to_another_folder(tmp_path, name, part):
    path = tmp_path / "home" / name
    path.parent.mkdir()
    write(path, [DIAGONAL])
    (path.parent / part).unlink(missing_ok=True)
    (tmp_path / part).write_bytes(b"secret")
    (path.parent / part).symlink_to(tmp_path / part)
    with pytest.raises(InputRejected, match=f"has the part {part}, which is a link to another folder"):
        vector_name(path)
    # A folder of links to the files of another folder.
    (tmp_path / "links").mkdir()
    for file in path.parent.iterdir():
        file.unlink() if file.is_symlink() else (tmp_path / "links" / file.name).symlink_to(file)
    assert vector_name(tmp_path / "links" / name)


def test_path_that_gdal_would_divide_is_refused(tmp_path):
    path = tmp_path / "a!b.geojson"
    path.write_text(json.dumps(ROADS))
    with pytest.raises(InputRejected, match="rename it"):
        vector_name(path)


def with_view(path, *queries):
    """Write a GeoPackage whose layer ``v`` is a view."""
    write(path, [DIAGONAL], layer="roads")
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as file:
        for query in queries:
            file.execute(query)
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
            "SELECT 'v', 'features', 'v', srs_id FROM gpkg_contents"
        )
        file.execute(
            "INSERT INTO gpkg_geometry_columns SELECT 'v', column_name, geometry_type_name, srs_id, z, m "
            "FROM gpkg_geometry_columns"
        )
    return path


def check_remedy(error, command_after):
    """Execute the command that a message ends with."""
    command = str(error.value).rpartition(command_after)[2].replace("python", sys.executable, 1)
    subprocess.run(command, shell=True, check=True)


ENDLESS = "WITH c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS fid, r.geom FROM c, roads r"
CROSS = ", ".join(f"gpkg_spatial_ref_sys s{number}" for number in range(30))
REMOVE = (
    "; write its result to a table, or remove it: python -c 'import sqlite3; "
    """sqlite3.connect("{}", isolation_level=None).execute("DROP VIEW [v]")'"""
)
REFUSED = {
    "repeats itself": ([f"CREATE VIEW v AS {ENDLESS}"], "does not end"),
    "joins all with all": (
        [f"CREATE VIEW v AS SELECT fid, geom FROM roads, {CROSS} WHERE s0.srs_id + s29.srs_id > 99999999"],
        "does not end",
    ),
    "needs all memory": (
        ["CREATE VIEW v AS SELECT fid, geom, hex(randomblob(400000000)) AS class FROM roads"],
        "calls the function hex",
    ),
    "has long texts": (
        [
            "CREATE VIEW v AS WITH a(t) AS (SELECT '1234567812345678'), "
            + ", ".join(
                f"{b}(t) AS (SELECT t||t||t||t||t||t||t||t FROM {a})"
                for a, b in itertools.pairwise("abcdefg")
            )
            + " SELECT t, fid, geom FROM g, roads"
        ],
        "cannot be checked (string or blob too big)",
    ),
    "is of a function of GDAL": (
        ["CREATE VIEW v AS SELECT fid, ST_Buffer(geom, 1) AS geom FROM roads"],
        "cannot be checked (no such function: ST_Buffer)",
    ),
}


@pytest.mark.parametrize(("queries", "why"), REFUSED.values(), ids=REFUSED)
def test_view_that_may_not_end_is_refused_with_the_remedy(tmp_path, monkeypatch, queries, why):
    monkeypatch.setattr(vector_contents, "MAX_VALUE_BYTES", 2**20)
    path = with_view(tmp_path / "a#b.gpkg", *queries)
    with pytest.raises(InputRejected) as error:
        vector_name(path)
    assert str(error.value) == f"has the view 'v', which {why}" + REMOVE.format(path)
    check_remedy(error, "remove it: ")
    assert len(pyogrio.read_dataframe(vector_name(path), layer="roads")) >= 1


VIEWS = {
    "columns": "SELECT fid, geom FROM roads",
    "filter": "SELECT * FROM roads WHERE fid < 3 AND geom IS NOT NULL",
    "join": "SELECT row_number() OVER () AS fid, a.geom FROM roads a JOIN roads b ON a.fid = b.fid",
    "group": "SELECT min(fid) AS fid, geom, count(*) AS n FROM roads GROUP BY fid",
    "with": "WITH a AS (SELECT * FROM roads) SELECT fid, geom FROM a",
}


@pytest.mark.parametrize("query", VIEWS.values(), ids=VIEWS)
def test_view_that_ends_is_read(tmp_path, query):
    path = with_view(tmp_path / "a#b.gpkg", f"CREATE VIEW v AS {query}")
    assert len(pyogrio.read_dataframe(vector_name(path), layer="v")) == 1
    assert len(opened(path, None, "v").extents) == 1


@pytest.mark.parametrize(
    "queries",
    [
        ["CREATE VIEW v AS SELECT * FROM v"],
        ["CREATE VIEW w AS SELECT * FROM v", "CREATE VIEW v AS SELECT * FROM w"],
    ],
)
def test_view_of_itself_raises_one_line(tmp_path, queries):
    with pytest.raises(CatalogError, match="circularly defined") as error:
        opened(with_view(tmp_path / "a#b.gpkg", *queries), None)
    assert "\n" not in str(error.value)


def test_column_that_is_computed_when_it_is_read_is_refused_with_the_remedy(tmp_path):
    path = with_view(tmp_path / "a.gpkg", "CREATE VIEW v AS SELECT fid, geom FROM roads")
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("ALTER TABLE roads ADD COLUMN g TEXT AS (hex(zeroblob(400000000))) VIRTUAL")
    with pytest.raises(
        InputRejected, match="has the computed column 'g', whose values may have no end"
    ) as error:
        vector_name(path)
    check_remedy(error, "remove it: ")
    assert len(pyogrio.read_dataframe(vector_name(path), layer="v")) == 1


@pytest.mark.parametrize(
    ("kind", "table", "column", "options"),
    [
        ("gpkg", "gpkg_ogr_contents", "feature_count", {}),
        ("sqlite", "geometry_columns_statistics", "row_count", {"driver": "SQLite", "SPATIALITE": "YES"}),
    ],
)
def test_more_features_than_stated_are_refused_with_the_remedy(tmp_path, kind, table, column, options):
    """As programs leave them that add features without the file's triggers; pyogrio reads the first ones."""
    path = tmp_path / f"roads.{kind}"
    lines = geopandas.GeoDataFrame(geometry=[LineString([(0, n), (9, n)]) for n in range(5)], crs=UTM)
    lines.to_file(path, engine="pyogrio", **options)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as file:
        file.execute(f"UPDATE {table} SET {column} = 2")
    with pytest.raises(InputRejected, match="states 2 features of 'roads', which has 5; have") as error:
        vector_name(path)
    check_remedy(error, "again: ")
    assert len(pyogrio.read_dataframe(vector_name(path))) == 5


@pytest.fixture
def spatialite(tmp_path):
    """Return a SpatiaLite file of one road, as registers of the Netherlands come."""
    path = tmp_path / "roads.sqlite"
    roads = geopandas.GeoDataFrame({"w": [4.0]}, geometry=[DIAGONAL], crs=UTM)
    roads.to_file(path, driver="SQLite", engine="pyogrio", SPATIALITE="YES", SPATIAL_INDEX="YES")
    return path


def test_spatialite_is_read(spatialite):
    assert opened(spatialite, None).extents
    read = pyogrio.read_dataframe(vector_name(spatialite))
    assert (read.w.item(), read.crs.to_epsg()) == (4.0, 25832)


def test_other_sqlite_files_are_refused(tmp_path):
    path = tmp_path / "roads.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("CREATE TABLE roads (w REAL)")
    with pytest.raises(InputRejected, match="it is no GeoPackage, SpatiaLite"):
        vector_name(path)


@pytest.mark.parametrize(
    ("kind", "statement"),
    [
        ("gpkg", "CREATE VIRTUAL TABLE other USING VirtualOGR('/etc/secret.gpkg')"),
        ("sqlite", "CREATE VIRTUAL TABLE other USING VirtualShape('/etc/secret', 'UTF-8', 25832)"),
        ("sqlite", "create/**/virtual/**/table other USING VirtualOGR('/vsicurl/http://host/a')"),
        ("sqlite", "CREATE VIRTUAL TABLE other USING VirtualText('using rtree(', 'UTF-8')"),
    ],
)
def test_table_of_another_file_is_refused(tmp_path, spatialite, kind, statement):
    path = spatialite if kind == "sqlite" else write(tmp_path / "roads.gpkg", [DIAGONAL])
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA writable_schema = ON")
        file.execute("INSERT INTO sqlite_master VALUES ('table', 'other', 'other', 0, ?)", (statement,))
        file.commit()
    with pytest.raises(InputRejected, match="virtual table 'other', which may be made of another file"):
        vector_name(path)


def test_spatialite_with_a_view_that_repeats_itself_is_refused(spatialite):
    with contextlib.closing(sqlite3.connect(spatialite)) as file:
        file.execute("CREATE VIEW v AS WITH r AS (SELECT 1 AS n UNION ALL SELECT n FROM r) SELECT * FROM r")
        file.commit()
    with pytest.raises(InputRejected, match="the view 'v', which does not end"):
        vector_name(spatialite)
