"""``flexroad query`` on tilted ground of known heights: points in several files and CRSs, and profiles."""

import io
import sys
from pathlib import Path

import geopandas
import numpy as np
import pandas as pd
import pyproj
import pytest
import shapely
from shapely import LineString, MultiLineString, MultiPoint, Point

from flexroad import open_run
from tests import command_line
from tests.make_rasters import UTM, write
from tests.make_roads import in_cp1252
from tests.make_roads import write as write_roads

WEST, SOUTH, SIZE = 500_000.0, 5_600_000.0, 40
EAST_SLOPE, NORTH_SLOPE = 0.05, -0.02
POINTS = np.array([[WEST + 10.25, SOUTH + 20.5], [WEST + 31.0, SOUTH + 7.75]])


def ground(easting, northing):
    """The height of the made ground (m)."""
    return 100.0 + EAST_SLOPE * (easting - WEST) + NORTH_SLOPE * (northing - SOUTH)


def made_run(folder: Path, columns: int = SIZE) -> Path:
    """Return a run whose surface is the made ground, with data in the first columns and a road of 10 m."""
    centres = np.arange(SIZE) + 0.5
    heights = ground(WEST + centres[None, :], SOUTH + centres[::-1, None])
    heights[:, columns:] = np.nan
    road = np.zeros((SIZE, SIZE), np.uint8)
    road[15:25] = 1
    for name, values in (("dsm", heights), ("dtm", heights), ("road_mask", road)):
        write(folder / f"{name}.tif", values, WEST, SOUTH + SIZE)
    catalog, config = folder / "catalog.json", folder / "plane.yaml"
    config.write_text("extends: defaults\nfit: plane\nvariants:\n  flexroad: {}\n")
    layers = ["--dsm", "dsm.tif", "--dtm", "dtm.tif", "--road-mask", "road_mask.tif", "--road-value", 1]
    command_line.call("catalog", "rasters", folder, *layers, "--tile-size", SIZE, "-o", catalog).expected(0)
    words = ["--config", config, "--catalog", catalog, "--executor", "serial"]
    command_line.call("run", *words, "--out", folder / "run").expected(0)
    return folder / "run"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    return made_run(tmp_path_factory.mktemp("ground"))


def answer(said, **form) -> pd.DataFrame:
    return pd.read_csv(io.StringIO(said.expected(0).out), **form)


def assert_truth(table: pd.DataFrame) -> None:
    """The table has the heights of the ground and its normal at `POINTS`."""
    np.testing.assert_allclose(table.height_m, ground(*POINTS.T), atol=2e-3)
    np.testing.assert_allclose(-table.nx / table.nz, EAST_SLOPE, atol=1e-5)
    np.testing.assert_allclose(-table.ny / table.nz, NORTH_SLOPE, atol=1e-5)
    assert list(table["class"]) == ["road", "terrain"]


def in_crs(crs: str = "EPSG:4326") -> np.ndarray:
    """The places of `POINTS` in another CRS, by default longitudes and latitudes."""
    return np.column_stack(pyproj.Transformer.from_crs(UTM, crs, always_xy=True).transform(*POINTS.T))


def csv(path: Path, header: str, rows, form: str = "{:.9f},{:.9f}") -> Path:
    path.write_text("\n".join([header, *(form.format(*row) for row in rows)]) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "crs"),
    [
        ("longitude,latitude", None),
        ("LON,Lat", None),
        ("x,y", "EPSG:4326"),
        # ETRS89, which the projected CRS is based on.
        ("lon,lat", "EPSG:4258"),
        # The register has northing first for this one.
        ("easting,northing", "EPSG:3035"),
        ("x\ty", UTM),
    ],
)
def test_query_of_points_in_any_crs_gives_heights_of_the_ground(run, flexroad, tmp_path, header, crs):
    separator = "\t" if "\t" in header else ","
    rows = in_crs(crs or "EPSG:4326")
    points = csv(tmp_path / "points.csv", header, rows, "{:.9f}" + separator + "{:.9f}")
    said = flexroad("query", run, "--points", points, *(["--crs", crs] if crs else []))
    assert_truth(answer(said, sep=separator))
    assert said.err == ("" if crs else f"note: {header.replace(',', ', ')} are read as EPSG:4326\n")


