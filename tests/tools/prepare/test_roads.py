"""The user's roads are converted to a mask; invalid roads are an error of one line."""

from pathlib import Path

import geopandas
import numpy as np
import pytest
import rasterio
from shapely import LineString, Point, Polygon, box

from flexroad.catalog import Catalog, CatalogError, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import TaskError, memory
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.raster_writer import RasterWriter
from flexroad.tools.prepare.roads import add_roads, burn, check_roads
from tests.command_line import call
from tests.make_roads import in_cp1252, write, write_osm

GRID = Grid("EPSG:25832", 400_000, 5_700_100, 1.0, 80, 100)


def test_burn_polygons_cover_cells_with_centre_inside(tmp_path):
    roads = write(tmp_path / "roads.gpkg", [box(400_010.4, 5_700_020, 400_020.6, 5_700_060)])
    mask = burn(roads, None, None, GRID)
    truth = np.zeros(GRID.shape, bool)
    truth[40:80, 10:21] = True
    assert np.array_equal(mask, truth)


def test_burn_polygons_in_degrees_are_reprojected(tmp_path):
    shape = box(400_010.2, 5_700_020.2, 400_020.2, 5_700_060.2)
    degrees = geopandas.GeoSeries([shape], crs="EPSG:25832").to_crs("EPSG:4326")
    roads = write(tmp_path / "roads.geojson", list(degrees), "EPSG:4326")
    assert np.array_equal(
        burn(roads, None, None, GRID), burn(write(tmp_path / "m.gpkg", [shape]), None, None, GRID)
    )


def test_burn_selects_features_by_layer_and_condition(tmp_path):
    path = tmp_path / "map.gpkg"
    shapes = [box(400_000, 5_700_000, 400_010, 5_700_100), box(400_040, 5_700_000, 400_050, 5_700_100)]
    write(path, shapes, layer="areas", kind=["road", "path"])
    write(path, [LineString([(400_000, 5_700_000), (400_050, 5_700_050)])], layer="lines")
    mask = burn(path, "areas", "kind = 'road'", GRID)
    assert mask[:, :10].all()
    assert not mask[:, 10:].any()


def test_burn_reads_text_in_another_encoding_than_declared(tmp_path):
    path = write(tmp_path / "a.shp", [box(400_000, 5_700_000, 400_010, 5_700_100)], name=["xxxxxx"])
    in_cp1252(path, "xxxxxx", "Straße")
    check_roads(PrepareOptions(roads=path))
    assert burn(path, None, None, GRID).sum() == 1000
    _, notes = published(tmp_path / "out", path)
    assert [note for note in notes if "encoding" in note] == [
        "--roads: the text of a.shp is not in the encoding that it declares, and was read as cp1252; "
        "write it as UTF-8, or name its encoding in the .cpg of a Shapefile"
    ]


@pytest.mark.parametrize("suffix", ["shp", "fgb", "geojson"])
def test_burn_selects_features_by_any_column(suffix, tmp_path):
    shapes = [box(400_000, 5_700_000, 400_010, 5_700_100), box(400_040, 5_700_000, 400_050, 5_700_100)]
    path = write(tmp_path / f"a.{suffix}", shapes, surface=["gravel", "asphalt"])
    mask = burn(path, None, "surface = 'asphalt'", GRID)
    assert mask[:, 40:50].all()
    assert mask.sum() == 1000


def test_burn_raster_is_resampled_by_nearest_neighbour(tmp_path):
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


def test_burn_raster_larger_than_memory_raises_before_it_is_read(tmp_path, monkeypatch):
    path = tmp_path / "mask.tif"
    with rasterio.open(
        path, "w", driver="GTiff", dtype="uint8", count=1, width=2000, height=2000, crs=GRID.crs,
        transform=GRID.transform, sparse_ok=True,
    ):  # fmt: skip
        pass
    monkeypatch.setattr(memory, "limit", lambda: 10**7)
    with pytest.raises(TaskError, match="--roads .*mask.tif, 2,000 x 2,000 cells, .* cut it to the area"):
        burn(path, None, None, GRID)


LAYERS = (
    r"has 2 layers: ways \(LineString, 1 feature\), areas \(Polygon, 1 feature\); name one, such as .*ways"
)


def published(folder, roads, layer="", **options):
    """The only tile of a flat area with these roads, and the notes."""
    with RasterWriter(folder, GRID, None, {}) as writer:
        for name in ("dsm", "dtm"):
            writer.write(name, GRID, np.zeros(GRID.shape))
        has_mask = add_roads(writer, PrepareOptions(roads=Path(f"{roads}{layer}"), **options))
        dataset = writer.publish()
    (tile,) = Catalog.read(dataset.catalog, [roads.parent]).tiles
    assert has_mask == (tile.layer("road_mask") is not None)
    return tile, dataset.notes


