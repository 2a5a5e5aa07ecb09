"""Folders of rasters in several CRSs and units, cut into tiles of one CRS."""

import json
import zipfile

import numpy as np
import pytest
from pyproj import Transformer

from flexroad.catalog import Catalog, CatalogError, tiling
from flexroad.catalog.grid import overlap
from flexroad.catalog.sources.rasters import index
from flexroad.catalog.tile import REACH_M
from flexroad.catalog.tiling import Conversion
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.sources import SourceFiles
from flexroad.tasks import load
from tests.make_rasters import write

FLAT = np.full((250, 250), 100, np.float32)
PATTERNS = {"dsm": "dsm.tif", "dtm": "dtm.tif"}


@pytest.fixture
def mixed(tmp_path):
    """A DSM in zone 32, and a DTM of the same ground in zone 33."""
    write(tmp_path / "dsm.tif", FLAT, 700_000, 5_700_250)
    x, y = Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True).transform(700_125, 5_700_125)
    write(tmp_path / "dtm.tif", np.full((400, 400), 99, np.float32), x - 200, y + 200, crs="EPSG:25833")
    return tmp_path


@pytest.mark.parametrize("name", ["c.parquet", "c.json"])
def test_layer_in_another_crs_needs_reproject(mixed, name):
    """The decision is in the catalog, in fingerprints and in what the check says."""
    texts = []
    for conversion, end in (
        (Conversion(), "tiles there will fail; --reproject warps such files when they are read"),
        (Conversion(True), "reprojected when it is read, bilinearly"),
        (Conversion(True, height_unit="metre"), "reprojected when it is read, bilinearly"),
    ):
        result = index(mixed, PATTERNS, conversion=conversion)
        assert result.notes[0] == f"dtm is in EPSG:25833, not EPSG:25832, in dtm.tif: {end}"
        assert [tile.id for tile in result.tiles] == ["700000_5700000"]
        Catalog(result.tiles).write(mixed / name)
        (tile,) = Catalog.read(mixed / name).tiles
        read = [(layer.name, layer.reproject, layer.height_unit) for layer in tile.layers]
        unit = conversion.height_unit
        assert read == [("dsm", False, unit), ("dtm", conversion.reproject, unit)]
        findings = [one.text for one in expected_failures([tile], load_config("paper"), ("dsm", "dtm"))]
        refused = any("dtm is in EPSG:25833, not EPSG:25832" in text for text in findings)
        assert refused != conversion.reproject
        texts.append(json.loads(SourceFiles(tile, lambda path: None, checksum=False).text(tile.layer("dtm"))))
    assert len(texts[0]) == 4
    assert texts[1:] == [[*texts[0], ["reproject", True, unit]] for unit in (None, "metre")]
    data = load.load(tile, load.Options())
    assert (data.dsm == 100).all()
    np.testing.assert_allclose(data.dtm, 99)


@pytest.mark.parametrize(
    ("crs", "place", "cell", "target", "match"),
    [
        ("EPSG:2263", (985_000, 200_000), 3, "EPSG:32618", "^dsm.tif .*US survey feet; "),
        ("EPSG:3857", (1_113_000, 6_621_000), 1, "EPSG:32632", "^dsm.tif: a metre of EPSG:3857 is 0.629 m "),
        ("EPSG:4326", (6.1, 50.8), 1e-5, "EPSG:32632", "^dsm.tif is in EPSG:4326, whose unit is degrees; "),
    ],
)
def test_dsm_not_in_metres_is_refused_with_the_options_that_accept_it(
    tmp_path, crs, place, cell, target, match
):
    """One unit of Web Mercator at 51 degrees north is 0.63 m. A target is never chosen silently."""
    write(tmp_path / "dsm.tif", FLAT, *place, cell=cell, crs=crs)
    for conversion in (Conversion(), Conversion(reproject=True)):
        with pytest.raises(CatalogError, match=f"{match}.*--reproject --to-crs {target}$"):
            index(tmp_path, {"dsm": "dsm.tif"}, conversion=conversion)
    result = index(tmp_path, {"dsm": "dsm.tif"}, tile_size_m=20, conversion=Conversion(True, target))
    assert {tile.grid.crs for tile in result.tiles} == {target}


