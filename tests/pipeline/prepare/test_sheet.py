"""An area's rasters: what GIS and `run` expect of them, and nothing half-written."""

import numpy as np
import pytest
import rasterio
from rio_cogeo.cogeo import cog_validate

from flexroad.catalog import Catalog, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.prepare.sheet import Sheet
from flexroad.tasks.types import Orthophoto

CRS = "EPSG:25832"
FACTS = {"SOURCE": "made", "DTM": "a slope"}


def grid(width=700, height=600):
    return Grid(CRS, 400_000, 5_700_000, 1.0, width, height)


def heights(where):
    return where.eastings[None, :] / 1e4 + where.northings[:, None] / 1e5


def blocks(whole, size=300):
    for row in range(0, whole.height, size):
        for col in range(0, whole.width, size):
            height, width = min(size, whole.height - row), min(size, whole.width - col)
            yield Grid(CRS, whole.west + col, whole.north - row, 1.0, width, height)


def fill(sheet, dop=True):
    for part in blocks(sheet.grid):
        sheet.write("dsm", part, heights(part))
        sheet.write("dtm", part, np.where(part.eastings < 400_010, np.nan, heights(part)))
        sheet.write("road_mask", part, heights(part) > 97)
        if dop:
            pixels = Grid(CRS, part.west, part.north, 0.5, 2 * part.width, 2 * part.height)
            colour = np.full((3, *pixels.shape), 200, np.uint8)
            sheet.write_photo(Orthophoto(pixels, colour, np.ones(pixels.shape, bool)))


def make(out, filling):
    with Sheet(out, grid(), None, FACTS) as sheet:
        filling(sheet)
        sheet.publish()


def test_rasters_are_cogs_as_gis_expect_them(tmp_path):
    with Sheet(tmp_path, grid(), 0.5, FACTS) as sheet:
        fill(sheet)
        sheet.publish()
    for name in ("dsm", "dtm", "road_mask", "dop"):
        path = tmp_path / f"{name}.tif"
        valid, errors, warnings = cog_validate(path, strict=True, quiet=True)
        assert valid, errors
        assert not warnings
        with rasterio.open(path) as raster:
            assert raster.crs == rasterio.CRS.from_string(CRS)
            assert raster.tags()["AREA_OR_POINT"] == "Area"
            assert raster.tags().items() >= FACTS.items()
            assert raster.overviews(1)
            band = raster.read(1, masked=True)
            told = float(raster.tags(1)["STATISTICS_MEAN"])
            assert told == pytest.approx(float(band.mean(dtype=float)), rel=1e-5)


def test_blocks_join_and_unknown_stays_unknown(tmp_path):
    with Sheet(tmp_path, grid(), 0.5, FACTS) as sheet:
        fill(sheet)
        sheet.publish()
    with rasterio.open(tmp_path / "dsm.tif") as raster:
        np.testing.assert_allclose(raster.read(1), heights(grid()), rtol=1e-6)
    with rasterio.open(tmp_path / "dtm.tif") as raster:
        assert np.isnan(raster.nodata)
        assert np.array_equal(np.isnan(raster.read(1)[0]), grid().eastings < 400_010)


def test_pixels_without_colour_are_masked(tmp_path):
    whole = grid(100, 100)
    with Sheet(tmp_path, whole, 0.5, FACTS) as sheet:
        fill(sheet, dop=False)
        west = Grid(CRS, whole.west, whole.north, 0.5, 100, 200)
        known = np.ones(west.shape, bool)
        known[:50] = False
        sheet.write_photo(Orthophoto(west, np.full((3, 200, 100), 9, np.uint8), known))
        sheet.publish()
    with rasterio.open(tmp_path / "dop.tif") as raster:
        mask = raster.dataset_mask() > 0
    assert np.array_equal(mask[:, :100], known)
    assert not mask[:, 100:].any()


def test_small_area_is_one_tile_of_its_own(tmp_path):
    with Sheet(tmp_path, grid(150, 100), None, FACTS) as sheet:
        fill(sheet, dop=False)
        published = sheet.publish(date=None, dataset="made")
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.grid == grid(150, 100)
    assert (tile.id, tile.dataset) == ("400000_5699900", "made")


def test_large_area_is_cut_and_thin_tiles_are_left_out(tmp_path):
    with Sheet(tmp_path, grid(), None, FACTS) as sheet:
        for part in blocks(sheet.grid):
            known = part.eastings[None, :] > 400_200
            sheet.write("dsm", part, np.where(known, heights(part), np.nan))
            sheet.write("dtm", part, heights(part))
        published = sheet.publish(250)
    tiles = Catalog.read(published.catalog).tiles
    # 20% of the first column's cells have heights, and 40% of the last row's ground is in the area.
    assert {tile.id.partition("_")[0] for tile in tiles} == {"400250", "400500"}
    assert published.tiles == len(tiles) == 6
    assert any("400000_5699250" in note and "25%" in note for note in published.notes)


def test_an_area_that_fails_leaves_nothing(tmp_path):
    out = tmp_path / "new"
    with pytest.raises(ZeroDivisionError):
        make(out, lambda sheet: fill(sheet, dop=1 / 0))
    assert not out.exists()


def test_an_area_that_fails_keeps_the_old_one(tmp_path):
    with Sheet(tmp_path, grid(100, 100), None, FACTS) as sheet:
        fill(sheet, dop=False)
        sheet.publish()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match="no tile"):
        make(tmp_path, lambda sheet: sheet.write("dsm", sheet.grid, np.full(sheet.grid.shape, np.nan)))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_made_anew_it_replaces_the_old_one(tmp_path):
    for dop in (True, False):
        with Sheet(tmp_path, grid(100, 100), 0.5 if dop else None, FACTS) as sheet:
            fill(sheet, dop)
            sheet.publish()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "catalog.parquet",
        "dsm.tif",
        "dtm.tif",
        "road_mask.tif",
    ]


def test_what_a_killed_maker_left_is_swept(tmp_path):
    left = tmp_path / ".prepare-999999999"
    left.mkdir()
    (left / "dsm.tmp.tif").write_bytes(b"x")
    with Sheet(tmp_path, grid(50, 50), None, FACTS):
        assert not left.exists()
