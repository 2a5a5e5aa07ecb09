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

UTM = "EPSG:25832"
GRID = Grid(UTM, 295500.0, 5629500.0, 1.0, 20, 12)
"""The area to read; photos of 40 x 24 pixels at 0.5 m cover it."""


def bands(count=3, kind=np.uint8, top=255, seed=0):
    return np.random.default_rng(seed).integers(1, top, (count, 24, 40)).astype(kind)


def write(
    path, values, *, cell=0.5, west=GRID.west, north=GRID.north, crs=UTM, mask=None, alpha=None, **more
):
    profile = {"driver": "GTiff", "dtype": values.dtype, "count": len(values), "crs": crs} | more
    profile |= {"height": values.shape[1], "width": values.shape[2]}
    profile.setdefault("transform", Affine(cell, 0, west, 0, -cell, north))
    with rasterio.open(path, "w", **profile) as file:
        file.write(values)
        if alpha:
            file.colorinterp = [*file.colorinterp[: alpha - 1], ColorInterp.alpha]
        if mask is not None:
            file.write_mask(mask)
    return path


def source(*paths):
    return Source("dop", paths)


def fails(match, *paths, grid=GRID):
    with pytest.raises(TaskError, match=match) as caught:
        read_photo(source(*paths), grid)
    assert "\n" not in str(caught.value)
    return caught.value


def means(values, n=2):
    """Return the mean of each block of n x n pixels."""
    count, height, width = values.shape
    return values.reshape(count, height // n, n, width // n, n).mean((2, 4))


def test_read_photo_coinciding_pixels_are_copied(tmp_path):
    values = bands()
    photo = read_photo(source(write(tmp_path / "a.tif", values)), GRID)
    assert photo.grid == Grid(UTM, GRID.west, GRID.north, 0.5, 40, 24)
    np.testing.assert_array_equal(photo.colour, values)
    assert photo.known.all()


@pytest.mark.parametrize("cell", [1.0, 2.0])
def test_read_photo_coarser_pixels_are_means(tmp_path, cell):
    values = bands()
    photo = read_photo(source(write(tmp_path / "a.tif", values)), GRID, cell)
    assert photo.grid.cell == cell
    assert np.abs(photo.colour - means(values, round(cell / 0.5))).max() <= 0.5


@pytest.mark.parametrize(("finest_m", "cell"), [(0.2, 0.5), (0.5, 0.5), (1.0, 1.0)])
def test_read_photo_finest_averages_only_finer_photos(tmp_path, finest_m, cell):
    values = bands()
    photo = read_photo(source(write(tmp_path / "a.tif", values)), GRID, finest_m=finest_m)
    assert photo.grid.cell == cell
    assert np.abs(photo.colour - means(values, round(cell / 0.5))).max() <= 0.5


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
    for path in (
        write(tmp_path / "nodata.tif", values, nodata=0),
        write(tmp_path / "mask.tif", values, mask=shown),
        write(tmp_path / "alpha.tif", np.concatenate([values, shown[None]]), alpha=4),
    ):
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
    fails("dop a.tif is in EPSG:4326, the tile in EPSG:25832", degrees(tmp_path / "a.tif"))
    fails("float32, not 8 or 16 bits", write(tmp_path / "f.tif", bands().astype(np.float32)))


def degrees(path):
    west, _, _, north = transform_bounds(UTM, "EPSG:4326", *GRID.bounds)
    return write(path, bands(), crs="EPSG:4326", transform=Affine(1e-5, 0, west, 0, -1e-5, north))


def test_read_photo_broken_file_fails_only_where_needed(tmp_path):
    half = write(tmp_path / "half.tif", bands()[:, :, :20])
    gone = tmp_path / "gone.tif"
    west = Grid(UTM, GRID.west, GRID.north, 1.0, 10, 12)
    assert read_photo(source(gone, half), west).known.all()
    fails("gone.tif is missing", gone, half)


def test_read_photo_unusable_file_fails_only_where_needed(tmp_path):
    whole = write(tmp_path / "whole.tif", bands())
    bare = write(tmp_path / "bare.tif", bands(), crs=None)
    photo = read_photo(source(bare, whole), GRID)
    np.testing.assert_array_equal(photo.colour, bands())
