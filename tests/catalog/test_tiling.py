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


def test_layer_in_another_crs_needs_reproject(mixed):
    result = index(mixed, PATTERNS)
    assert result.notes[0] == (
        "dtm is in EPSG:25833, not EPSG:25832, in dtm.tif: tiles there will fail; "
        "--reproject warps such files when they are read"
    )
    assert not any(layer.reproject for tile in result.tiles for layer in tile.layers)
    result = index(mixed, PATTERNS, conversion=Conversion(reproject=True))
    assert result.notes[0] == (
        "dtm is in EPSG:25833, not EPSG:25832, in dtm.tif: reprojected when it is read, bilinearly"
    )
    assert [tile.id for tile in result.tiles] == ["700000_5700000"]
    layers = {layer.name: layer.reproject for layer in result.tiles[0].layers}
    assert layers == {"dsm": False, "dtm": True}
    data = load.load(result.tiles[0], load.Options())
    assert (data.dsm == 100).all()
    np.testing.assert_allclose(data.dtm, 99)


@pytest.mark.parametrize("name", ["c.parquet", "c.json"])
def test_decision_to_reproject_is_part_of_the_catalog(mixed, name):
    conversion = Conversion(reproject=True, height_unit="metre")
    tiles = index(mixed, PATTERNS, conversion=conversion).tiles
    Catalog(tiles).write(mixed / name)
    (read,) = Catalog.read(mixed / name).tiles
    assert (read.layer("dtm").reproject, read.layer("dtm").height_unit) == (True, "metre")
    assert (read.layer("dsm").reproject, read.layer("dsm").height_unit) == (False, "metre")
    assert not list(expected_failures([read], load_config("paper"), ("dsm", "dtm")))[1:]
    Catalog(index(mixed, PATTERNS).tiles).write(mixed / name)
    (read,) = Catalog.read(mixed / name).tiles
    assert not read.layer("dtm").reproject
    findings = [finding.text for finding in expected_failures([read], load_config("paper"), ())]
    assert any("dtm is in EPSG:25833, not EPSG:25832" in text for text in findings)


def test_fingerprint_changes_with_the_decision_to_reproject(mixed):
    plain, warped, feet = (
        index(mixed, PATTERNS, conversion=conversion).tiles[0]
        for conversion in (Conversion(), Conversion(True), Conversion(True, height_unit="foot"))
    )
    entries = [
        json.loads(SourceFiles(tile, lambda path: None, checksum=False).text(tile.layer("dtm")))
        for tile in (plain, warped, feet)
    ]
    assert len(entries[0]) == 4
    assert entries[1][:4] == entries[0] != entries[1] != entries[2]


def test_dsm_in_feet_is_refused_with_the_options_that_accept_it(tmp_path):
    write(tmp_path / "dsm.tif", FLAT, 985_000, 200_000, cell=3, crs="EPSG:2263")
    patterns = {"dsm": "dsm.tif"}
    with pytest.raises(CatalogError, match=r"US survey feet; .* or use --reproject --to-crs EPSG:32618$"):
        index(tmp_path, patterns)
    # A target is never chosen silently.
    with pytest.raises(CatalogError, match="--reproject --to-crs EPSG:32618$"):
        index(tmp_path, patterns, conversion=Conversion(reproject=True))
    result = index(tmp_path, patterns, conversion=Conversion(True, "EPSG:32618"))
    assert {tile.grid.crs for tile in result.tiles} == {"EPSG:32618"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((False, "EPSG:25832"), "--to-crs EPSG:25832 needs --reproject"),
        ((True, "EPSG:2263"), "is in US survey foot; give a projected CRS in metres"),
        ((True, "EPSG:4326"), "is in degree; give a projected CRS in metres"),
    ],
)
def test_conversion_that_makes_no_metric_tiles_raises_error(options, message):
    with pytest.raises(CatalogError, match=message):
        Conversion(*options)


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


def test_dsm_in_web_mercator_is_refused_with_the_options_that_accept_it(tmp_path):
    """One unit at 51 degrees north is 0.63 m."""
    write(tmp_path / "dsm.tif", FLAT, 1_113_000, 6_621_000, crs="EPSG:3857")
    patterns = {"dsm": "dsm.tif"}
    match = r"^dsm.tif: a metre of EPSG:3857 is 0.629 m .* or use --reproject --to-crs EPSG:32632$"
    with pytest.raises(CatalogError, match=match):
        index(tmp_path, patterns)
    with pytest.raises(CatalogError, match="^--to-crs EPSG:3395: a metre .*; give --to-crs EPSG:32632$"):
        index(tmp_path, patterns, conversion=Conversion(True, "EPSG:3395"))
    result = index(tmp_path, patterns, tile_size_m=20, conversion=Conversion(True, "EPSG:32632"))
    assert {tile.grid.crs for tile in result.tiles} == {"EPSG:32632"}


def test_given_crs_that_is_no_metric_one_is_refused(tmp_path):
    write(tmp_path / "dsm.tif", FLAT, 1_113_000, 6_621_000, crs=None)
    with pytest.raises(CatalogError, match=r"^dsm.tif: a metre of EPSG:3857 is 0.629 m on the ground"):
        index(tmp_path, {"dsm": "dsm.tif"}, crs="EPSG:3857")
    with pytest.raises(CatalogError, match=r"it has the CRS EPSG:4326, but 111\d+ is no longitude"):
        index(tmp_path, {"dsm": "dsm.tif"}, crs="EPSG:4326")


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


def test_raster_layer_elsewhere_is_named_with_both_places(tmp_path):
    write(tmp_path / "dsm.tif", FLAT)
    write(tmp_path / "mask.tif", FLAT, 32_295_500)
    with pytest.raises(CatalogError) as error:
        index(tmp_path, {"dsm": "dsm.tif", "road_mask": "mask.tif"}, tile_size_m=20)
    assert "road_mask reaches no tile: mask.tif lies at 32295500 " in str(error.value)
    assert "in EPSG:25832, the tiles at 295500 " in str(error.value)
    assert str(error.value).endswith("the number of a zone: declare EPSG:4647")


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
