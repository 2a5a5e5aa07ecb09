"""Rasters in another CRS or in feet, warped when read, against the surface they were sampled from."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import Transformer
from rasterio.warp import Resampling, reproject

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.crs import short
from flexroad.catalog.sources.rasters import index
from flexroad.catalog.tiling import Conversion
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from tests.make_rasters import write

FOOT = 1200 / 3937
OWN = "+proj=laea +lat_0=52 +lon_0=1 +ellps=GRS80 +units=us-ft"
PLACES = {
    # A place east of zone 32, which is in zone 33; New York in feet of the survey, and that zone in metres.
    "zones": ("EPSG:25832", "EPSG:25833", 900_000.0, 5_700_000.0, 1.0),
    "feet": ("EPSG:2263", "EPSG:32118", 985_000.0, 200_000.0, 3.0),
    "degrees": ("EPSG:4258", "EPSG:25833", 13.4, 52.5, 1e-5),
    # A projection in feet without a code, turned by several degrees.
    "own": (OWN, "EPSG:25833", 2_700_000.0, 300_000.0, 3.0),
}
OFF = load.Options(min_valid=0)


def height(x, y):
    """Return the made surface (m) at eastings and northings of the tiles' CRS (m)."""
    return 100 + 0.0005 * x + 3 * np.sin(x / 40) + 2 * np.cos(y / 30)


def sample(place):
    """Return heights at the centres of the 250 x 250 cells of a file."""
    source, target, x, y, cell = PLACES[place]
    xs = x + (np.arange(250) + 0.5) * cell
    ys = y - (np.arange(250) + 0.5) * cell
    return height(*Transformer.from_crs(source, target, always_xy=True).transform(*np.meshgrid(xs, ys)))


def made(folder, place, *, values=None, **profile):
    """Write the surface as DSM and DTM; return the tiles."""
    source, _, x, y, cell = PLACES[place]
    profile = {"cell": cell, "crs": source} | profile
    for name in ("dsm", "dtm"):
        write(folder / f"{name}.tif", sample(place) if values is None else values, x, y, **profile)
    return indexed(folder, place)


def indexed(folder, place, unit="metre", **layers):
    patterns = {"dsm": "dsm.tif", "dtm": "dtm.tif"}
    conversion = Conversion(True, PLACES[place][1], unit)
    return index(folder, patterns | layers.pop("more", {}), tile_size_m=60, conversion=conversion, **layers)


def truth(grid):
    return height(*np.meshgrid(grid.eastings, grid.northings))


@pytest.mark.parametrize("place", PLACES)
def test_surface_in_another_crs_is_read_within_the_error_of_interpolation(tmp_path, place):
    result = made(tmp_path, place)
    # A bilinear value is off by at most an eighth of h^2 (|f_xx| + |f_yy|), with cells of 0.7 to 1.2 m.
    bound = 1.2**2 / 8 * (3 / 40**2 + 2 / 30**2)
    full = 0
    for tile in result.tiles:
        data = load.load(tile, OFF)
        inside = np.isfinite(data.dsm)
        full += inside.all()
        error = np.abs(data.dsm - truth(data.grid))[inside]
        # The outermost half cell of a file has nothing to interpolate with.
        assert np.quantile(error, 0.9) < bound
        if inside.all():
            assert error.max() < bound
        source = short(PLACES[place][0])
        assert f"dsm reprojected: from {source} to {PLACES[place][1]}" in data.notes
    assert full


def test_surface_in_another_crs_is_that_of_rasterio(tmp_path):
    """rasterio.warp interpolates positions, with an error of an eighth of a cell at most."""
    tile = full_tile(made(tmp_path, "zones"))
    with rasterio.open(tmp_path / "dsm.tif") as src:
        peer = np.full(tile.grid.shape, np.nan)
        reproject(
            rasterio.band(src, 1),
            peer,
            dst_transform=tile.grid.transform,
            dst_crs=tile.grid.crs,
            dst_nodata=np.nan,
            resampling=Resampling.bilinear,
            XSCALE=1,
            YSCALE=1,
        )
    np.testing.assert_allclose(load.load(tile, OFF).dsm, peer, atol=1e-3)


