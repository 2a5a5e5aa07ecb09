"""Selection of road features, conversion to areas, and reading of vector files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import GeometryCollection, LineString, MultiLineString, Point, box

from flexroad.catalog import Grid
from flexroad.catalog.crs import transformer
from flexroad.tasks import TaskError
from flexroad.tasks.io import vectors
from flexroad.tasks.roads.rasterise import Options, cells, rasterise_roads, roads
from tests.make_roads import GRID, on_grid, tile, write, write_osm

WEST_EAST = LineString(on_grid((10, 50), (90, 50)))


def union(*paths, grid=GRID, **options):
    """Return the union of all roads of the files near the tile."""
    return shapely.union_all(roads(tile(*paths).roads, grid, Options(**options)).areas)


def area(*paths, **options):
    return union(*paths, **options).area


def test_line_is_buffered_to_its_width_with_flat_ends(tmp_path):
    path = write(tmp_path / "r.gpkg", [WEST_EAST], width=["24'"])
    assert area(path) == pytest.approx(80 * 7.3152)
    mask = rasterise_roads(tile(path))
    truth = np.zeros(GRID.shape, bool)
    truth[46:54, 10:90] = True  # centres within 3.66 m of the line, 0.5 to 3.5 m
    np.testing.assert_array_equal(mask, truth)


@settings(max_examples=30)
@given(turn=st.floats(-2.5, 2.5), wide=st.floats(2, 20), narrow=st.floats(2, 20))
def test_joined_lines_leave_no_wedge(tmp_path_factory, turn, wide, narrow):
    """Everything within the narrower half width of the abutment is road, nothing beyond the round buffers."""
    middle = (50.0, 50.0)
    far = (50 + 40 * np.cos(turn), 50 + 40 * np.sin(turn))
    lines = [LineString(on_grid((10, 50), middle)), LineString(on_grid(middle, far))]
    path = tmp_path_factory.mktemp("abutment") / "r.geojson"
    write(path, lines, width_m=[wide, narrow])
    result = union(path)
    disc = Point(*on_grid(middle)[0]).buffer(min(wide, narrow) / 2, quad_segs=8)
    assert disc.difference(result).area < 1e-6
    round_ended = shapely.union_all(shapely.buffer(lines, np.array([wide, narrow]) / 2, quad_segs=64))
    assert result.difference(round_ended.buffer(0.01)).area < 1e-6


def test_closed_line_has_no_gap(tmp_path):
    ring = LineString(on_grid((30, 30), (70, 30), (70, 70), (30, 70), (30, 30)))
    result = union(write(tmp_path / "r.gpkg", [ring], width=[6]))
    assert result.contains(Point(*on_grid((28, 28))[0])) is True
    assert len(result.interiors) == 1


def test_areas_and_collections_are_split_into_parts(tmp_path):
    shapes = [
        GeometryCollection([box(*on_grid((0, 0))[0], *on_grid((10, 10))[0]), MultiLineString([WEST_EAST])]),
        LineString(on_grid((60, 60), (80, 60), (80, 90), (60, 60))),
        Point(*on_grid((40, 40))[0]),
        None,
    ]
    path = write(tmp_path / "r.gpkg", shapes, width=[2, 2, 2, 2], area=["no", "yes", None, None])
    assert area(path) == pytest.approx(100 + 80 * 2 + 20 * 30 / 2)


def strips(tmp_path, column, values, **more):
    """Write lines 2 m wide, 10 m apart, one for each value of a column."""
    lines = [LineString(on_grid((10, 5 + 10 * i), (90, 5 + 10 * i))) for i in range(len(values))]
    path = tmp_path / "r.gpkg"
    path.unlink(missing_ok=True)
    write(path, lines, width=[2] * len(values), **{column: values, **more})
    return path


def kept(mask, n):
    return [bool(mask[round(100 - 5 - 10 * i), 50]) for i in range(n)]


@pytest.mark.parametrize("column", ["highway", "class", "fclass", "HIGHWAY"])
def test_left_out_classes_are_not_road(tmp_path, column):
    classes = "residential footway steps cycleway proposed razed abandoned construction track".split()
    mask = rasterise_roads(tile(strips(tmp_path, column, classes)))
    assert kept(mask, 9) == [True] + [False] * 7 + [True]
    chosen = rasterise_roads(tile(tmp_path / "r.gpkg"), Options(left_out=("track",)))
    assert kept(chosen, 9) == [True] * 8 + [False]


def test_osm_features_need_highway_tag(tmp_path):
    assert kept(rasterise_roads(tile(strips(tmp_path, "highway", ["service", None]))), 2) == [True, False]
    assert kept(rasterise_roads(tile(strips(tmp_path, "class", ["lane", None]))), 2) == [True, True]


def test_tunnels_are_left_out_unless_enabled(tmp_path):
    values = ["yes", "building_passage", "no", None, "culvert", "F", "T"]
    path = strips(tmp_path, "tunnel", values)
    assert kept(rasterise_roads(tile(path)), 7) == [False, False, True, True, False, True, False]
    assert kept(rasterise_roads(tile(path), Options(tunnels=True)), 7) == [True] * 7
    assert kept(rasterise_roads(tile(strips(tmp_path, "covered", ["yes", "no"]))), 2) == [False, True]


def test_bridges_are_road_and_flagged(tmp_path):
    path = strips(tmp_path, "bridge", ["yes", "viaduct", "no", None, "1", "0"])
    result = roads(tile(path).roads, GRID, Options())
    deck = cells(result.areas[result.bridge], GRID)
    assert kept(deck, 6) == [True, True, False, False, True, False]
    assert kept(cells(result.areas, GRID), 6) == [True] * 6


def test_abutment_of_bridges_only_is_bridge(tmp_path):
    lines = [LineString(on_grid((10 + 20 * i, 50), (30 + 20 * i, 50))) for i in range(3)]
    path = write(tmp_path / "r.gpkg", lines, width=[6] * 3, bridge=["no", "yes", "yes"])
    result = roads(tile(path).roads, GRID, Options())
    deck = shapely.union_all(result.areas[result.bridge])
    assert deck.bounds[0] - GRID.west == pytest.approx(30)
    assert deck.area == pytest.approx(40 * 6)


def test_layer_and_where_select_features(tmp_path):
    path = strips(tmp_path, "class", ["lane", "yard"])
    write(path, [WEST_EAST], layer="more", width=[20])
    with pytest.raises(
        TaskError,
        match=r"has 2 layers: r \(LineString, 2 features\), more \(LineString, 1 feature\); .* segment.layer",
    ):
        area(path)
    assert area(path, layer="r") == pytest.approx(2 * 160)
    assert area(path, layer="r", where="class = 'yard'") == pytest.approx(160)
    assert area(path, layer="more") == pytest.approx(80 * 20)
    chosen = replace(tile(path).roads, sublayer="more")
    assert shapely.area(roads(chosen, GRID, Options()).areas).sum() == pytest.approx(80 * 20)


def degrees(*places):
    lon, lat = transformer(GRID.crs, "EPSG:4326").transform(*np.array(on_grid(*places)).T)
    return list(zip(lon.tolist(), lat.tolist(), strict=True))


def test_osm_file_gives_lines_and_areas(tmp_path):
    ways = {
        "highway=residential;width=7 m": degrees((10, 90), (90, 90)),
        "highway=primary;lanes=2;bridge=yes": degrees((10, 70), (90, 70)),
        "highway=primary;tunnel=yes": degrees((10, 55), (90, 55)),
        "highway=footway": degrees((10, 45), (90, 45)),
        "waterway=river;width=9": degrees((10, 35), (90, 35)),
        "building=yes": degrees((10, 10), (30, 10), (30, 25), (10, 25), (10, 10)),
        "highway=service;area=yes": degrees((60, 10), (80, 10), (80, 25), (60, 25), (60, 10)),
    }
    osm = tmp_path / "map.osm"
    write_osm(osm, ways)
    result = roads(tile(osm).roads, GRID, Options())
    # The scale of the UTM zone is 0.9996 here; nodes are stored to 1e-7 degrees, about 1 cm.
    assert sorted(shapely.area(result.areas)) == pytest.approx([15 * 20, 80 * 7, 80 * 7], rel=0.01)
    assert shapely.area(result.areas[result.bridge]).tolist() == pytest.approx([80 * 7], rel=0.01)
    assert area(osm, layer="lines") == pytest.approx(2 * 80 * 7, rel=0.01)
    assert area(osm, where="highway = 'primary'", layer="lines") == pytest.approx(80 * 7, rel=0.01)


def test_osm_pbf_with_unsorted_nodes_is_read():
    """Uses the sample of pyogrio, whose motorway runs in a tunnel below the streets."""
    sample = Path(pyogrio.__file__).parent / "tests" / "fixtures" / "sample.osm.pbf"
    if not sample.exists():
        pytest.skip("pyogrio is installed without its test data")
    table = pyogrio.read_dataframe(
        sample, layer="lines", where="highway IS NOT NULL", USE_CUSTOM_INDEXING="NO"
    ).to_crs("EPSG:32630")
    grid = Grid.covering("EPSG:32630", tuple(table.total_bounds), 1.0)
    result = union(sample, grid=grid)
    streets = table[table.highway == "residential"].geometry
    assert len(streets) == 20
    assert all(result.buffer(0.01).covers(street) for street in streets)
    (motorway,) = table[table.highway == "motorway"].geometry
    assert not result.covers(motorway)
    assert union(sample, grid=grid, tunnels=True).buffer(0.01).covers(motorway)


@pytest.mark.parametrize("suffix", ["gpkg", "geojson"])
def test_file_is_read_once_for_many_tiles(tmp_path, monkeypatch, suffix):
    """Also if the tiles lie in two of the squares in which an indexed file is read."""
    readings, read = [], vectors._read
    monkeypatch.setattr(vectors, "_read", lambda *args: readings.append(1) or read(*args))
    line = LineString([(399_000, 5_699_990), (401_000, 5_699_990)])
    crs = GRID.crs
    path = tmp_path / f"r.{suffix}"
    write(path, [line], crs, width=[6])
    masks = []
    for i in range(8):
        grid = Grid(crs, 399_600 + 100 * i, 5_700_050, 1.0, 100, 100)
        masks.append(rasterise_roads(tile(path, grid=grid)))
    assert all(mask.sum() == 600 for mask in masks)
    squares = 4 if suffix == "gpkg" else 1
    assert 1 <= len(readings) <= squares


def test_feature_in_two_squares_is_returned_once(tmp_path):
    """Squares meet at 400 km east and 5 700 km north."""
    path = write(tmp_path / "r.gpkg", [LineString([(399_950, 5_699_950), (400_050, 5_700_050)])], width=[6])
    grid = Grid(GRID.crs, 399_900, 5_700_100, 1.0, 200, 200)
    result = roads(tile(path).roads, grid, Options())
    assert len(result.areas) == 1
    assert result.areas[0].area == pytest.approx(6 * 100 * 2**0.5)


def test_changed_file_is_read_again(tmp_path):
    path = write(tmp_path / "r.geojson", [WEST_EAST], width=[6])
    assert area(path) == pytest.approx(480, rel=1e-3)
    write(path, [WEST_EAST, LineString(on_grid((10, 80), (90, 80)))], width=[10, 10])
    assert area(path) == pytest.approx(1600, rel=1e-3)


def test_levels_of_roads_are_read_if_they_are_wanted(tmp_path):
    values = {"bridge": ["yes", None, None], "tunnel": [None, "yes", None]}
    lines = [LineString(on_grid((5, 20 + 20 * i), (95, 20 + 20 * i))) for i in range(3)]
    path = write(tmp_path / "r.gpkg", lines, width=[6] * 3, **values)
    assert roads(tile(path).roads, GRID, Options()).level.tolist() == [0, 0]
    # A tunnel is a road then, whatever the option for tunnels says.
    assert roads(tile(path).roads, GRID, Options(), levels=True).level.tolist() == [1, -1, 0]


def test_lines_of_several_levels_meet_without_a_disc(tmp_path):
    lines = [LineString(on_grid((10 + 20 * i, 50), (30 + 20 * i, 50))) for i in range(4)]
    path = write(tmp_path / "r.gpkg", lines, width=[6] * 4, bridge=["no", "no", "yes", "yes"])
    result = roads(tile(path).roads, GRID, Options(), levels=True)
    assert result.level.tolist() == [0, 0, 1, 1, 0, 1]
    ground = shapely.union_all(result.areas[result.level == 0])
    assert ground.bounds[2] - GRID.west == pytest.approx(50)
