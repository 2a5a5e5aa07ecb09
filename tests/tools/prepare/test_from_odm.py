"""An OpenDroneMap project: its rasters are resampled to the cells, missing ones are made."""

import numpy as np
import pytest
import rasterio
from affine import Affine

from flexroad.catalog import Catalog, CatalogError
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import TaskError, memory
from flexroad.tools.prepare import from_odm as odm
from flexroad.tools.prepare.from_mesh import POINTS
from flexroad.tools.prepare.from_odm import prepare_odm
from flexroad.tools.prepare.options import PrepareOptions
from tests.command_line import call
from tests.make_clouds import write_cloud
from tests.tools.prepare.test_from_mesh import write as write_mesh

CRS = "EPSG:32615"
WEST, NORTH, SIDE = 576_000.0, 5_188_040.0, 40
CELL, PIXEL = 0.25, 0.125
VOID = -9999.0


def ground(x, y):
    return 300 + 0.04 * x + 0.01 * y


def centres(cell):
    across = (np.arange(round(SIDE / cell)) + 0.5) * cell
    return across[None], SIDE - across[:, None]


def write(path, bands, cell, crs=CRS, nodata=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    bands = bands if bands.ndim == 3 else bands[None]
    count, height, width = bands.shape
    form = {"driver": "GTiff", "count": count, "height": height, "width": width, "dtype": bands.dtype}
    form |= {"transform": Affine(cell, 0, WEST, 0, -cell, NORTH), "crs": crs, "nodata": nodata}
    form |= {"photometric": "RGB", "alpha": "YES"} if count == 4 else {}
    with rasterio.open(path, "w", **form) as raster:
        raster.write(bands)


def surface():
    """A slope with a box of 4 x 5 m, one spike of a single cell, and a void of 3 m."""
    x, y = centres(CELL)
    heights = ground(x, y).astype(np.float32)
    heights[(abs(x - 20) < 2) & (abs(y - 20) < 2.5)] = 306
    heights[100, 21] += 0.5
    heights[20:32, 100:112] = VOID
    return heights


def dsm(folder, **more):
    write(folder / odm.DSM, surface(), CELL, nodata=VOID, **more)


def dtm(folder):
    write(folder / odm.DTM, ground(*centres(CELL)).astype(np.float32) - 0.125, CELL, nodata=VOID)


def photo(folder):
    """Red increases to the east, green to the north; the south-west corner is transparent and black."""
    x, y = centres(PIXEL)
    bands = np.zeros((4, *np.broadcast_shapes(x.shape, y.shape)), np.uint8)
    bands[0], bands[1], bands[2], bands[3] = 6 * x, 6 * y, 90, 255
    bands[:, (x < 10) & (y < 10)] = 0
    write(folder / odm.PHOTO, bands, PIXEL)


def model(folder):
    """A textured model in the project's local frame."""
    path = folder / odm.MESHES[0]
    path.parent.mkdir(parents=True)
    corners = [(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE)]
    write_mesh(path.parent, [[(x, y, ground(x, y)) for x, y in corners]], path.name)
    coords = folder / "odm_georeferencing" / "coords.txt"
    coords.parent.mkdir()
    coords.write_text(f"WGS84 UTM 15N\n{WEST:.0f} {NORTH - SIDE:.0f}\n12.5 3.25 350.0\n")


def cloud(folder):
    x, y = np.random.default_rng(0).uniform(0, SIDE, (2, 20_000))
    xyz = np.column_stack([WEST + x, NORTH - SIDE + y, ground(x, y)])
    write_cloud(folder / odm.CLOUDS[0], xyz, 1, CRS, np.full((len(x), 3), 30_000), scale=0.001)


def project(tmp_path, *makers):
    folder = tmp_path / "project"
    folder.mkdir()
    for make in makers:
        make(folder)
    return folder


def prepare(folder, out, options=None):
    options = options or PrepareOptions()
    return prepare_odm(folder, out, options, POINTS, lambda _: None)


def read(path):
    with rasterio.open(path) as raster:
        return raster.read().squeeze()


def test_prepare_odm_ground_filter_larger_than_memory_raises(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "limit", lambda: 100_000)
    with pytest.raises(TaskError, match=r"the ground filter over \d+ m of 1 m cells would need .*--cell"):
        prepare(project(tmp_path, dsm), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_prepare_odm_uses_the_rasters_of_the_project(tmp_path):
    published = prepare(project(tmp_path, dsm, dtm, photo), tmp_path / "out")
    (tile,) = Catalog.read(published.catalog).tiles
    assert (tile.grid.west, tile.grid.north, tile.grid.shape) == (WEST, NORTH, (SIDE, SIDE))
    assert tile.grid.crs == CRS
    assert tile.dataset == "project"
    fine = surface().astype(float)
    fine[fine == VOID] = np.nan
    cells = fine.reshape(SIDE, 4, SIDE, 4)
    truth = np.where(
        np.isnan(cells).all(axis=(1, 3)), np.nan, np.nanmax(np.nan_to_num(cells, nan=-1), axis=(1, 3))
    )
    np.testing.assert_allclose(read(tmp_path / "out" / "dsm.tif"), truth, atol=1e-4)
    x, y = centres(1.0)
    np.testing.assert_allclose(read(tmp_path / "out" / "dtm.tif"), ground(x, y) - 0.125, atol=1e-3)
    with rasterio.open(tmp_path / "out" / "dop.tif") as dop:
        colour, valid = dop.read(), dop.dataset_mask() > 0
    x, y = centres(0.5)
    assert np.array_equal(valid, ~((x < 10) & (y < 10)))
    for band, truth in ((0, 6 * x), (1, 6 * y), (2, 90)):
        assert np.abs(colour[band] - np.broadcast_to(truth, valid.shape))[valid].max() <= 1


def test_prepare_odm_in_many_windows_gives_the_same_rasters(tmp_path, monkeypatch):
    folder = project(tmp_path, dsm, photo)
    whole = prepare(folder, tmp_path / "whole").catalog.parent
    monkeypatch.setattr(odm, "BLOCK", 16)
    parts = prepare(folder, tmp_path / "parts").catalog.parent
    for name in ("dsm", "dtm", "dop"):
        np.testing.assert_allclose(read(whole / f"{name}.tif"), read(parts / f"{name}.tif"), atol=1e-4)


def test_prepare_odm_without_dtm_filters_the_ground(tmp_path):
    folder = project(tmp_path, dsm)
    published = prepare(folder, tmp_path / "out")
    assert set(published.notes) >= {f"{folder} has no {odm.DTM}", f"{folder} has no {odm.PHOTO}"}
    x, y = centres(1.0)
    difference = read(tmp_path / "out" / "dtm.tif") - ground(x, y)
    # The highest point of a cell is slightly above its centre; box, spike and void are not in the DTM.
    assert difference.min() > 0
    assert difference.max() < 0.02


def test_prepare_odm_to_other_crs_and_cells_keeps_heights(tmp_path):
    folder = project(tmp_path, dsm, dtm)
    prepare(folder, tmp_path / "out", PrepareOptions(to_crs="EPSG:32614", cell_m=0.5))
    with rasterio.open(tmp_path / "out" / "dtm.tif") as raster:
        assert raster.crs == rasterio.CRS.from_string("EPSG:32614")
        heights = raster.read(1)
    valid = heights[np.isfinite(heights)]
    assert valid.size > 0.9 * (SIDE / 0.5) ** 2
    assert valid.min() == pytest.approx(ground(0, 0) - 0.125, abs=0.05)
    assert valid.max() == pytest.approx(ground(SIDE, SIDE) - 0.125, abs=0.05)
    # Cells finer than the raster's are interpolated, not copied.
    prepare(folder, tmp_path / "fine", PrepareOptions(cell_m=0.0625, dop_cell_m=0.125))
    x, y = centres(0.0625)
    difference = read(tmp_path / "fine" / "dtm.tif") - (ground(x, y) - 0.125)
    assert np.nanmax(np.abs(difference[8:-8, 8:-8])) < 1e-3


@pytest.mark.parametrize("make", [model, cloud])
def test_prepare_odm_without_dsm_uses_mesh_or_points(make, tmp_path):
    call("prepare", project(tmp_path, make), "-o", tmp_path / "out", "--workers", 1).expected(0)
    heights = read(tmp_path / "out" / "dsm.tif")
    x, y = centres(1.0)
    assert heights.shape == (SIDE, SIDE)
    assert np.abs(heights - ground(x, y)).max() < 0.03
    assert (tmp_path / "out" / "dop.tif").exists()


def test_prepare_odm_empty_project_names_the_expected_files(tmp_path):
    with pytest.raises(
        ConfigError, match="has none of odm_dem/dsm.tif.*odm_textured_model_geo.obj.*model.laz"
    ):
        prepare(project(tmp_path), tmp_path / "out")


def cut_short(folder):
    dsm(folder)
    whole = (folder / odm.DSM).read_bytes()
    (folder / odm.DSM).write_bytes(whole[: len(whole) // 2])


def no_raster(folder):
    (folder / odm.DSM).parent.mkdir()
    (folder / odm.DSM).write_bytes(b"nothing")


def no_crs(folder):
    dsm(folder, crs=None)


def deep_photo(folder):
    dsm(folder)
    write(folder / odm.PHOTO, np.zeros((3, 80, 80), np.uint16), 0.5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (cut_short, "dsm.tif cannot be read"),
        (no_raster, "dsm.tif cannot be read"),
        (no_crs, "dsm.tif carries no CRS; give it with --crs"),
        (deep_photo, "odm_orthophoto.tif does not have three 8-bit bands"),
    ],
)
def test_prepare_odm_invalid_input_leaves_no_folder(make, message, tmp_path):
    folder = project(tmp_path, make)
    with pytest.raises(CatalogError, match=message) as caught:
        prepare(folder, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
