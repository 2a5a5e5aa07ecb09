"""The rasters of an area are valid COGs that `run` can read; a failure leaves no partial files."""

import os
import signal
from datetime import datetime

import numpy as np
import pytest
import rasterio
from rio_cogeo.cogeo import cog_validate

from flexroad.catalog import Catalog, Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.types import Orthophoto
from flexroad.tools.prepare.raster_writer import RasterWriter

CRS = "EPSG:25832"
TAGS = {"SOURCE": "made", "DTM": "a slope"}


def grid(width=700, height=600):
    return Grid(CRS, 400_000, 5_700_000, 1.0, width, height)


def heights(part):
    return part.eastings[None, :] / 1e4 + part.northings[:, None] / 1e5


def blocks(whole, size=300):
    for row in range(0, whole.height, size):
        for col in range(0, whole.width, size):
            height, width = min(size, whole.height - row), min(size, whole.width - col)
            yield Grid(CRS, whole.west + col, whole.north - row, 1.0, width, height)


def write_layers(writer, dop=True):
    for part in blocks(writer.grid):
        writer.write("dsm", part, heights(part))
        writer.write("dtm", part, np.where(part.eastings < 400_010, np.nan, heights(part)))
        writer.write("road_mask", part, heights(part) > 97)
        if dop:
            pixels = Grid(CRS, part.west, part.north, 0.5, 2 * part.width, 2 * part.height)
            colour = np.full((3, *pixels.shape), 200, np.uint8)
            writer.write_photo(Orthophoto(pixels, colour, np.ones(pixels.shape, bool)))


def publish(out, write):
    with RasterWriter(out, grid(), None, TAGS) as writer:
        write(writer)
        writer.publish()


def test_publish_writes_valid_cogs_without_seams_with_tags_and_statistics(tmp_path):
    with RasterWriter(tmp_path, grid(), 0.5, TAGS) as writer:
        write_layers(writer)
        writer.publish()
    layers = {}
    for name in ("dsm", "dtm", "road_mask", "dop"):
        path = tmp_path / f"{name}.tif"
        assert cog_validate(path, strict=True, quiet=True) == (True, [], [])
        with rasterio.open(path) as raster:
            assert raster.crs == rasterio.CRS.from_string(CRS)
            assert raster.tags()["AREA_OR_POINT"] == "Area"
            assert raster.tags().items() >= TAGS.items()
            assert raster.overviews(1)
            band = raster.read(1, masked=True)
            mean = float(raster.tags(1)["STATISTICS_MEAN"])
            assert mean == pytest.approx(float(band.mean(dtype=float)), rel=1e-5)
            layers[name] = raster.read(1)
            assert np.isnan(raster.nodata or 0) == (name in ("dsm", "dtm"))
    np.testing.assert_allclose(layers["dsm"], heights(grid()), rtol=1e-6)
    assert np.array_equal(np.isnan(layers["dtm"][0]), grid().eastings < 400_010)


def test_write_photo_masks_pixels_without_colour(tmp_path):
    whole = grid(100, 100)
    with RasterWriter(tmp_path, whole, 0.5, TAGS) as writer:
        write_layers(writer, dop=False)
        west = Grid(CRS, whole.west, whole.north, 0.5, 100, 200)
        valid = np.ones(west.shape, bool)
        valid[:50] = False
        writer.write_photo(Orthophoto(west, np.full((3, 200, 100), 9, np.uint8), valid))
        writer.publish()
    with rasterio.open(tmp_path / "dop.tif") as raster:
        mask = raster.dataset_mask() > 0
    assert np.array_equal(mask[:, :100], valid)
    assert not mask[:, 100:].any()


def test_publish_small_area_makes_one_tile(tmp_path):
    with RasterWriter(tmp_path, grid(150, 100), None, TAGS) as writer:
        write_layers(writer, dop=False)
        published = writer.publish(dataset="made", assumed=datetime(2019, 4, 3))
    (tile,) = Catalog.read(published.catalog).tiles
    assert (tile.datetime.isoformat(), tile.datetime_assumed) == ("2019-04-03T00:00:00+00:00", True)
    assert tile.grid == grid(150, 100)
    assert (tile.id, tile.dataset) == ("400000_5699900", "made")


def test_publish_large_area_is_divided_and_sparse_tiles_are_left_out(tmp_path):
    with RasterWriter(tmp_path, grid(), None, TAGS) as writer:
        for part in blocks(writer.grid):
            valid = part.eastings[None, :] > 400_200
            writer.write("dsm", part, np.where(valid, heights(part), np.nan))
            writer.write("dtm", part, heights(part))
        published = writer.publish(250)
    tiles = Catalog.read(published.catalog).tiles
    # 20% of the cells in the first column of tiles have heights; 40% of the last row is in the area.
    assert {tile.id.partition("_")[0] for tile in tiles} == {"400250", "400500"}
    assert published.tiles == len(tiles) == 6
    assert any("400000_5699250" in note and "25%" in note for note in published.notes)


def test_failure_leaves_no_folder_and_keeps_existing_outputs(tmp_path):
    with pytest.raises(ZeroDivisionError):
        publish(tmp_path / "new", lambda writer: write_layers(writer, dop=1 / 0))
    assert not (tmp_path / "new").exists()
    with RasterWriter(tmp_path, grid(100, 100), None, TAGS) as writer:
        write_layers(writer, dop=False)
        writer.publish()
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match="no tile"):
        publish(tmp_path, lambda writer: writer.write("dsm", writer.grid, np.full(writer.grid.shape, np.nan)))
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_publish_again_replaces_existing_outputs(tmp_path):
    for dop in (True, False):
        with RasterWriter(tmp_path, grid(100, 100), 0.5 if dop else None, TAGS) as writer:
            write_layers(writer, dop)
            writer.publish()
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"catalog.parquet", "dsm.tif", "dtm.tif", "road_mask.tif"}


def test_writer_removes_folder_of_killed_process(tmp_path):
    if child := os.fork():
        _, status = os.waitpid(child, 0)
        assert os.WIFSIGNALED(status)
    else:
        try:
            with RasterWriter(tmp_path, grid(50, 50), None, TAGS) as writer:
                write_layers(writer, dop=False)
                os.kill(os.getpid(), signal.SIGKILL)
        finally:
            os._exit(0)
    (killed,) = tmp_path.iterdir()
    assert (killed / "dsm.tmp.tif").exists()
    with RasterWriter(tmp_path, grid(50, 50), None, TAGS) as writer:
        assert list(tmp_path.iterdir()) == [writer.scratch]
