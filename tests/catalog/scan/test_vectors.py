"""Tiles list the vector files of roads that reach them."""

import contextlib
import json
import sqlite3

import numpy as np
import pytest
from geopandas import GeoSeries
from shapely import LineString, box

from flexroad.catalog import Catalog, CatalogError
from flexroad.catalog.scan.vectors import MARGIN_M, VectorFile, layers, with_roads
from flexroad.catalog.sources import rasters
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


def road(west, east):
    return LineString([(west, 5_629_300), (east, 5_629_300)])


def indexed(root, roads, crs=None):
    return rasters.index(root, {"dsm": "dsm.tif", "dtm": "dtm.tif", "roads": str(roads)}, crs=crs).tiles


def named(tiles):
    return [
        [path.name for path in tile.paths(layer)] if (layer := tile.layer("roads")) else [] for tile in tiles
    ]


def test_roads_file_is_listed_by_tiles_in_reach(survey, tmp_path):
    """The first road ends 99 m west of the last tile, the other 20 m within it."""
    write_roads(survey / "a.gpkg", [road(295_400, 295_901)])
    write_roads(survey / "b.gpkg", [road(296_020, 296_900)])
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
    path = write_roads(survey / f"a.{suffix}", [road(295_500, 295_600)], xxxxxxx=["stone"])
    in_cp1252(path, "xxxxxxx", "Straßen")
    assert layers(path) == {"a": "LineString, 1 feature"}
    assert named(indexed(survey, path)) == [[path.name], [path.name], []]


def test_roads_file_outside_folder_in_other_crs_is_used(survey, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    lines = GeoSeries([road(295_400, 295_600)], crs="EPSG:25832").to_crs("EPSG:4326")
    path = write_roads(tmp_path / "elsewhere" / "r.geojson", lines, "EPSG:4326")
    tiles = indexed(survey, path, crs="EPSG:25832")
    # The second tile is 150 m away.
    assert named(tiles) == [["r.geojson"], ["r.geojson"], []]
    roads = tiles[0].layer("roads")
    assert tiles[0].paths(roads) == (path,)
    # Bounds in degrees are the bounds of a slightly turned rectangle.
    assert roads.extents[0] == pytest.approx((295_399, 5_629_299, 295_601, 5_629_301), abs=25)
    assert roads.reaching((295_500.0, 5_629_250.0, 295_600.0, 5_629_350.0)) == roads
    assert roads.reaching((295_500.0, 5_629_350.0, 295_600.0, 5_629_400.0)) is None
    # True degrees are not replaced by the CRS given.
    assert roads.crs is None
    query = Query(path, None, None, (), "EPSG:25832", tiles[0].grid.crs)
    assert len(read_near(query, (0, 0, 1e6, 1e7))) == 1


def test_osm_file_without_bounds_is_used_by_all_tiles(survey):
    write_osm(survey / "map.osm", {"highway=service": [(6.1, 50.7), (6.2, 50.8)]})
    tiles = indexed(survey, "map.osm")
    assert named(tiles) == [["map.osm"]] * 3
    roads = tiles[0].layer("roads")
    assert roads.reaching((0.0, 0.0, 1.0, 1.0)) == roads


def test_roads_of_all_tiles_have_the_crs_of_files_without_one(survey):
    """Only the first file, near the first tile, has no CRS; the last tile lists the other one."""
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        write_roads(survey / "a.gpkg", [road(295_500, 295_510)], None)
    write_roads(survey / "b.gpkg", [road(296_020, 296_200)])
    with pytest.raises(CatalogError, match=r"--roads .*a.gpkg has no CRS; give it with --crs"):
        indexed(survey, "a.gpkg")
    tiles = indexed(survey, "?.gpkg", "EPSG:25832")
    assert named(tiles) == [["a.gpkg"], ["b.gpkg"], ["b.gpkg"]]
    assert [tile.layer("roads").crs for tile in tiles] == ["EPSG:25832"] * 3


def test_file_of_several_layers_needs_the_choice_of_one(survey):
    write_roads(survey / "r.gpkg", [road(295_500, 295_600)] * 3, layer="ways")
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


FAR = "reaches no tile; check its CRS and its extent: it lies at {} in EPSG:{}, the tiles at 295500 56.*"


@pytest.mark.parametrize(
    ("make", "name", "message"),
    [
        (None, "r.gpkg", "^no file matches --roads 'r.gpkg' below .*; there are dsm.tif"),
        (lambda path: path.write_text("roads"), "r.gpkg", "^--roads .*r.gpkg is not a vector file"),
        (None, "dsm.tif", "^--roads .*dsm.tif is not a vector file"),
        (
            lambda path: write_roads(path, [road(32_295_500, 32_295_600)]),
            "r.gpkg",
            FAR.format("32295500 5629300 32295600 5629300", 25832) + "declare EPSG:4647$",
        ),
        (
            # Eastings with the zone's number in EPSG:25833 have no position in EPSG:25832.
            lambda path: write_roads(path, [road(33_500_000, 33_500_100)], "EPSG:25833"),
            "r.gpkg",
            FAR.format("33500000 5629300 33500100 5629300", 25833),
        ),
    ],
)
def test_invalid_roads_file_raises_one_line(survey, make, name, message):
    if make:
        make(survey / "r.gpkg")
    with pytest.raises(CatalogError, match=message) as caught:
        indexed(survey, name)
    assert "\n" not in str(caught.value)


def test_crs_replaces_degrees_that_are_metres_in_catalog_and_reader(survey):
    """A GeoJSON with metres and no CRS: GDAL says EPSG:4326."""
    geometry = {"type": "LineString", "coordinates": [[295_400, 5_629_300], [295_600, 5_629_300]]}
    feature = {"type": "Feature", "properties": {"width": 8.0}, "geometry": geometry}
    path = survey / "plain.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    with pytest.raises(CatalogError) as error:
        indexed(survey, path)
    assert str(error.value) == (
        f"--roads {path} has the CRS EPSG:4326, but 295600 is no longitude; "
        "give its CRS with --crs, or add it to the file with ogr2ogr -a_srs"
    )
    tiles = indexed(survey, path, crs="EPSG:25832")
    assert named(tiles) == [["plain.geojson"], ["plain.geojson"], []]
    roads = tiles[0].layer("roads")
    assert roads.crs == "EPSG:25832"
    assert roads.extents == ((295_399.0, 5_629_299.0, 295_601.0, 5_629_301.0),)
    query = Query(path, None, None, ("width",), roads.crs, tiles[0].grid.crs)
    read = read_near(query, tiles[0].grid.bounds)
    assert read.total_bounds.tolist() == [295_400, 5_629_300, 295_600, 5_629_300]
    assert read.crs == "EPSG:25832"


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