@pytest.mark.parametrize(
    ("reproject", "to_crs", "message"),
    [
        (False, "EPSG:25832", "--to-crs EPSG:25832 needs --reproject"),
        (True, "EPSG:2263", "is in US survey foot; give a projected CRS in metres"),
        (True, "EPSG:4326", "is in degree; give a projected CRS in metres"),
        (True, "EPSG:3395", "^--to-crs EPSG:3395: a metre .*; give --to-crs EPSG:32632$"),
    ],
)
def test_conversion_that_makes_no_metric_tiles_raises_error(tmp_path, reproject, to_crs, message):
    write(tmp_path / "dsm.tif", FLAT, 1_113_000, 6_621_000, crs="EPSG:3857")
    with pytest.raises(CatalogError, match=message):
        index(tmp_path, {"dsm": "dsm.tif"}, conversion=Conversion(reproject, to_crs))


@pytest.mark.parametrize(
    ("crs", "cell", "place", "expected"),
    [
        ("EPSG:25832", 0.4, (900_000, 5_700_000), 0.4),
        ("EPSG:2263", 1.0, (985_000, 200_000), 0.25),
        ("EPSG:2263", 3.0, (985_000, 200_000), 1),
        ("EPSG:2263", 5.0, (985_000, 200_000), 2),
        ("EPSG:3857", 1.0, (1_500_000, 6_900_000), 0.5),
        ("EPSG:4326", 1e-5, (13.4, 52.5), 0.5),
    ],
)
def test_cells_of_tiles_with_a_reprojected_dsm(tmp_path, crs, cell, place, expected):
    """That of the file if it is true in metres, else a round number near it."""
    write(tmp_path / "dsm.tif", np.ones((300, 300), np.float32), *place, cell=cell, crs=crs)
    target = "EPSG:32118" if crs == "EPSG:2263" else "EPSG:25833"
    result = index(tmp_path, {"dsm": "dsm.tif"}, tile_size_m=20, conversion=Conversion(True, target))
    assert {tile.grid.cell for tile in result.tiles} == {expected}


def test_tiles_beside_a_turned_dsm_are_left_out(tmp_path):
    """In the next zone the square is turned, and its bounds reach over ground without data."""
    write(tmp_path / "dsm.tif", np.ones((1000, 1000), np.float32), 900_000, 5_700_000)
    conversion = Conversion(True, "EPSG:25833")
    everything = index(tmp_path, {"dsm": "dsm.tif"}, tile_size_m=50, conversion=conversion, min_cover=0)
    tiles = index(tmp_path, {"dsm": "dsm.tif"}, tile_size_m=50, conversion=conversion).tiles
    assert len(tiles) < len(everything.tiles)
    to_source = Transformer.from_crs("EPSG:25833", "EPSG:25832", always_xy=True)
    kept = {tile.id for tile in tiles}
    for tile in everything.tiles:
        x, y = to_source.transform(*np.meshgrid(tile.grid.eastings, tile.grid.northings))
        inside = (x > 900_000) & (x < 901_000) & (y < 5_700_000) & (y > 5_699_000)
        assert (inside.mean() >= 0.25) == (tile.id in kept)


@pytest.mark.parametrize(
    ("cell", "size", "remedy"),
    [
        (0.04999, 30, "round them: gdalwarp -tr 0.05 0.05 -tap -r bilinear dsm.tif dsm_new.tif"),
        (1.0004, 250, "round them: gdalwarp -tr 1 1 -tap -r bilinear dsm.tif dsm_new.tif"),
        (0.3, 250, "use --tile-size 252"),
        (4.0, 250, "use --tile-size 252"),
    ],
)
def test_cells_that_divide_no_tile_are_named_with_file_and_remedy(tmp_path, cell, size, remedy):
    write(tmp_path / "dsm.tif", np.ones((300, 300), np.float32), 400_000, 5_700_000, cell=cell)
    with pytest.raises(CatalogError) as caught:
        index(tmp_path, {"dsm": "dsm.tif"}, tile_size_m=size)
    assert str(caught.value) == (
        f"a tile of {size} m has no whole number of the cells of {cell:g} m of dsm.tif; {remedy}"
    )


