"""``flexroad lift`` of points, lines and polygons on tilted ground: heights are exact, all else stays."""

import csv
import datetime
import json
import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pyogrio
import pyproj
import pytest
import shapely
from shapely import LineString, MultiLineString, MultiPoint, MultiPolygon, Point, Polygon

from tests.make_rasters import UTM
from tests.tools.results.test_command import SIZE, SOUTH, WEST, ground, made_run

BEYOND = WEST + SIZE
"""East of here the run has no surface."""
FORMATS = ["gpkg", "geojson", "fgb", "shp"]


def place(*points):
    return [(WEST + x, SOUTH + y, *more) for x, y, *more in points]


LINES = [
    LineString(place((2, 3), (20.5, 11), (30, 35))),
    LineString(place((5, 5), (5.2, 5), (5.2, 9))),
    MultiLineString([place((1, 39), (38, 38)), place((8, 8), (9, 9), (8, 8))]),
]
HOUSE = Polygon(place((10, 10), (30, 10), (30, 30), (10, 30)), [place((15, 15), (15, 20), (20, 20))])
SHAPES = {
    "lines": LINES,
    "polygons": [HOUSE, MultiPolygon([HOUSE, Polygon(place((1, 1), (5, 1), (3, 4)))])],
    "points": [Point(*place((3.5, 7.25))[0]), Point(*place((39, 1))[0])],
    "multipoints": [MultiPoint(place((3, 4), (5, 6)))],
    "z": [LineString(place((2, 3, 7), (20, 11, 8)))],
}
ATTRIBUTES = {
    "name": ["Bäckerstraße", None, "c"],
    "number": np.array([7, -1, 2**31 - 1], np.int32),
    "large": np.array([2**40, 0, -5], np.int64),
    "width": [5.25, np.nan, 1e-3],
}


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return made_run(tmp_path_factory.mktemp("ground"))


def write(path: Path, shapes, crs=UTM, index: bool = True, **columns) -> Path:
    """Write features; without an index, features of a FlatGeobuf keep their order."""
    columns = columns or {name: values[: len(shapes)] for name, values in ATTRIBUTES.items()}
    geopandas.GeoDataFrame(columns, geometry=shapes, crs=crs).to_file(
        path, engine="pyogrio", **({} if index else {"SPATIAL_INDEX": "NO"})
    )
    return path


def assert_on_ground(shape, atol=1e-3, to_run=lambda x, y: (x, y)) -> None:
    x, y, z = shapely.get_coordinates(shape, include_z=True).T
    np.testing.assert_allclose(z, ground(*to_run(x, y)), atol=atol)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("kind", SHAPES)
def test_lift_of_features_gives_heights_of_the_ground_and_keeps_the_rest(
    run, flexroad, tmp_path, suffix, kind
):
    source = write(tmp_path / f"in.{suffix}", SHAPES[kind])
    out = tmp_path / "new" / f"out.{suffix}"
    said = flexroad("lift", source, run, "-o", out, "--crs", UTM).expected(0)
    assert f"{out}: {len(SHAPES[kind])} feature" in said.out
    before, after = geopandas.read_file(source), geopandas.read_file(out)
    pd.testing.assert_frame_equal(before.drop(columns="geometry"), after.drop(columns="geometry"))
    assert after.crs == before.crs
    for old, new in zip(before.geometry, after.geometry, strict=True):
        assert new.has_z
        assert shapely.force_2d(new).equals_exact(shapely.force_2d(old), 1e-9)
        assert_on_ground(new)
    keep = ("fields", "dtypes", "ogr_types", "ogr_subtypes", "crs", "encoding", "features")
    old, new = pyogrio.read_info(source), pyogrio.read_info(out)
    for key in keep:
        np.testing.assert_array_equal(old[key], new[key])
    assert new["geometry_type"] in (old["geometry_type"], f"{old['geometry_type']} Z")


