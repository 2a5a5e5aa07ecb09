"""Tiles list the vector files of roads that reach them."""

import contextlib
import json
import sqlite3

import numpy as np
import pytest
from shapely import LineString, box

from flexroad.catalog import Catalog, CatalogError
from flexroad.catalog.scan.vectors import MARGIN_M, VectorFile, layers, with_roads
from flexroad.catalog.sources import nrw, rasters
from flexroad.catalog.tile import REACH_M
from flexroad.tasks.io.vectors import Query, read_near
from tests.make_rasters import write
from tests.make_roads import in_cp1252, write_osm
from tests.make_roads import write as write_roads

HEIGHTS = np.full((250, 750), 100, np.float32)
"""Three tiles side by side, from 295500 to 296250 east."""


@pytest.fixture
def survey(tmp_path):
    root = tmp_path / "survey"
    for name in ("dsm", "dtm"):
        write(root / f"{name}.tif", HEIGHTS)
    return root


def indexed(root, roads, crs=None):
    return rasters.index(root, {"dsm": "dsm.tif", "dtm": "dtm.tif", "roads": str(roads)}, crs=crs).tiles


def named(tiles):
    return [
        [path.name for path in tile.paths(layer)] if (layer := tile.layer("roads")) else [] for tile in tiles
    ]


def test_roads_file_is_listed_by_tiles_in_reach(survey, tmp_path):
    """The first road ends 99 m west of the last tile, the other 20 m within it."""
    write_roads(survey / "a.gpkg", [LineString([(295_400, 5_629_300), (295_901, 5_629_300)])])
    write_roads(survey / "b.gpkg", [LineString([(296_020, 5_629_300), (296_900, 5_629_300)])])
    tiles = indexed(survey, "?.gpkg")
    assert named(tiles) == [["a.gpkg"], ["a.gpkg", "b.gpkg"], ["a.gpkg", "b.gpkg"]]
    Catalog(tiles).write(survey / "catalog.parquet")
    (again, *_) = Catalog.read(survey / "catalog.parquet").tiles
    assert again.layer("roads").files == ("a.gpkg",)
    assert again.paths(again.layer("roads"))[0].is_file()


def test_roads_outside_of_the_extent_that_a_geopackage_states_are_listed(survey):
    """A program has moved the second road and not the extent."""
    lines = [LineString([(x, 5_629_300), (x + 20, 5_629_310)]) for x in (295_510, 296_200)]
    path = write_roads(survey / "a.gpkg", lines)
    with contextlib.closing(sqlite3.connect(path)) as file:
        file.execute("UPDATE gpkg_contents SET max_x = 295530")
        file.commit()
    assert named(indexed(survey, path)) == [["a.gpkg"], ["a.gpkg"], ["a.gpkg"]]


@pytest.mark.parametrize("suffix", ["shp", "gpkg", "fgb", "geojson"])
def test_roads_file_with_columns_in_another_encoding_than_declared_is_listed(survey, suffix):
    road = LineString([(295_500, 5_629_300), (295_600, 5_629_300)])
    path = write_roads(survey / f"a.{suffix}", [road], xxxxxxx=["stone"])
    in_cp1252(path, "xxxxxxx", "Straßen")
    assert layers(path) == {"a": "LineString, 1 feature"}
    assert named(indexed(survey, path)) == [[path.name], [path.name], []]


def test_roads_file_outside_folder_in_other_crs_is_used(survey, tmp_path):
    import geopandas

    line = geopandas.GeoSeries([LineString([(295_500, 5_629_300), (295_600, 5_629_300)])], crs="EPSG:25832")
    roads = tmp_path / "elsewhere" / "r.geojson"
    roads.parent.mkdir()
    write_roads(roads, list(line.to_crs("EPSG:4326")), "EPSG:4326")
    tiles = indexed(survey, roads)
    # The second tile is 150 m away.
    assert named(tiles) == [["r.geojson"], ["r.geojson"], []]
    assert tiles[0].paths(tiles[0].layer("roads")) == (roads,)


def test_osm_file_without_bounds_is_used_by_all_tiles(survey):
    write_osm(survey / "map.osm", {"highway=service": [(6.1, 50.7), (6.2, 50.8)]})
    tiles = indexed(survey, "map.osm")
    assert named(tiles) == [["map.osm"]] * 3
    roads = tiles[0].layer("roads")
    assert roads.reaching((0.0, 0.0, 1.0, 1.0)) == roads