def test_query_keeps_semicolons_and_decimal_commas(run, flexroad, tmp_path):
    points = tmp_path / "points.csv"
    lines = [f"{i};{x:.2f};{y:.2f};a, b".replace(".", ",") for i, (x, y) in enumerate(POINTS)]
    points.write_text("\ufeffNr; Easting ;Northing;note\r\n" + "\r\n".join(lines) + "\r\n")
    said = flexroad("query", run, "--points", points)
    table = answer(said, sep=";", decimal=",")
    assert_truth(table)
    assert list(table.columns[:4]) == ["Nr", "Easting", "Northing", "note"]
    assert said.out.splitlines()[1].startswith("0;500010,25;5600020,50;a, b;")


def test_query_writes_no_formulas(run, flexroad, tmp_path):
    cells = ("=1+1", "-7", "@a")
    points = tmp_path / "points.csv"
    points.write_text("x,y,=head\n" + "".join(f"{x},{y},{cells[i]}\n" for i, (x, y) in enumerate(POINTS)))
    flexroad("query", run, "--points", points, "-o", tmp_path / "answer.csv").expected(0)
    for text in (flexroad("query", run, "--points", points).out, (tmp_path / "answer.csv").read_text()):
        head, *rows = (line.split(",") for line in text.splitlines())
        assert head[:3] == ["x", "y", "'=head"]
        assert [row[2] for row in rows] == ["'=1+1", "-7"][: len(rows)]


def test_query_reads_standard_input(run, flexroad, tmp_path, monkeypatch):
    text = csv(tmp_path / "points.csv", "easting,northing", POINTS).read_bytes()
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(text)))
    assert_truth(answer(flexroad("query", run, "--points", "-")))


@pytest.mark.parametrize(("name", "crs"), [("a.gpkg", "EPSG:25833"), ("a.geojson", "EPSG:4326")])
def test_query_of_vector_points_gives_heights_and_coordinates_of_the_run(run, flexroad, tmp_path, name, crs):
    shapes = [MultiPoint([POINTS[0]]), Point(POINTS[1])]
    frame = geopandas.GeoDataFrame({"tree": ["oak", "elm"]}, geometry=shapes, crs=UTM)
    frame.to_crs(crs).to_file(tmp_path / name)
    table = answer(flexroad("query", run, "--points", tmp_path / name))
    assert_truth(table)
    assert list(table.tree) == ["oak", "elm"]
    np.testing.assert_allclose(table[["easting", "northing"]], POINTS, atol=2e-3)


def test_query_writes_geopackage_in_crs_of_the_run(run, flexroad, tmp_path):
    points = csv(tmp_path / "points.csv", "lon,lat,name", [*in_crs()], "{:.9f},{:.9f},a")
    with points.open("a") as file:
        file.write(",,no place\n")
    said = flexroad("query", run, "--points", points, "-o", tmp_path / "answer.gpkg")
    assert said.expected(0).out == ""
    assert "1 point lies on no finished tile" in said.err
    table = geopandas.read_file(tmp_path / "answer.gpkg")
    assert table.crs == UTM
    assert_truth(table[:2])
    np.testing.assert_allclose(table.geometry[:2].get_coordinates(), POINTS, atol=1e-3)
    assert table.geometry.isna().tolist() == [False, False, True]
    np.testing.assert_array_equal(shapely.get_z(table.geometry[:2].to_numpy()), table.height_m[:2])
    flexroad("query", run, "--points", points, "-o", tmp_path / "answer.csv").expected(0)
    assert_truth(pd.read_csv(tmp_path / "answer.csv")[:2])


def test_profile_along_points_has_distances_heights_and_grades(run, flexroad):
    corner = [(WEST + 5, SOUTH + 5), (WEST + 5, SOUTH + 5), (WEST + 25, SOUTH + 5), (WEST + 25, SOUTH + 11.5)]
    line = ", ".join(f"{x} {y}" for x, y in corner)
    table = answer(flexroad("query", run, "--line", line, "--step", 4))
    assert list(table.columns) == [
        "distance_m", "easting", "northing", "height_m", "grade_percent",
        "nx", "ny", "nz", "tile", "class", "flags",
    ]  # fmt: skip
    assert list(table.distance_m) == [0, 4, 8, 12, 16, 20, 24, 26.5]
    assert list(table.easting - WEST) == [5, 9, 13, 17, 21, 25, 25, 25]
    assert list(table.northing - SOUTH) == [5, 5, 5, 5, 5, 5, 9, 11.5]
    np.testing.assert_allclose(table.height_m, ground(table.easting, table.northing), atol=2e-3)
    # Uphill to the east, downhill to the north; at the corner the grade of the part that follows.
    np.testing.assert_allclose(table.grade_percent, [5, 5, 5, 5, 5, -2, -2, -2], atol=1e-3)