def test_lift_of_a_geopackage_keeps_all_tables_ids_styles_and_triggers(run, flexroad, tmp_path):
    source = write(tmp_path / "in.gpkg", LINES)
    other = geopandas.GeoDataFrame({"a": [1]}, geometry=[Point(9.5, 50.5)], crs="EPSG:4326")
    to_degrees = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    other.geometry = [Point(to_degrees.transform(*place((4, 6))[0]))]
    other.to_file(source, layer="degrees", engine="pyogrio")
    pyogrio.write_dataframe(pd.DataFrame({"key": [3, 4]}), source, layer="table")
    with closing(sqlite3.connect(source)) as file:
        file.execute("CREATE TABLE layer_styles (id INTEGER PRIMARY KEY, f_table_name TEXT, styleQML TEXT)")
        file.execute("INSERT INTO layer_styles VALUES (1, 'in', '<qgis/>')")
        file.execute("CREATE VIEW short AS SELECT fid AS OGC_FID, geom FROM 'in' WHERE fid < 3")
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, srs_id) "
            "VALUES ('short', 'features', 'short', 25832)"
        )
        file.execute("INSERT INTO gpkg_geometry_columns VALUES ('short', 'geom', 'GEOMETRY', 25832, 0, 0)")
        file.commit()
    out = tmp_path / "out.gpkg"
    flexroad("lift", source, run, "-o", out).expected(0)
    with closing(sqlite3.connect(source)) as old, closing(sqlite3.connect(out)) as new:
        statements = "SELECT type, name, tbl_name, sql FROM sqlite_master ORDER BY type, name"
        assert new.execute(statements).fetchall() == old.execute(statements).fetchall()
        for table in ("layer_styles", "table", "gpkg_contents", "gpkg_ogr_contents", "rtree_in_geom"):
            rows = f"SELECT * FROM '{table}'"
            assert new.execute(rows).fetchall() == old.execute(rows).fetchall()
        assert new.execute("SELECT table_name, z FROM gpkg_geometry_columns ORDER BY rowid").fetchall() == [
            ("in", 1),
            ("degrees", 1),
            ("short", 2),
        ]
        assert new.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    (point,) = geopandas.read_file(out, layer="degrees").geometry
    assert point.z == pytest.approx(ground(*place((4, 6))[0]), abs=1e-3)
    assert geopandas.read_file(out, layer="short").geometry.iloc[1].has_z
    # GDAL can still change the table: its triggers work.
    pyogrio.write_dataframe(geopandas.read_file(out, layer="in"), out, layer="in", append=True)
    assert pyogrio.read_info(out, layer="in")["features"] == 2 * len(LINES)


def test_lift_of_geojson_keeps_every_byte_but_the_coordinates(run, flexroad, tmp_path):
    crs = '"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}'
    x, y = WEST + 10, SOUTH + 20
    text = (
        '\ufeff{ "type":"FeatureCollection", "name":"Straßen", ' + crs + ',\r\n "features" : [\n'
        '{"type":"Feature","id":"a\\u00e4","bbox":[1,2,3,4],"properties":{"x":1.50,"n":null,"geometry":[1,{"b":2}]},'
        '"geometry":{"type":"Point","note":"kept","coordinates":@0}},\n\n'
        '{"type":"Feature","geometry":null,"properties":null},'
        '{"type":"Feature","geometry":{"type":"GeometryCollection","geometries":[{"type":"LineString","coordinates":'
        '@1} , {"coordinates":@2,"type":"Point"}]},"properties":{}},'
        '{"type":"Feature","geometry":{"type":"Polygon","coordinates":[]},"properties":{}}\n ]'
        ', "made by":"hand"} \n'
    )
    flat = [[x, y], [[x, y], [x + 5, y]], [x, y]]
    high = [[*flat[0]], [*flat[1]], [*flat[2]]]
    z, z5 = round(ground(x, y), 4), round(ground(x + 5, y), 4)
    high = [[x, y, z], [[x, y, z], [x + 5, y, z5]], [x, y, z]]

    def filled(values):
        found = text
        for i, value in enumerate(values):
            found = found.replace(f"@{i}", json.dumps(value))
        return found.encode()

    source, out = tmp_path / "in.geojson", tmp_path / "out.geojson"
    source.write_bytes(filled(flat))
    flexroad("lift", source, run, "-o", out, "--report", tmp_path / "rows.csv").expected(0)
    assert out.read_bytes().decode() == filled(high).decode()
    rows = list(csv.DictReader((tmp_path / "rows.csv").open()))
    assert [row["id"] for row in rows] == ["aä", "1", "2", "3"]
    flexroad("lift", source, run, "-o", out, "--columns").expected(0)
    assert b'"geometry":[1,{"b":2}], "grade_max_percent": null' in out.read_bytes()
    assert json.loads(out.read_text("utf-8-sig"))["features"][1]["properties"]["error_estimate_m"] is None