def full_tile(result):
    """Return the first tile that the files cover completely."""
    return next(tile for tile in result.tiles if np.isfinite(load.load(tile, OFF).dsm).all())


def test_overlapping_windows_of_a_warped_file_have_equal_values(tmp_path):
    tile = full_tile(made(tmp_path, "zones"))
    inner = load.load(tile, OFF).dsm
    outer = load.load(tile, load.Options(min_valid=0, halo_m=20))
    np.testing.assert_array_equal(outer.dsm[20:-20, 20:-20], inner)


@pytest.mark.parametrize("nodata", [-9999.0, None])
def test_nodata_of_a_warped_file_has_no_halo(tmp_path, nodata):
    """A void of undeclared or declared nodata keeps its size, and nothing is mixed with it."""
    values = sample("zones")
    values[100:140, 90:130] = -9999
    result = made(tmp_path, "zones", values=values, nodata=nodata)
    to_source = Transformer.from_crs("EPSG:25833", "EPSG:25832", always_xy=True)
    voids = 0
    for tile in result.tiles:
        heights = load.load(tile, OFF).dsm
        known = np.isfinite(heights)
        assert np.abs(heights - truth(tile.grid))[known].max() < 0.2
        x, y = to_source.transform(*np.meshgrid(tile.grid.eastings, tile.grid.northings))
        col, row = np.floor(x - 900_000), np.floor(5_700_000 - y)
        void = (row >= 100) & (row < 140) & (col >= 90) & (col < 130)
        outside = (row < 0) | (row >= 250) | (col < 0) | (col >= 250)
        np.testing.assert_array_equal(known, ~(void | outside))
        voids += void.sum()
    assert voids == pytest.approx(1600, abs=20)


def test_extents_of_a_layer_in_feet_are_exact_in_metres(tmp_path):
    _, _, x, y, cell = PLACES["feet"]
    result = made(tmp_path, "feet")
    # The projection is the same one, whose false easting is 300,000 m in both.
    west, south, east, north = result.tiles[0].layer("dsm").extents[0]
    expected = [x * FOOT, (y - 250 * cell) * FOOT, (x + 250 * cell) * FOOT, y * FOOT]
    np.testing.assert_allclose([west, south, east, north], expected, rtol=0, atol=1e-6)
    assert result.tiles[0].grid.cell == 1
    assert "the tiles have cells of 1 m" in result.notes


@pytest.mark.parametrize(
    ("unit", "conversion", "factor"),
    [("", None, FOOT), ("", "foot", 0.3048), ("", "metre", 1), ("foot", None, 0.3048), ("metre", "foot", 1)],
)
def test_heights_in_feet_of_a_warped_file_become_metres(tmp_path, unit, conversion, factor):
    """The band's unit is first, then --height-unit, then the unit of x and y, with a note."""
    source, _, x, y, cell = PLACES["feet"]
    for name in ("dsm", "dtm"):
        write(tmp_path / f"{name}.tif", np.full((120, 120), 300.0), x, y, cell=cell, crs=source, unit=unit)
    result = indexed(tmp_path, "feet", conversion)
    data = load.load(result.tiles[0], OFF)
    np.testing.assert_allclose(data.dsm[np.isfinite(data.dsm)], 300 * factor, rtol=1e-9)
    is_assumed = not unit and conversion is None
    assert any("assumed to be in US survey foot" in note for note in result.notes) == is_assumed
    assert any("as the file declares no unit" in note for note in data.notes) == (not unit)