def test_profile_of_line_in_degrees_equals_that_of_the_run(run, flexroad):
    line = ", ".join(f"{x:.10f} {y:.10f}" for x, y in in_crs())
    table = answer(flexroad("query", run, "--line", line, "--crs", "EPSG:4326"))
    length = np.hypot(*(POINTS[1] - POINTS[0]))
    assert len(table) == int(length) + 2
    assert table.distance_m.iloc[-1] == pytest.approx(length, abs=2e-3)
    rise = (ground(*POINTS[1]) - ground(*POINTS[0])) / length
    np.testing.assert_allclose(table.grade_percent, 100 * rise, atol=1e-3)


def test_profile_of_several_lines_counts_them(run, flexroad, tmp_path):
    east, north = LineString([(WEST, SOUTH), (WEST + 3, SOUTH)]), LineString([POINTS[0], POINTS[0] + [0, 2]])
    touching = MultiLineString(
        [[(WEST, SOUTH), (WEST + 2, SOUTH)], [(WEST + 2, SOUTH), (WEST + 2, SOUTH + 1)]]
    )
    path = tmp_path / "lines.gpkg"
    geopandas.GeoDataFrame(geometry=[east, north, touching], crs=UTM).to_file(path)
    table = answer(flexroad("query", run, "--line", path))
    assert list(table.line) == [1] * 4 + [2] * 3 + [3] * 4
    assert list(table.distance_m) == [0, 1, 2, 3, 0, 1, 2, 0, 1, 2, 3]
    assert set(table.grade_percent.round(2)) == {5.0, -2.0}


@pytest.mark.parametrize("suffix", ["shp", "gpkg"])
def test_query_of_vector_text_in_another_encoding_than_declared_is_read_with_a_note(
    run, flexroad, tmp_path, suffix
):
    path = write_roads(tmp_path / f"a.{suffix}", [Point(*POINTS[0])], xxxxxxx=["yyyyyyy"])
    in_cp1252(in_cp1252(path, "xxxxxxx", "Straßen"), "yyyyyyy", "königli")
    said = flexroad("query", run, "--points", path).expected(0)
    (row,) = pd.read_csv(io.StringIO(said.out)).to_dict("records")
    assert row["Straßen"] == "königli"
    assert row["height_m"] == pytest.approx(ground(*POINTS[0]), abs=1e-3)
    (note,) = [line for line in said.err.splitlines() if "encoding" in line]
    assert f"the text of {path.name} is not in the encoding that it declares, and was read as cp1252" in note


def test_query_of_points_beyond_the_survey_gives_no_heights(flexroad, tmp_path):
    """The surface goes on there, but nobody measured the ground."""
    path = made_run(tmp_path, columns=30)
    places = np.array([*POINTS, (WEST + 29.5, SOUTH + 5)])
    points = csv(tmp_path / "points.csv", "x,y", places, "{},{}")
    said = flexroad("query", path, "--points", points)
    table = answer(said)
    assert said.err == "note: 1 point lies beyond the survey; its height, normal and class are empty\n"
    np.testing.assert_allclose(table.height_m[[0, 2]], ground(*places[[0, 2]].T), atol=2e-3)
    assert table.loc[1, ["height_m", "nx", "ny", "nz", "class"]].isna().all()
    assert table.tile.nunique() == 1
    view = open_run(path)
    east, north = POINTS.T
    assert list(np.isnan(view.height(east, north))) == [False, True]
    assert np.isnan(view.normal(east, north)[1]).all()


def test_query_of_points_beside_all_tiles_says_where_the_tiles_are(run, flexroad, tmp_path):
    points = csv(tmp_path / "points.csv", "x,y", in_crs())
    said = flexroad("query", run, "--points", points)
    assert answer(said).height_m.isna().all()
    assert said.err == (
        "note: 2 points lie on no finished tile; their columns are empty; the tiles lie in "
        "W 500000 S 5600000 E 500040 N 5600040 (EPSG:25832); longitude and latitude need --crs EPSG:4326\n"
    )