def test_lift_of_a_shapefile_keeps_its_table_encoding_and_indices(run, flexroad, tmp_path):
    source = tmp_path / "in.shp"
    frame = geopandas.GeoDataFrame({"name": ["Bäcker"] * 3}, geometry=LINES, crs=UTM)
    frame.to_file(source, engine="pyogrio", encoding="ISO-8859-1", SPATIAL_INDEX="YES")
    source.with_suffix(".qml").write_text("<qgis/>")
    out = tmp_path / "out" / "new.shp"
    out.parent.mkdir()
    out.with_suffix(".sbn").write_bytes(b"of another file")
    flexroad("lift", source, run, "-o", out).expected(0)
    assert sorted(path.suffix for path in out.parent.iterdir()) == [
        ".cpg",
        ".dbf",
        ".prj",
        ".qix",
        ".qml",
        ".shp",
        ".shx",
    ]
    for end in (".dbf", ".cpg", ".prj", ".qix", ".qml"):
        assert out.with_suffix(end).read_bytes() == source.with_suffix(end).read_bytes()
    assert geopandas.read_file(out).name[0] == "Bäcker"


@pytest.mark.parametrize("suffix", FORMATS)
def test_lift_keeps_null_and_empty_geometries(run, flexroad, tmp_path, suffix):
    shapes = [None, LINES[0], LineString()]
    source = tmp_path / f"in.{suffix}"
    write(source, shapes, index=suffix != "fgb", id=[1, 2, 3])
    flexroad("lift", source, run, "-o", tmp_path / f"out.{suffix}", "--crs", UTM).expected(0)
    before, after = geopandas.read_file(source), geopandas.read_file(tmp_path / f"out.{suffix}")
    assert list(after.id) == [1, 2, 3]
    assert list(after.geometry.isna()) == list(before.geometry.isna())
    assert list(after.geometry.is_empty) == list(before.geometry.is_empty)
    assert_on_ground(after.geometry[1])


