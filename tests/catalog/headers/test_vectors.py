"""Tiles list the vector files of roads that reach them."""

import numpy as np
import pytest
from shapely import LineString, box

from flexroad.catalog import Catalog, CatalogError
from flexroad.catalog.sources import nrw, rasters
from tests.make_rasters import write
from tests.make_roads import write as write_roads
from tests.make_roads import write_osm

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
    with pytest.raises(CatalogError, match=rf"r.gpkg has 2 layers: {both}; name one with --roads-layer$"):
        indexed(survey, "r.gpkg")
    patterns = {"dsm": "dsm.tif", "roads": "r.gpkg"}
    with pytest.raises(CatalogError, match=rf"r.gpkg has no layer 'roads'; it has {both}$"):
        rasters.index(survey, patterns, roads_layer="roads")
    result = rasters.index(survey, patterns, roads_layer="ways")
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
