from functools import partial

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp
from rasterio.warp import transform_bounds

from flexroad.catalog import Grid
from flexroad.tasks import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.types import Source
from tests.builders import make_grid
from tests.make_rasters import UTM
from tests.make_rasters import write as write_raster

GRID = make_grid(20, 12)
"""The area to read; photos of 40 x 24 pixels at 0.5 m cover it."""


def bands(count=3, kind=np.uint8, top=255, seed=0):
    return np.random.default_rng(seed).integers(1, top, (count, 24, 40)).astype(kind)


write = partial(write_raster, cell=0.5)


def source(*paths):
    return Source("dop", paths)


def fails(match, *paths):
    with pytest.raises(TaskError, match=match) as caught:
        read_photo(source(*paths), GRID)
    assert "\n" not in str(caught.value)
    return caught.value


def test_read_photo_coinciding_pixels_are_copied(tmp_path):
    values = bands()
    photo = read_photo(source(write(tmp_path / "a.tif", values)), GRID)
    assert photo.grid == Grid(UTM, GRID.west, GRID.north, 0.5, 40, 24)
    np.testing.assert_array_equal(photo.colour, values)
    assert photo.known.all()


@pytest.mark.parametrize(
    ("wanted", "cell"),
    [({"gsd_m": 1.0}, 1.0), ({"gsd_m": 2.0}, 2.0)]
    + [({"finest_m": finest}, cell) for finest, cell in ((0.2, 0.5), (0.5, 0.5), (1.0, 1.0))],
)
def test_read_photo_coarser_pixels_are_means(tmp_path, wanted, cell):
    values, n = bands(), round(cell / 0.5)
    photo = read_photo(source(write(tmp_path / "a.tif", values)), GRID, **wanted)
    assert photo.grid.cell == cell
    means = values.reshape(3, 24 // n, n, 40 // n, n).mean((2, 4))
    assert np.abs(photo.colour - means).max() <= 0.5


def test_read_photo_finer_pixels_are_interpolated(tmp_path):
    ramp = np.broadcast_to(np.arange(40, dtype=np.uint8) * 4, (3, 24, 40))
    photo = read_photo(source(write(tmp_path / "a.tif", ramp)), GRID, 0.25)
    want = np.clip((photo.grid.eastings - GRID.west) / 0.5 - 0.5, 0, 39) * 4
    assert np.abs(photo.colour - want).max() <= 0.5


def test_read_photo_window_equals_part_of_larger_one(tmp_path):
    path = source(write(tmp_path / "a.tif", bands()))
    inner = Grid(UTM, GRID.west + 4, GRID.north - 2, 1.0, 9, 7)
    small, large = read_photo(path, inner, 1.0), read_photo(path, GRID, 1.0)
    np.testing.assert_array_equal(small.colour, large.colour[(slice(None), *large.grid.window(small.grid))])


def test_read_photo_nodata_mask_and_alpha_are_unknown(tmp_path):
    values = bands()
    values[0, :2] = 0  # a pixel without red is still a colour
    hole = np.zeros((24, 40), bool)
    hole[10:14, 20:26] = True
    values[:, hole] = 0
    shown = np.where(hole, 0, 255).astype(np.uint8)
    nodata = write(tmp_path / "nodata.tif", values, nodata=0)
    mask = write(tmp_path / "mask.tif", values)
    with rasterio.open(mask, "r+") as file:
        file.write_mask(shown)
    alpha = write(tmp_path / "alpha.tif", [*values, shown])
    with rasterio.open(alpha, "r+") as file:
        file.colorinterp = [*file.colorinterp[:3], ColorInterp.alpha]
    for path in (nodata, mask, alpha):
        photo = read_photo(source(path), GRID)
        np.testing.assert_array_equal(photo.known, ~hole, err_msg=path.name)
        np.testing.assert_array_equal(photo.colour, values, err_msg=path.name)
        np.testing.assert_array_equal(
            read_photo(source(path), GRID, 1.0).known, ~hole[::2, ::2], err_msg=path.name
        )


def test_read_photo_overlapping_files_use_first_value(tmp_path):
    first, second = bands(seed=1), bands(seed=2)
    first[:, 4:9, 4:9] = 0
    a = write(tmp_path / "a.tif", first[:, :, :30], nodata=0)
    b = write(tmp_path / "b.tif", second)
    photo = read_photo(source(a, b), GRID)
    want = second.copy()
    want[:, :, :30] = np.where(first[:, :, :30] > 0, first[:, :, :30], second[:, :, :30])
    np.testing.assert_array_equal(photo.colour, want)
    assert photo.known.all()


@pytest.mark.parametrize(
    ("values", "more", "want"),
    [
        (bands(1), {}, lambda v: np.repeat(v, 3, 0)),
        (bands(4), {}, lambda v: v[:3]),
        (bands(3, np.uint16, 65535), {}, lambda v: np.rint(v / 257)),
        (bands(3, np.uint16, 4095), {"nbits": 12}, lambda v: np.rint(v * (255 / 4095))),
        (
            bands(3)[:, ::-1],
            {"transform": Affine(0.5, 0, GRID.west, 0, 0.5, GRID.south)},
            lambda v: v[:, ::-1],
        ),
    ],
    ids=["grey", "infrared", "16 bits", "12 bits", "northward"],
)
def test_read_photo_other_bands_and_depths(tmp_path, values, more, want):
    photo = read_photo(source(write(tmp_path / "a.tif", values, **more)), GRID)
    np.testing.assert_array_equal(photo.colour, want(values))


def test_read_photo_area_outside_file_is_unknown(tmp_path):
    photo = read_photo(source(write(tmp_path / "a.tif", bands(), west=GRID.west + 10)), GRID)
    np.testing.assert_array_equal(photo.known, np.broadcast_to(np.arange(40) >= 20, (24, 40)))


def test_read_photo_unusable_file_fails(tmp_path):
    whole = write(tmp_path / "whole.tif", bands())
    torn = tmp_path / "torn.tif"
    torn.write_bytes(whole.read_bytes()[:900])
    error = fails("dop torn.tif cannot be read: .*; fetch it again", torn)
    assert (error.file, error.layer) == (str(torn), "dop")
    assert fails("dop gone.tif is missing", tmp_path / "gone.tif").layer == "dop"
    elsewhere = write(tmp_path / "elsewhere.tif", bands(), west=GRID.west + 500)
    fails("no dop file overlaps the tile .*elsewhere.tif", elsewhere)
    west, _, _, north = transform_bounds(UTM, "EPSG:4326", *GRID.bounds)
    degrees = {"crs": "EPSG:4326", "transform": Affine(1e-5, 0, west, 0, -1e-5, north)}
    a = write(tmp_path / "a.tif", bands(), **degrees)
    fails("dop a.tif is in EPSG:4326, the tile in EPSG:25832", a)
    fails("float32, not 8 or 16 bits", write(tmp_path / "f.tif", bands().astype(np.float32)))


def test_read_photo_unusable_file_fails_only_where_needed(tmp_path):
    half = write(tmp_path / "half.tif", bands()[:, :, :20])
    gone = tmp_path / "gone.tif"
    west = Grid(UTM, GRID.west, GRID.north, 1.0, 10, 12)
    assert read_photo(source(gone, half), west).known.all()
    fails("gone.tif is missing", gone, half)
    bare = write(tmp_path / "bare.tif", bands(), crs=None)
    whole = write(tmp_path / "whole.tif", bands(seed=1))
    np.testing.assert_array_equal(read_photo(source(bare, whole), GRID).colour, bands(seed=1))