@pytest.mark.parametrize("suffix", ["gpkg", "shp"])
def test_lift_keeps_m_and_gives_new_vertices_theirs(run, flexroad, tmp_path, suffix):
    line = shapely.from_wkt(f"LINESTRING M ({WEST + 1} {SOUTH + 1} 0, {WEST + 21} {SOUTH + 1} 20)")
    source = tmp_path / f"in.{suffix}"
    if suffix == "gpkg":
        write(source, LINES[:1])
        with closing(sqlite3.connect(source)) as file:
            (blob,) = file.execute("SELECT geom FROM 'in'").fetchone()
            for (name,) in file.execute("SELECT name FROM sqlite_master WHERE type='trigger'").fetchall():
                file.execute(f'DROP TRIGGER "{name}"')
            file.execute("UPDATE 'in' SET geom = ?", (blob[:40] + shapely.to_wkb(line, flavor="iso"),))
            file.execute("UPDATE gpkg_geometry_columns SET m = 1")
            file.commit()
    else:
        write(source, LINES[:1])
        xy = np.array([[WEST + 1, SOUTH + 1], [WEST + 21, SOUTH + 1]])
        body = (
            struct.pack("<i4d3i", 23, *xy[0], *xy[1], 1, 2, 0)
            + xy.tobytes()
            + struct.pack("<4d", 0, 20, 0, 20)
        )
        head = bytearray(source.read_bytes()[:100])
        head[24:28], head[32:36] = struct.pack(">i", (108 + len(body)) // 2), struct.pack("<i", 23)
        source.write_bytes(head + struct.pack(">ii", 1, len(body) // 2) + body)
        head[24:28] = struct.pack(">i", 54)
        source.with_suffix(".shx").write_bytes(head + struct.pack(">ii", 50, len(body) // 2))
    out = tmp_path / f"out.{suffix}"
    flexroad("lift", source, run, "-o", out).expected(0)
    with pyogrio.open_arrow(out, use_pyarrow=True) as (meta, reader):
        (wkb,) = reader.read_all()[meta["geometry_name"] or "wkb_geometry"].to_pylist()
    x, y, z, m = shapely.get_coordinates(shapely.from_wkb(wkb), include_z=True, include_m=True).T
    np.testing.assert_allclose(z, ground(x, y), atol=1e-3)
    np.testing.assert_allclose(m, x - WEST - 1, atol=1e-9)


@pytest.mark.parametrize("suffix", FORMATS)
def test_features_beyond_the_survey_are_reported_and_keep_what_they_had(run, flexroad, tmp_path, suffix):
    half = LineString(place((SIZE - 10, 5), (SIZE + 10, 5)))
    off = LineString(place((SIZE + 5, 5), (SIZE + 10, 5)))
    source = write(tmp_path / f"in.{suffix}", [half, off], index=suffix != "fgb", id=[1, 2])
    out, report = tmp_path / f"out.{suffix}", tmp_path / "rows.csv"
    said = flexroad("lift", source, run, "-o", out, "--report", report, "--crs", UTM).expected(0)
    assert "m of 2 features lie beyond the finished tiles and keep their heights" in said.err
    rows = list(csv.DictReader(report.open()))
    assert [float(row["without_ground_m"]) for row in rows] == pytest.approx([10.0, 5.0], abs=0.5)
    part, none = geopandas.read_file(out).geometry
    x, y, z = shapely.get_coordinates(part, include_z=True).T
    on = x <= BEYOND
    np.testing.assert_allclose(z[on], ground(x[on], y[on]), atol=1e-3)
    # From the last known point on it is level.
    np.testing.assert_allclose(z[~on], ground(BEYOND, y[0]), atol=1e-3)
    if suffix in ("gpkg", "geojson"):
        assert not none.has_z
    else:
        assert set(shapely.get_coordinates(none, include_z=True)[:, 2]) == {0.0}
        assert "has the height 0" in said.err


def test_a_line_with_heights_beyond_the_survey_keeps_them_or_goes_on_level(run, flexroad, tmp_path):
    line = LineString(place((SIZE - 10, 5, 1), (SIZE + 2, 5, 2), (SIZE + 10, 5, 33)))
    source, out = write(tmp_path / "in.gpkg", [line], id=[1]), tmp_path / "out.gpkg"
    flexroad("lift", source, run, "-o", out).expected(0)
    assert geopandas.read_file(out).geometry[0].coords[-1][2] == 33
    flexroad("lift", source, run, "-o", out, "--beyond", "flat").expected(0)
    end = geopandas.read_file(out).geometry[0].coords[-1][2]
    assert end == pytest.approx(ground(BEYOND, SOUTH + 5), abs=1e-3)


@pytest.mark.parametrize("suffix", FORMATS)
def test_columns_and_report_have_grades_errors_and_decks_of_unknown_height(run, flexroad, tmp_path, suffix):
    east = LineString(place((2, 5), (30, 5)))
    north = LineString(place((5, 2), (5, 30)))
    columns = {"id": [1, 2], "bridge": [None, "yes"]}
    source = write(tmp_path / f"in.{suffix}", [east, north], index=suffix != "fgb", **columns)
    out, report = tmp_path / f"out.{suffix}", tmp_path / "rows.csv"
    limits = ["--grade-limit", 4, "--crossfall-limit", 4]
    words = ["--columns", "--report", report, *limits, "--crs", UTM]
    said = flexroad("lift", source, run, "-o", out, *words).expected(0)
    assert "28.0 m of 1 feature are on a deck of unknown height" in said.err
    table, rows = geopandas.read_file(out), list(csv.DictReader(report.open()))
    names = ["grade_max_percent", "crossfall_max_percent", "error_estimate_m"]
    columns = ["grade_pct", "crossf_pct", "error_m"] if suffix == "shp" else names
    np.testing.assert_allclose(table[columns[0]], [5, 2], atol=1e-3)
    np.testing.assert_allclose(table[columns[1]], [2, 5], atol=1e-3)
    assert (table[columns[2]] < 0.02).all()
    assert list(table.id) == [1, 2]
    np.testing.assert_allclose([float(row["grade_max_percent"]) for row in rows], [5, 2], atol=1e-3)
    np.testing.assert_allclose([float(row["length_m"]) for row in rows], 28, atol=1e-3)
    assert [float(row["unknown_deck_m"]) for row in rows] == [0, 28]
    places = geopandas.read_file(report.with_suffix(".gpkg"))
    assert list(places.kind) == ["grade", "crossfall"]
    assert_on_ground(places.geometry)


BAD = {
    "cut.gpkg": (lambda data: data[: len(data) // 2], "GeoPackage"),
    "cut.geojson": (lambda data: data[: len(data) // 2], "is not complete JSON"),
    "cut.fgb": (lambda data: data[:-20], "is cut off: it has 1 of 2 features"),
    "cut.shp": (lambda data: data[:-20], "is a damaged Shapefile"),
    "broken.geojson": (lambda data: data.replace(b'": [ [', b'": [ [ ['), "is not complete JSON"),
    "other.geojson": (lambda data: data.replace(b'"LineString"', b'"Polygon"'), "(feature 0) has a damaged"),
    "curve.gpkg": (
        lambda data: data.replace(struct.pack("<BI", 1, 2), struct.pack("<BI", 1, 8)),
        "has a geometry of the type CircularString",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_lift_of_a_damaged_file_is_one_line_and_leaves_the_old_copy(run, flexroad, tmp_path, name):
    damage, message = BAD[name]
    source = write(tmp_path / name, LINES[:2], id=[1, 2])
    source.write_bytes(damage(source.read_bytes()))
    out = tmp_path / "out" / f"out{source.suffix}"
    out.parent.mkdir()
    out.write_text("old")
    said = flexroad("lift", source, run, "-o", out, "--crs", UTM).expected(2)
    assert message in said.err
    assert len(said.err.splitlines()) == 1
    assert out.read_text() == "old"
    assert [path.name for path in out.parent.iterdir()] == [out.name]


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "fgb"])
def test_lift_without_a_crs_is_an_error_with_the_option(run, flexroad, tmp_path, suffix):
    source = write(tmp_path / f"in.{suffix}", LINES[:1], None)
    out = tmp_path / f"out.{suffix}"
    said = flexroad("lift", source, run, "-o", out).expected(2)
    assert "carries no CRS; give it with --crs" in said.err
    assert not out.exists()
    flexroad("lift", source, run, "-o", out, "--crs", UTM).expected(0)
    assert_on_ground(geopandas.read_file(out).geometry)


@pytest.mark.parametrize("suffix", FORMATS)
def test_lift_to_another_format_or_elsewhere_is_an_error(run, flexroad, tmp_path, suffix):
    source = write(tmp_path / f"in.{suffix}", [LineString([(1, 2), (3, 4)])])
    other = tmp_path / "out.kml"
    said = flexroad("lift", source, run, "-o", other, "--crs", UTM).expected(2)
    assert f"then ogr2ogr out.kml out.{suffix}" in said.err
    said = flexroad("lift", source, run, "-o", tmp_path / f"out.{suffix}", "--crs", UTM).expected(2)
    assert "does not lie on the finished tiles" in said.err
    assert not list(tmp_path.glob("out*"))


def test_lift_of_dates_and_times_in_fgb_keeps_them(run, flexroad, tmp_path):
    when = [datetime.datetime(2026, 1, 2, 3, 4, 5)]
    source = write(tmp_path / "in.fgb", LINES[:1], day=pd.to_datetime(when), yes=[True])
    flexroad("lift", source, run, "-o", tmp_path / "out.fgb").expected(0)
    old, new = (geopandas.read_file(tmp_path / f"{name}.fgb") for name in ("in", "out"))
    pd.testing.assert_frame_equal(old[["day", "yes"]], new[["day", "yes"]])


def test_lift_to_or_from_a_folder_a_pipe_or_an_open_file_is_one_line(run, flexroad, tmp_path):
    source = write(tmp_path / "in.gpkg", LINES[:1])
    os.mkfifo(tmp_path / "pipe.gpkg")
    (tmp_path / "folder.gpkg").mkdir()
    (tmp_path / "open.gpkg-wal").write_bytes(b"x")
    said = flexroad("lift", source, run, "-o", tmp_path / "open.gpkg").expected(2)
    assert "is open in another program, as open.gpkg-wal is there" in said.err
    for name in ("pipe.gpkg", "folder.gpkg"):
        for words in (
            (source, run, "-o", tmp_path / name),
            (tmp_path / name, run, "-o", tmp_path / "out.gpkg"),
        ):
            said = flexroad("lift", *words).expected(2)
            assert len(said.err.splitlines()) == 1
    assert not (tmp_path / "out.gpkg").exists()


def test_lift_replaces_an_older_copy(run, flexroad, tmp_path):
    source, out = write(tmp_path / "in.gpkg", LINES), tmp_path / "out.gpkg"
    write(out, LINES[:1])
    flexroad("lift", source, run, "-o", out).expected(0)
    assert len(geopandas.read_file(out)) == len(LINES)
    # Lifted again, nothing changes: no vertex is added twice.
    flexroad("lift", out, run, "-o", tmp_path / "again.gpkg").expected(0)
    first, again = geopandas.read_file(out), geopandas.read_file(tmp_path / "again.gpkg")
    assert list(first.geometry.to_wkb()) == list(again.geometry.to_wkb())