def test_classes_of_a_warped_file_are_not_mixed(tmp_path):
    made(tmp_path, "zones")
    classes = np.where(np.arange(250) // 5 % 2, 3, 8)[None].repeat(250, 0).astype(np.uint8)
    write(tmp_path / "mask.tif", classes, 900_000, 5_700_000)
    tile = full_tile(indexed(tmp_path, "zones", road_values=(3, 5), more={"road_mask": "mask.tif"}))
    to_source = Transformer.from_crs("EPSG:25833", "EPSG:25832", always_xy=True)
    x, _ = to_source.transform(*np.meshgrid(tile.grid.eastings, tile.grid.northings))
    expected = np.floor(x - 900_000) // 5 % 2 == 1
    np.testing.assert_array_equal(load.load(tile, OFF).road_mask, expected)


def test_photo_in_another_crs_is_warped_where_the_layer_says_so(tmp_path):
    source, _, x, y, cell = PLACES["feet"]
    heights = made(tmp_path, "feet")
    red = np.clip(np.arange(500) // 2, 0, 255).astype(np.uint8)[None].repeat(500, 0)
    write(tmp_path / "dop.tif", red, x, y, cell=cell / 2, crs=source)
    tile = full_tile(heights)
    layers = (*tile.layers, Layer("dop", ("dop.tif",), reproject=True))
    photo = read_photo(load.load(replace(tile, layers=layers), OFF).dop, tile.grid)
    assert photo.grid.cell == pytest.approx(1.5 * FOOT, abs=1e-3)
    assert photo.known.all()
    expected = (photo.grid.eastings / FOOT - x) / cell - 0.5
    # One value of red is one cell of the heights.
    np.testing.assert_allclose(photo.colour[0], expected[None].repeat(photo.grid.height, 0), atol=1)
    layers = (*tile.layers, Layer("dop", ("dop.tif",)))
    with pytest.raises(TaskError, match="make the catalog with --reproject"):
        read_photo(load.load(replace(tile, layers=layers), OFF).dop, tile.grid)


def small_tile(folder, *files):
    x, y = Transformer.from_crs("EPSG:25832", "EPSG:25833", always_xy=True).transform(900_030, 5_699_970)
    grid = Grid("EPSG:25833", round(x) - 10.0, round(y) + 10.0, 1.0, 20, 20)
    layers = tuple(Layer(name, files, reproject=True) for name in ("dsm", "dtm"))
    return Tile("t", grid, layers, str(folder), datetime(2020, 5, 1, tzinfo=UTC))


def test_warped_file_finer_than_the_tile_is_averaged(tmp_path):
    """Cells of 0.1 m with an alternating pattern of 2 m: the mean is read, not every tenth cell."""
    noise = np.where(np.indices((600, 600)).sum(0) % 2, 101.0, 99.0)
    write(tmp_path / "a.tif", noise, 900_000, 5_700_000, cell=0.1)
    tile = small_tile(tmp_path, "a.tif")
    np.testing.assert_allclose(load.load(tile, OFF).dsm, 100, atol=0.02)


def test_file_in_the_crs_of_the_tile_is_used_before_one_in_another(tmp_path):
    tile = small_tile(tmp_path, "a.tif", "b.tif")
    write(tmp_path / "a.tif", np.full((60, 60), 50.0), 900_000, 5_700_000)
    write(tmp_path / "b.tif", np.full((20, 5), 70.0), tile.grid.west, tile.grid.north, crs="EPSG:25833")
    heights = load.load(tile, OFF).dsm
    assert (heights[:, :5] == 70).all()
    np.testing.assert_allclose(heights[:, 5:], 50)


def test_lattice_of_a_northward_file_is_read_from_the_north(tmp_path):
    """XYZ-like files whose rows run northward, in another CRS."""
    flipped = Affine(1, 0, 900_000, 0, 1, 5_700_000 - 250)
    tile = full_tile(made(tmp_path, "zones", values=sample("zones")[::-1], transform=flipped))
    np.testing.assert_allclose(load.load(tile, OFF).dsm, truth(tile.grid), atol=0.01)