def test_straight_road_has_an_extent_in_the_tiles_crs(survey, tmp_path):
    import geopandas

    line = geopandas.GeoSeries([LineString([(295_400, 5_629_300), (295_901, 5_629_300)])], crs="EPSG:25832")
    write_roads(survey / "a.geojson", list(line.to_crs("EPSG:4326")), "EPSG:4326")
    roads = indexed(survey, "a.geojson")[0].layer("roads")
    # Bounds in degrees are those of a slightly turned rectangle.
    assert roads.extents[0] == pytest.approx((295_399, 5_629_299, 295_902, 5_629_301), abs=25)
    assert roads.reaching((295_500.0, 5_629_250.0, 295_600.0, 5_629_350.0)) == roads
    assert roads.reaching((295_500.0, 5_629_350.0, 295_600.0, 5_629_400.0)) is None


def test_roads_of_all_tiles_have_the_crs_of_files_without_one(survey):
    """Only the first file, near the first tile, has no CRS; the last tile lists the other one."""
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        write_roads(survey / "a.gpkg", [LineString([(295_500, 5_629_300), (295_510, 5_629_300)])], None)
    write_roads(survey / "b.gpkg", [LineString([(296_020, 5_629_300), (296_200, 5_629_300)])])
    tiles = indexed(survey, "?.gpkg", "EPSG:25832")
    assert named(tiles) == [["a.gpkg"], ["b.gpkg"], ["b.gpkg"]]
    assert [tile.layer("roads").crs for tile in tiles] == ["EPSG:25832"] * 3


def test_file_of_several_layers_needs_the_choice_of_one(survey):
    write_roads(
        survey / "r.gpkg", [LineString([(295_500, 5_629_300), (295_600, 5_629_300)])] * 3, layer="ways"
    )
    write_roads(survey / "r.gpkg", [box(296_000, 5_629_250, 296_010, 5_629_260)], layer="plots")
    both = r"ways \(LineString, 3 features\), plots \(Polygon, 1 feature\)"
    with pytest.raises(CatalogError, match=rf"r.gpkg has 2 layers: {both}; name one, such as .*ways'$"):
        indexed(survey, "r.gpkg")
    with pytest.raises(CatalogError, match=rf"r.gpkg has no layer 'roads'; it has {both}$"):
        indexed(survey, "r.gpkg|layername=roads")
    result = rasters.index(survey, {"dsm": "dsm.tif", "roads": "r.gpkg|layername=ways"})
    assert named(result.tiles) == [["r.gpkg"], ["r.gpkg"], []]
    for name in ("c.parquet", "c.json"):
        Catalog(result.tiles).write(survey / name)
        assert Catalog.read(survey / name).tiles[0].layer("roads").sublayer == "ways"


def test_nrw_index_accepts_roads(tmp_path):
    for product in ("dom1", "dgm1"):
        write(tmp_path / f"{product}_32_356_5699_1_nw_2020.tif", HEIGHTS[:, :250], 356_000, 5_700_000)
    write_roads(tmp_path / "r.gpkg", [box(356_000, 5_699_800, 356_100, 5_699_900)])
    assert named(nrw.index(tmp_path, roads="r.gpkg").tiles) == [["r.gpkg"]]


def test_crs_option_is_used_for_file_without_crs(survey):
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        write_roads(survey / "r.gpkg", [LineString([(295_500, 5_629_300), (295_600, 5_629_300)])], None)
    with pytest.raises(CatalogError, match=r"--roads .*r.gpkg has no CRS; give it with --crs"):
        indexed(survey, "r.gpkg")
    assert [tile.layer("roads").crs for tile in indexed(survey, "r.gpkg", "EPSG:25832")[:1]] == ["EPSG:25832"]


@pytest.mark.parametrize(
    ("make", "name", "message"),
    [
        (lambda path: None, "r.gpkg", "no file matches --roads 'r.gpkg' below .*; there are dsm.tif"),
        (lambda path: path.write_text("roads"), "r.gpkg", "--roads .*r.gpkg is not a vector file"),
        (lambda path: None, "dsm.tif", "--roads .*dsm.tif is not a vector file"),
        (lambda path: write_roads(path, [box(0, 0, 1, 1)]), "r.gpkg", "--roads .*r.gpkg reaches no tile"),
    ],
)  # fmt: skip
def test_invalid_roads_file_raises_one_line(survey, make, name, message):
    make(survey / "r.gpkg")
    with pytest.raises(CatalogError, match=message) as caught:
        indexed(survey, name)
    assert "\n" not in str(caught.value)


