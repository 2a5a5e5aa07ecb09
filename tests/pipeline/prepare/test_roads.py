"""Roads a user has become a mask, or one line that says why not."""

import geopandas
import numpy as np
import pytest
import rasterio
from shapely import LineString, Point, Polygon, box

from flexroad.catalog import Catalog, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.roads import add_roads, burn
from flexroad.pipeline.prepare.sheet import Sheet

GRID = Grid("EPSG:25832", 400_000, 5_700_100, 1.0, 80, 100)


def write(path, shapes, crs="EPSG:25832", layer=None, **columns):
    geopandas.GeoDataFrame(columns or {"id": range(len(shapes))}, geometry=shapes, crs=crs).to_file(
        path, layer=layer
    )
    return path


def test_polygons_cover_the_cells_whose_centre_they_hold(tmp_path):
    roads = write(tmp_path / "roads.gpkg", [box(400_010.4, 5_700_020, 400_020.6, 5_700_060)])
    mask = burn(roads, None, None, GRID)
    truth = np.zeros(GRID.shape, bool)
    truth[40:80, 10:21] = True
    assert np.array_equal(mask, truth)


def test_polygons_in_degrees_lie_where_they_belong(tmp_path):
    shape = box(400_010.2, 5_700_020.2, 400_020.2, 5_700_060.2)
    degrees = geopandas.GeoSeries([shape], crs="EPSG:25832").to_crs("EPSG:4326")
    roads = write(tmp_path / "roads.geojson", list(degrees), "EPSG:4326")
    assert np.array_equal(
        burn(roads, None, None, GRID), burn(write(tmp_path / "m.gpkg", [shape]), None, None, GRID)
    )


def test_features_are_chosen_by_layer_and_condition(tmp_path):
    path = tmp_path / "map.gpkg"
    shapes = [box(400_000, 5_700_000, 400_010, 5_700_100), box(400_040, 5_700_000, 400_050, 5_700_100)]
    write(path, shapes, layer="areas", kind=["road", "path"])
    write(path, [LineString([(400_000, 5_700_000), (400_050, 5_700_050)])], layer="lines")
    mask = burn(path, "areas", "kind = 'road'", GRID)
    assert mask[:, :10].all()
    assert not mask[:, 10:].any()


def test_raster_is_taken_by_nearest_neighbour(tmp_path):
    path = tmp_path / "mask.tif"
    coarse = Grid(GRID.crs, GRID.west - 20, GRID.north + 20, 2.0, 80, 80)
    values = np.arange(coarse.height * coarse.width).reshape(coarse.shape) % 3 == 0
    with rasterio.open(
        path, "w", driver="GTiff", dtype="uint8", count=1, width=80, height=80, crs=coarse.crs,
        transform=coarse.transform,
    ) as raster:  # fmt: skip
        raster.write(values.astype(np.uint8), 1)
    row, col = coarse.cells(GRID.eastings[None, :], GRID.northings[:, None])
    assert np.array_equal(burn(path, None, None, GRID), values[row, col])


def published(folder, roads, **more):
    """The only tile of a flat area whose roads were given, and what was said of it."""
    with Sheet(folder, GRID, None, {}) as sheet:
        for layer in ("dsm", "dtm"):
            sheet.write(layer, GRID, np.zeros(GRID.shape))
        masked = add_roads(sheet, Asked(roads=roads, **more))
        made = sheet.publish()
    (tile,) = Catalog.read(made.catalog).tiles
    assert masked == (tile.layer("road_mask") is not None)
    return tile, made.notes


def test_lines_go_into_the_catalog_without_a_mask(tmp_path):
    shapes = [LineString([(400_000, 5_700_050), (400_080, 5_700_050)])]
    roads = write(tmp_path / "map.gpkg", shapes, layer="ways", kind=["road"])
    write(roads, [box(400_000, 5_700_000, 400_010, 5_700_100)], layer="areas")
    tile, notes = published(tmp_path / "out", roads, roads_layer="ways", roads_where="kind = 'road'")
    assert tile.layer("road_mask") is None
    assert tile.paths(tile.layer("roads")) == (roads,)
    assert 'segment: {method: vector, layer: "ways", where: "kind = \'road\'"}' in notes[0]


def test_polygons_are_burnt_and_named_rasters_only_burnt(tmp_path):
    roads = write(tmp_path / "roads.gpkg", [box(400_000, 5_700_000, 400_010, 5_700_100)])
    tile, _ = published(tmp_path / "out", roads)
    assert tile.paths(tile.layer("roads")) == (roads,)
    again, _ = published(tmp_path / "again", tmp_path / "out" / "road_mask.tif")
    assert again.layer("road_mask") is not None
    assert again.layer("roads") is None


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
@pytest.mark.parametrize(
    ("make", "layer", "where", "says"),
    [
        (lambda path: None, None, None, "does not exist"),
        (lambda path: path.write_text("roads"), None, None, "cannot be read"),
        (lambda path: write(path, [Point(400_010, 5_700_020)]), None, None, "Points where polygons or lines"),
        (lambda path: write(path, [LineString([(0, 0), (1, 1)])]), None, None, "no road of .* lies in the"),
        (lambda path: write(path, [box(0, 0, 9, 9)]), None, None, "no road of .* lies in the area"),
        (lambda path: write(path, [box(0, 0, 9, 9)], crs=None), None, None, "no CRS"),
        (lambda path: write(path, [box(0, 0, 9, 9)]), "streets", None, "no layer 'streets'"),
        (lambda path: write(path, [box(0, 0, 9, 9)]), None, "id = 7", "no feature where id = 7"),
        (lambda path: write(path, [box(0, 0, 9, 9)]), None, "kind = 'road'", "--roads-where"),
        (lambda path: write(path, [Polygon()]), None, None, "no road"),
    ],
)  # fmt: skip
def test_what_is_no_road_is_one_line(tmp_path, make, layer, where, says):
    path = tmp_path / "roads.gpkg"
    make(path)
    with pytest.raises(ConfigError, match=says) as caught:
        burn(path, layer, where, GRID)
    assert "\n" not in str(caught.value)
    assert "roads" in str(caught.value)