@pytest.mark.parametrize(("layer", "name"), [("dsm", "dsm.zip"), ("roads", "roads.zip")])
def test_archive_is_refused_with_the_remedy(tmp_path, layer, name):
    write(tmp_path / "dsm.tif", FLAT, 700_000, 5_700_250)
    with zipfile.ZipFile(tmp_path / name, "w") as archive:
        archive.write(tmp_path / "dsm.tif", "dsm.tif")
    with pytest.raises(CatalogError, match="it is an archive: unpack it first"):
        index(tmp_path, {"dsm": "dsm.tif", layer: "*.zip"})


def test_given_crs_must_be_a_metric_one(tmp_path):
    write(tmp_path / "dsm.tif", FLAT, 1_113_000, 6_621_000, crs=None)
    with pytest.raises(CatalogError, match=r"^dsm.tif: a metre of EPSG:3857 is 0.629 m on the ground"):
        index(tmp_path, {"dsm": "dsm.tif"}, crs="EPSG:3857")
    with pytest.raises(CatalogError, match=r"it has the CRS EPSG:4326, but 111\d+ is no longitude"):
        index(tmp_path, {"dsm": "dsm.tif"}, crs="EPSG:4326")


def test_raster_layer_elsewhere_is_named(tmp_path):
    write(tmp_path / "dsm.tif", FLAT)
    write(tmp_path / "mask.tif", FLAT, 32_295_500)
    with pytest.raises(CatalogError, match="^road_mask reaches no tile: mask.tif lies at 32295500 .*:4647$"):
        index(tmp_path, {"dsm": "dsm.tif", "road_mask": "mask.tif"}, tile_size_m=20)


def test_crs_replaces_degrees_that_are_metres_in_catalog_and_load(tmp_path):
    for name in ("dsm", "dtm"):
        write(tmp_path / f"{name}.tif", FLAT, crs="EPSG:4326" if name == "dtm" else "EPSG:25832")
    with pytest.raises(CatalogError, match="it has the CRS EPSG:4326, but 29.* is no longitude"):
        index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=20)
    tiles = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=20, crs="EPSG:25832").tiles
    tile = tiles[1]
    assert (tile.layer("dsm").crs, tile.layer("dtm").crs) == (None, "EPSG:25832")
    np.testing.assert_array_equal(load.load(tile, load.Options()).dtm, FLAT[:20, :20])
    assert not [f for f in expected_failures([tile], load_config("paper"), ()) if "EPSG" in f.text]


def test_tiles_list_the_files_within_reach_whatever_number_is_looked_up_at_a_time(tmp_path, monkeypatch):
    corners = [(700_000 + 300 * column, 5_700_000 + 300 * row) for row in range(3) for column in range(3)]
    sheets = {}
    for west, south in corners:
        write(tmp_path / f"{west}_{south}.tif", np.full((300, 300), 100, np.float32), west, south + 300)
        sheets[f"{west}_{south}.tif"] = (west, south, west + 300, south + 300)
    result = index(tmp_path, {"dsm": "*.tif"}, min_cover=0)
    assert len(result.tiles) == 16
    for tile in result.tiles:
        # Overlap by more than a negative width is a distance below that.
        near = [name for name, extent in sheets.items() if overlap(extent, tile.grid.bounds, -REACH_M - 1e-6)]
        assert sorted(tile.layer("dsm").files) == sorted(near)
    monkeypatch.setattr(tiling, "AT_ONCE", 3)
    assert index(tmp_path, {"dsm": "*.tif"}, min_cover=0) == result