@pytest.fixture
def bare_geojson(survey):
    """A GeoJSON with metres of EPSG:25832 and no CRS: GDAL says EPSG:4326."""
    line = [[295_400, 5_629_300], [295_600, 5_629_300]]
    geometry = {"type": "LineString", "coordinates": line}
    feature = {"type": "Feature", "properties": {"width": 8.0}, "geometry": geometry}
    path = survey / "plain.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


def test_metres_in_a_file_in_degrees_are_refused_with_the_remedy(survey, bare_geojson):
    with pytest.raises(CatalogError) as error:
        indexed(survey, bare_geojson)
    assert str(error.value) == (
        f"--roads {bare_geojson} has the CRS EPSG:4326, but 295600 is no longitude; "
        "give its CRS with --crs, or add it to the file with ogr2ogr -a_srs"
    )


def test_crs_replaces_degrees_that_are_metres_in_catalog_and_reader(survey, bare_geojson):
    tiles = indexed(survey, bare_geojson, crs="EPSG:25832")
    assert named(tiles) == [["plain.geojson"], ["plain.geojson"], []]
    roads = tiles[0].layer("roads")
    assert roads.crs == "EPSG:25832"
    assert roads.extents == ((295_399.0, 5_629_299.0, 295_601.0, 5_629_301.0),)
    query = Query(bare_geojson, None, None, ("width",), roads.crs, tiles[0].grid.crs)
    read = read_near(query, tiles[0].grid.bounds)
    assert read.total_bounds.tolist() == [295_400, 5_629_300, 295_600, 5_629_300]
    assert read.crs == "EPSG:25832"


def test_crs_option_leaves_a_file_in_true_degrees_alone(survey):
    write_roads(survey / "r.geojson", [LineString([(6.09, 50.78), (6.1, 50.78)])], "EPSG:4326")
    tiles = indexed(survey, "r.geojson", crs="EPSG:25832")
    assert tiles[0].layer("roads").crs is None
    query = Query(survey / "r.geojson", None, None, (), "EPSG:25832", tiles[0].grid.crs)
    assert len(read_near(query, (0, 0, 1e6, 1e7))) == 1


def test_roads_elsewhere_are_named_with_both_places(survey):
    write_roads(survey / "r.gpkg", [LineString([(32_295_500, 5_629_300), (32_295_600, 5_629_300)])])
    with pytest.raises(CatalogError) as error:
        indexed(survey, "r.gpkg")
    assert str(error.value) == (
        f"--roads {survey / 'r.gpkg'} reaches no tile; check its CRS and its extent: it lies at "
        "32295500 5629300 32295600 5629300 in EPSG:25832, the tiles at 295500 5629250 296250 5629500 in "
        "EPSG:25832; its eastings differ by 32000000, the number of a zone: declare EPSG:4647"
    )


def test_roads_without_a_place_in_the_tiles_crs_are_not_listed_by_every_tile(survey):
    """Eastings with the zone's number in EPSG:25833 have no position in EPSG:25832."""
    write_roads(
        survey / "r.gpkg", [LineString([(33_500_000, 5_600_000), (33_500_100, 5_600_000)])], "EPSG:25833"
    )
    with pytest.raises(
        CatalogError, match="reaches no tile; .* 33500000 5600000 33500100 5600000 in EPSG:25833"
    ):
        indexed(survey, "r.gpkg")


def test_tiles_list_exactly_the_files_within_reach_in_their_order(survey):
    tiles = rasters.index(survey, {"dsm": "dsm.tif", "dtm": "dtm.tif"}).tiles
    rng = np.random.default_rng(3)
    corners = rng.uniform((294_900, 5_629_000), (296_800, 5_630_500), (40, 2))
    extents = [(x, y, x + 20.0, y + 30.0) for x, y in corners.tolist()]
    files = [
        VectorFile(survey / f"{k}.gpkg", True, ((tiles[0].grid.crs, extent),))
        for k, extent in enumerate(extents)
    ]
    files.append(VectorFile(survey / "anywhere.osm", True, None))
    files.append(VectorFile(survey / "nothing.gpkg", True, ()))
    with_layer, lines = with_roads(tiles, files, None)
    reach, listed = REACH_M + MARGIN_M, set()
    for tile in with_layer:
        west, south, east, north = tile.grid.bounds
        near = [
            f"{k}.gpkg"
            for k, (left, bottom, right, top) in enumerate(extents)
            if left <= east + reach
            and right >= west - reach
            and bottom <= north + reach
            and top >= south - reach
        ]
        assert tile.layer("roads").files == (*near, "anywhere.osm")
        listed.update(near)
    assert 0 < len(listed) < 40
    assert len(lines) == 41 - len(listed)
