"""Areas select the tiles that their polygons overlap, in any CRS and format."""

import json
from itertools import product

import geopandas
import numpy as np
import pytest
import shapely
from pyproj import Transformer

from flexroad.catalog import Grid
from flexroad.catalog.area import Area
from flexroad.catalog.errors import CatalogError
from tests import make_roads

GRIDS = [Grid("EPSG:25832", 500000.0 + 100 * i, 5600100.0, 1.0, 100, 100) for i in range(5)]
"""Five tiles in a row."""


def rectangle(west, east, south=5600000, north=5600100):
    return shapely.box(500000 + west, south, 500000 + east, north)


def written(path, *shapes, crs="EPSG:25832", **options):
    geopandas.GeoDataFrame(geometry=list(shapes), crs="EPSG:25832").to_crs(crs).to_file(path, **options)
    return path


CRSS = ("EPSG:25832", "EPSG:4326", "EPSG:3857")


@pytest.mark.parametrize(
    ("suffix", "crs"),
    [(".geojson", "EPSG:4326"), *product((".gpkg", ".shp", ".fgb"), CRSS)],
)
def test_area_of_each_format_and_crs_touches_the_tiles_under_it(tmp_path, suffix, crs):
    path = written(tmp_path / f"area{suffix}", rectangle(150, 250), rectangle(401, 420), crs=crs)
    assert Area.read(path).touched(GRIDS) == [False, True, True, False, True]


@pytest.mark.parametrize("suffix", [".gpkg", ".shp"])
def test_area_with_columns_in_another_encoding_than_declared_is_read(tmp_path, suffix):
    path = make_roads.write(tmp_path / f"area{suffix}", [rectangle(150, 250)], xxxxxxx=["stone"])
    make_roads.in_cp1252(path, "xxxxxxx", "Straßen")
    assert Area.read(path).touched(GRIDS) == [False, True, True, False, False]


RING = rectangle(0, 500, 5599900, 5600200) - rectangle(150, 350, 5599950, 5600150)
BOW = shapely.Polygon([(500000, 5600000), (500000, 5600100), (500150, 5600000), (500150, 5600100)])


@pytest.mark.parametrize(
    ("shape", "crs", "touched"),
    [
        # As with --bbox; also if transformed coordinates are off by rounding.
        (rectangle(100, 200), "EPSG:25832", [1]),
        (rectangle(100, 200), "EPSG:4326", [1]),
        (rectangle(99.99, 200.01), "EPSG:25832", [0, 1, 2]),
        (RING, "EPSG:25832", [0, 1, 3, 4]),
        (BOW, "EPSG:25832", [0, 1]),
    ],
    ids=["ends on an edge", "in degrees", "ends beyond an edge", "has a hole", "crosses itself"],
)
def test_area_touches_the_tiles_that_it_overlaps(tmp_path, shape, crs, touched):
    area = Area.read(written(tmp_path / "a.gpkg", shape, crs=crs))
    assert [number for number, touches in enumerate(area.touched(GRIDS)) if touches] == touched


def test_area_of_degrees_has_straight_sides_in_degrees(tmp_path):
    """A parallel is curved in metres: the area is taken from the file, not from its transformed corners."""
    north = 5600100 - 0.5
    to_degrees = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    _, latitude = to_degrees.transform(500000, north)
    path = tmp_path / "area.geojson"
    corners = [[8.0, latitude], [10.0, latitude], [10.0, latitude + 1], [8.0, latitude + 1], [8.0, latitude]]
    path.write_text(json.dumps({"type": "Polygon", "coordinates": [corners]}))
    # The parallel of 8 and 10 degrees lies about 480 m further north in UTM than that of 9 degrees.
    assert Area.read(path).touched(GRIDS[:1]) == [True]


def test_layer_is_chosen_by_name(tmp_path):
    path = written(tmp_path / "a.gpkg", rectangle(0, 50), layer="west")
    written(path, rectangle(450, 480), layer="east")
    assert Area.read(f"{path}|layername=east").touched(GRIDS) == [False] * 4 + [True]
    with pytest.raises(
        CatalogError, match=r"has 2 layers: west \(.*\), east \(.*\); name one, such as .*layername=west'$"
    ):
        Area.read(path)
    with pytest.raises(CatalogError, match=r"has no layer 'north'; it has west \("):
        Area.read(f"{path}|layername=north")


def test_tile_that_cannot_be_placed_in_the_crs_of_the_area_is_not_touched():
    far = Grid("EPSG:25832", 1e9, 1e9, 1.0, 100, 100)
    area = Area("a.gpkg", "EPSG:3857", np.array([shapely.box(-1e9, -1e9, 1e9, 1e9)]))
    assert area.touched([far]) == [False]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.gpkg", None, "cannot be read: .*No such file"),
        ("text.geojson", "hello", "is not a vector file"),
        ("broken.geojson", "{", "cannot be read: "),
        ("empty.geojson", '{"type": "FeatureCollection", "features": []}', "has no polygons"),
        ("point.geojson", '{"type": "Point", "coordinates": [9, 50]}', "has no polygons; draw the area"),
        ("none.geojson", '{"type": "Feature", "properties": {}, "geometry": null}', "has no polygons"),
    ],
)
def test_file_without_polygons_is_refused_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    if content is not None:
        path.write_text(content)
    with pytest.raises(CatalogError, match=f"^--area {path} .*{message}") as caught:
        Area.read(path)
    assert "\n" not in str(caught.value)


def test_file_without_a_crs_is_refused(tmp_path):
    path = tmp_path / "a.gpkg"
    with pytest.warns(UserWarning, match="crs"):
        geopandas.GeoDataFrame(geometry=[rectangle(0, 50)]).to_file(path)
    with pytest.raises(CatalogError, match="has no CRS; add it with ogr2ogr -a_srs EPSG:N NEW a.gpkg"):
        Area.read(path)