def test_add_roads_lines_are_in_catalog_without_mask(tmp_path):
    shapes = [LineString([(400_000, 5_700_050), (400_080, 5_700_050)])]
    roads = write(tmp_path / "map.gpkg", shapes, layer="ways", kind=["road"])
    write(roads, [box(400_000, 5_700_000, 400_010, 5_700_100)], layer="areas")
    tile, notes = published(tmp_path / "out", roads, "|layername=ways", roads_where="kind = 'road'")
    assert tile.layer("road_mask") is None
    assert tile.paths(tile.layer("roads")) == (roads,)
    assert tile.layer("roads").sublayer == "ways"
    assert "segment: {method: vector, where: \"kind = 'road'\"}" in notes[0]
    with pytest.raises(CatalogError, match=LAYERS):
        published(tmp_path / "again", roads)
    with pytest.raises(CatalogError, match="has no layer 'lanes'; it has ways"):
        published(tmp_path / "again", roads, "|layername=lanes")


def test_add_roads_polygons_are_in_catalog_and_rasters_are_not(tmp_path):
    roads = write(tmp_path / "roads.gpkg", [box(400_000, 5_700_000, 400_010, 5_700_100)])
    tile, _ = published(tmp_path / "out", roads)
    assert tile.paths(tile.layer("roads")) == (roads,)
    again, _ = published(tmp_path / "again", tmp_path / "out" / "road_mask.tif")
    assert again.layer("road_mask") is not None
    assert again.layer("roads") is None


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
@pytest.mark.parametrize(
    ("make", "layer", "where", "message"),
    [
        (lambda path: None, None, None, "does not exist"),
        (lambda path: path.write_text("roads"), None, None, "cannot be read"),
        (lambda path: write(path, [box(0, 0, 9, 9)], crs=None), None, None, "no CRS"),
        (
            lambda path: write(path, [box(5e5, 5e6, 5e5 + 9, 5e6 + 9)], crs="EPSG:4326"), None, None,
            "has the CRS EPSG:4326, but 500009 is no longitude; declare its CRS with ogr2ogr -a_srs",
        ),
        (lambda path: write(path, [box(0, 0, 9, 9)]), "|layername=streets", None, "no layer 'streets'"),
        (lambda path: write(path, [box(0, 0, 9, 9)]), None, "id = 7", "no feature where id = 7"),
        (lambda path: write(path, [box(0, 0, 9, 9)]), None, "kind = 'road'", "--roads-where"),
    ],
)  # fmt: skip
def test_check_roads_without_usable_features_raises_one_line(tmp_path, make, layer, where, message):
    path = tmp_path / "roads.gpkg"
    make(path)
    with pytest.raises((CatalogError, ConfigError), match=message) as caught:
        check_roads(PrepareOptions(roads=Path(f"{path}{layer or ''}"), roads_where=where))
    assert "\n" not in str(caught.value)
    assert "roads" in str(caught.value)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        ([Point(400_010, 5_700_020)], "Points, but roads must be"),
        ([LineString([(0, 0), (1, 1)])], "no road of .* is in the area"),
        ([box(0, 0, 9, 9)], "no road of .* is in the area"),
        ([Polygon()], "no road"),
    ],
)
def test_burn_roads_elsewhere_or_of_no_area_raises_one_line(tmp_path, shapes, message):
    path = write(tmp_path / "roads.gpkg", shapes)
    with pytest.raises(ConfigError, match=message) as caught:
        burn(path, None, None, GRID)
    assert "\n" not in str(caught.value)


def test_valid_roads_pass_the_check(tmp_path):
    check_roads(PrepareOptions())
    ways = write_osm(tmp_path / "ways.osm", {"highway=residential": [(9.0, 50.0), (9.1, 50.0)]})
    check_roads(PrepareOptions(roads=ways))
    polygons = write(tmp_path / "roads.gpkg", [box(400_000, 5_700_000, 400_010, 5_700_100)])
    check_roads(PrepareOptions(roads=polygons))
    published(tmp_path / "out", polygons)
    check_roads(PrepareOptions(roads=tmp_path / "out" / "road_mask.tif"))


@pytest.mark.parametrize("name", ["input.laz", "input.obj", "input.jpg"])
def test_prepare_checks_roads_before_it_reads_its_input(name, tmp_path):
    broken = tmp_path / name
    broken.write_text("nothing")
    words = ("prepare", broken, "-o", tmp_path / "out", "--roads", tmp_path / "none.gpkg")
    assert call(*words).expected(2).errors == [f"error: --roads {tmp_path / 'none.gpkg'} does not exist"]