@pytest.mark.parametrize(
    ("text", "words", "message"),
    [
        ("a,b\n1,2\n", "", "it needs easting and northing, or x and y, or longitude and latitude"),
        ("easting,northing\n1,2\n", "--crs EPSG:4326", "it needs longitude and latitude"),
        ("", "", "no columns of coordinates"),
        ("x,y\n1,2\n\n3,4 m\n", "", "points.csv, line 4: y is '4 m', not a number"),
        ("x;y\n1,5;2\n3.000,5;4\n", "", "points.csv, line 3: x is '3.000,5', not a number"),
        ("x,y\n1,5,2,5\n", "", "points.csv, line 2: 4 values, but the header has 2"),
        ("x,y,Straße\n1,2,3\n", "", "save it as CSV in UTF-8"),
        ("x,y\n1,2\n", "--crs EPSG:1", "unknown CRS 'EPSG:1'"),
        ("x,y\n1,2\n", "-o a.shp", "ends in .csv or .gpkg"),
        ("x,y\n1,2\n", "--line 1", "give the points with --points FILE, or a line with --line"),
    ],
)
def test_query_of_unusable_points_gives_one_error(run, flexroad, tmp_path, text, words, message):
    points = tmp_path / "points.csv"
    points.write_text(text, encoding="latin-1")
    said = flexroad("query", run, "--points", points, *words.split()).expected(2)
    assert message in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


ORIGIN = Point(0, 0)


def line(*places) -> LineString:
    return LineString(places)


@pytest.mark.parametrize(
    ("option", "shape", "crs", "words", "message"),
    [
        ("--points", line((0, 0), (1, 1)), UTM, "", "type LineString, not points; lines go to --line"),
        ("--line", ORIGIN, UTM, "", "type Point, not lines; points go to --points"),
        ("--points", ORIGIN, None, "", "carries no CRS; give it with --crs"),
        ("--points", ORIGIN, UTM, "--crs EPSG:4326", "is in EPSG:25832, not EPSG:4326"),
        ("--points", ORIGIN, UTM, "|layername=b", "no layer 'b'; it has points"),
        ("--line", line((0, 0), (0, 0)), UTM, "", "has no length"),
        ("--line", line((200, 95), (201, 96)), "EPSG:4326", "", "cannot be transformed"),
        ("--line", line((0, 0), (9e9, 1)), UTM, "", "at most 10000000"),
    ],
)
@pytest.mark.filterwarnings("ignore:'crs' was not provided")
def test_query_of_unusable_features_gives_one_error(
    run, flexroad, tmp_path, option, shape, crs, words, message
):
    path = tmp_path / "points.gpkg"
    geopandas.GeoDataFrame(geometry=[shape], crs=crs).to_file(path)
    layer = words if words.startswith("|") else ""
    said = flexroad("query", run, option, f"{path}{layer}", *words.removeprefix(layer).split()).expected(2)
    assert message in said.err
    assert said.err.count("\n") == 1


def test_query_of_geopackage_with_layers_names_them(run, flexroad, tmp_path):
    path = tmp_path / "points.gpkg"
    for layer, shift in (("old", 1.0), ("new", 0.0)):
        frame = geopandas.GeoDataFrame(geometry=[Point(*point + shift) for point in POINTS], crs=UTM)
        frame.to_file(path, layer=layer)
    example = f"name one, such as '{path}|layername=old'"
    assert example in flexroad("query", run, "--points", path).expected(2).err
    assert_truth(answer(flexroad("query", run, "--points", f"{path}|layername=new")))


def test_query_of_vector_file_that_leads_elsewhere_is_refused(run, flexroad, tmp_path):
    path = tmp_path / "points.geojson"
    path.write_text("<OGRVRTDataSource><OGRVRTLayer name='a'/></OGRVRTDataSource>")
    assert "is not a vector file" in flexroad("query", run, "--points", path).expected(2).err


@pytest.mark.parametrize("line", ["1 2", "1 2, 3", "1 2; 3 4", "nowhere.gpkg"])
def test_query_of_text_that_is_no_line_gives_one_error(run, flexroad, line):
    said = flexroad("query", run, "--line", line).expected(2)
    assert said.err.count("\n") == 1
