"""Cells without a value: an alpha band of any type counts, as do nodata values and masks."""

import struct

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp

from flexroad.catalog import Grid
from flexroad.catalog.scan.cell_values import height_share, mask_notes
from flexroad.catalog.scan.rasters import alpha_band, read_valid
from flexroad.tasks.io.raster import read_window
from tests.make_rasters import UTM, write

ROWS, COLS, WEST, NORTH = 40, 60, 295500.0, 5629500.0
GRID = Grid(UTM, WEST, NORTH, 1.0, COLS, ROWS)
PLANE = np.add.outer(np.arange(ROWS), np.arange(COLS)) + 100.0
VOID = np.zeros((ROWS, COLS), bool)
VOID[:, :9] = VOID[11:23, 30:37] = True


def with_alpha(path, values, void, *, dtype="float32", opaque=255, **more):
    """Write heights, 0 in voids, and an alpha band of their type, as gdalwarp -dstalpha does."""
    values = np.where(void, 0, values).astype(dtype)
    write(path, values, WEST, NORTH, count=2, **more)
    with rasterio.open(path, "r+") as raster:
        raster.colorinterp = (ColorInterp.gray, ColorInterp.alpha)
        raster.write(np.where(void, 0, opaque).astype(dtype), 2)
    return path


def window(path, grid=GRID):
    return read_window(path, path.name, grid, grid, UTM, heights=True)


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "int32", "uint32", "float32", "float64"])
@pytest.mark.parametrize("opaque", [255, 1])
def test_alpha_of_any_type_is_a_void(dtype, opaque, tmp_path):
    path = with_alpha(tmp_path / "a.tif", PLANE, VOID, dtype=dtype, opaque=opaque)
    expected = np.where(VOID, np.nan, PLANE)
    np.testing.assert_array_equal(window(path).values, expected)
    assert height_share(GRID, [path]) == 1 - VOID.mean()
    with rasterio.open(path) as raster:
        np.testing.assert_array_equal(np.ma.getmaskarray(read_valid(raster)), VOID)
        # GDAL's own mask has the cells of uint8 and uint16.
        assert (alpha_band(raster) is None) == (dtype in ("uint8", "uint16"))


@pytest.mark.parametrize("dtype", ["uint16", "int16", "float32"])
def test_alpha_beside_a_nodata_value_counts_too_also_as_nan(dtype, tmp_path):
    values = PLANE.copy()
    values[5, 50] = 7
    path = with_alpha(tmp_path / "a.tif", values, VOID, dtype=dtype, nodata=7)
    void = VOID.copy()
    void[5, 50] = True
    np.testing.assert_array_equal(np.isnan(window(path).values), void)
    assert height_share(GRID, [path]) == 1 - void.mean()
    if dtype == "float32":
        with rasterio.open(path, "r+") as raster:
            raster.write(np.where(VOID, np.nan, 1).astype(dtype), 2)
        np.testing.assert_array_equal(np.isnan(window(path).values), void)


@pytest.mark.parametrize("strip", [1, 64])
@pytest.mark.parametrize("nodata", [None, -9999])
def test_cells_read_several_as_one_do_not_mix_with_voids(strip, nodata, tmp_path, monkeypatch):
    """The mean is over the cells with a value. With fewer than half of the cells there is no mean."""
    monkeypatch.setattr("flexroad.tasks.io.raster.STRIP", strip)
    path = with_alpha(tmp_path / "a.tif", PLANE, VOID, nodata=nodata)
    grid = Grid(UTM, WEST, NORTH, 4.0, COLS // 4, ROWS // 4)
    got = window(path, grid)
    assert got.step == 2
    blocks = np.where(VOID, np.nan, PLANE).reshape(ROWS // 2, 2, COLS // 2, 2)
    known = (~np.isnan(blocks)).sum((1, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.where(known >= 2, np.nansum(blocks, (1, 3)) / known, np.nan)
    np.testing.assert_allclose(got.values, means)


def test_last_step_with_fewer_cells_is_averaged(tmp_path):
    path = with_alpha(tmp_path / "a.tif", PLANE[:37, :59], VOID[:37, :59])
    got = window(path, Grid(UTM, WEST, NORTH, 4.0, 15, 10)).values
    assert got.shape == (19, 30)
    assert np.isnan(got[18, :4]).all()
    # One of the two cells is a void.
    assert got[18, 4] == PLANE[36, 9]
    np.testing.assert_allclose(got[18, 5:29], PLANE[36, 10:58].reshape(24, 2).mean(1))
    assert got[18, 29] == PLANE[36, 58]


def test_alpha_of_a_mask_has_no_values(tmp_path):
    road = np.where(VOID, 0, 1)
    path = with_alpha(tmp_path / "m.tif", road, VOID, dtype="int16")
    (note,) = mask_notes(tmp_path, "road_mask", [path.name], (2,))
    assert "no cell has --road-value 2 but 1," in note


def test_tag_that_gdal_cannot_read_does_not_hide_the_heights(tmp_path):
    path = write(tmp_path / "a.tif", PLANE.astype(np.float32), WEST, NORTH)
    content = path.read_bytes()
    planar_configuration = struct.pack("<HHII", 284, 3, 1, 1)
    assert planar_configuration in content
    path.write_bytes(content.replace(planar_configuration, struct.pack("<HHII", 65535, 32767, 1, 1)))
    assert np.array_equal(window(path).values, PLANE)
