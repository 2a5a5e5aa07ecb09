"""Of a raster with a damaged block all other cells are read."""

import subprocess
import sys

import numpy as np
import pytest
from affine import Affine

from flexroad.catalog import Grid
from flexroad.tasks.io.raster import Unreadable, read_window
from tests.make_rasters import UTM, damage, write

ROWS, COLS, WEST, NORTH = 90, 70, 295500.0, 5629500.0
HEIGHTS = np.random.default_rng(0).normal(100, 1, (ROWS, COLS))
FORMS = {"blocks": {"tiled": True, "blockxsize": 16, "blockysize": 32}, "strips": {"blockysize": 7}}


def made(folder, form, northward=False, cell=1.0):
    transform = Affine(cell, 0, WEST, 0, cell, NORTH - ROWS * cell) if northward else None
    heights = HEIGHTS[::-1] if northward else HEIGHTS
    more = {"transform": transform, "cell": cell, "compress": "deflate"}
    return write(folder / "dsm.tif", heights, WEST, NORTH, **FORMS[form], **more)


def read(path, grid):
    return read_window(path, path.name, grid, grid, UTM, heights=True)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("northward", [False, True])
@pytest.mark.parametrize(("row", "col"), [(0, 0), (40, 33), (89, 69)])
def test_cells_outside_a_damaged_block_are_read(form, northward, row, col, tmp_path):
    path = made(tmp_path, form, northward)
    grid = Grid(UTM, WEST, NORTH, 1.0, COLS, ROWS)
    rows, cols = damage(path, row, col)
    lost = np.zeros((ROWS, COLS), bool)
    lost[rows, cols] = True
    lost = lost[::-1] if northward else lost
    window = read(path, grid)
    np.testing.assert_array_equal(window.unreadable, lost)
    np.testing.assert_array_equal(window.values, np.where(lost, np.nan, HEIGHTS))
    np.testing.assert_array_equal(window.reached(grid), ~lost)
    assert "cannot be read" in str(window.fault)
    # A part of the grid, and one in the middle of the file.
    part = Grid(UTM, WEST + 20, NORTH - 30, 1.0, 30, 40)
    np.testing.assert_array_equal(read(path, part).reached(part), ~lost[30:70, 20:50])


def test_cells_read_several_as_one_outside_a_damaged_block_are_as_before(tmp_path):
    path = made(tmp_path, "blocks", cell=0.2)
    grid = Grid(UTM, WEST, NORTH, 1.0, 14, 18)
    before = read(path, grid)
    assert before.step > 1
    damage(path, 40, 33)
    after = read(path, grid)
    # GDAL also reads the blocks beside those that it averages.
    assert 0 < after.unreadable.mean() < 0.5
    np.testing.assert_array_equal(after.values, np.where(after.unreadable, np.nan, before.values))


def test_file_without_any_readable_cell_is_an_error(tmp_path):
    path = made(tmp_path, "strips")
    for row in range(0, ROWS, 7):
        damage(path, row, 0)
    with pytest.raises(Unreadable, match="dsm.tif cannot be read: .*; fetch it again"):
        read(path, Grid(UTM, WEST, NORTH, 1.0, COLS, ROWS))


def test_ascii_grid_with_a_damaged_row_is_an_error(tmp_path):
    """GDAL does not return from reading a row behind the damaged one."""
    path = write(tmp_path / "dsm.asc", HEIGHTS, WEST, NORTH, driver="AAIGrid")
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 300] = b"7" * 300
    path.write_bytes(data)
    code = (
        "import sys; from pathlib import Path; from rasterio.enums import Resampling\n"
        "from flexroad.catalog import Grid; from flexroad.tasks.io.raster import Unreadable, read_window\n"
        f"path, grid = Path(sys.argv[1]), Grid({UTM!r}, {WEST}, {NORTH}, 1.0, {COLS}, {ROWS})\n"
        f"try: read_window(path, path.name, grid, grid, {UTM!r}, heights=True)\n"
        "except Unreadable as error: print(error)"
    )
    ended = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, timeout=60)
    assert "dsm.asc cannot be read: " in ended.stdout, ended.stderr
