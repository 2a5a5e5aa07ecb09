"""A raster with damaged blocks: its other cells are read, and so are the files after it."""

import subprocess
import sys

import numpy as np
import pytest
from affine import Affine
from shapely import LineString

from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.io.raster import Unreadable, read_window
from flexroad.tasks.io.vectors import Query, _layers, _part, read_near
from flexroad.tasks.types import Source
from tests.builders import NORTH, WEST, make_grid
from tests.make_rasters import UTM, damage, write, write_xyz
from tests.make_roads import write as write_roads

ROWS, COLS = 90, 70
GRID = make_grid(COLS, ROWS)
HEIGHTS = np.random.default_rng(0).normal(100, 1, (ROWS, COLS)).round(2)
FORMS = {"blocks": {"tiled": True, "blockxsize": 16, "blockysize": 32}, "strips": {"blockysize": 7}}


def made(folder, form, northward=False, cell=1.0):
    transform = Affine(cell, 0, WEST, 0, cell, NORTH - ROWS * cell) if northward else None
    heights = HEIGHTS[::-1] if northward else HEIGHTS
    more = {"transform": transform, "cell": cell, "compress": "deflate"}
    return write(folder / "dsm.tif", heights, **FORMS[form], **more)


def read(path, grid=GRID):
    return read_window(path, path.name, grid, grid, UTM, heights=True)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("northward", [False, True])
@pytest.mark.parametrize(("row", "col"), [(0, 0), (40, 33), (89, 69)])
def test_cells_outside_a_damaged_block_are_read(form, northward, row, col, tmp_path):
    path = made(tmp_path, form, northward)
    rows, cols = damage(path, row, col)
    lost = np.zeros((ROWS, COLS), bool)
    lost[rows, cols] = True
    lost = lost[::-1] if northward else lost
    window = read(path)
    np.testing.assert_array_equal(window.unreadable, lost)
    np.testing.assert_array_equal(window.values, np.where(lost, np.nan, HEIGHTS))
    np.testing.assert_array_equal(window.reached(GRID), ~lost)
    assert "cannot be read" in str(window.fault)
    # A part of the grid, and one in the middle of the file.
    part = make_grid(30, 40, west=WEST + 20, north=NORTH - 30)
    np.testing.assert_array_equal(read(path, part).reached(part), ~lost[30:70, 20:50])


def test_cells_read_several_as_one_outside_a_damaged_block_are_as_before(tmp_path):
    path = made(tmp_path, "blocks", cell=0.2)
    grid = make_grid(14, 18)
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
        read(path)


def test_ascii_grid_with_a_damaged_row_is_an_error(tmp_path):
    """GDAL does not return from reading a row behind the damaged one."""
    path = write(tmp_path / "dsm.asc", HEIGHTS, driver="AAIGrid")
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 300] = b"7" * 300
    path.write_bytes(data)
    code = (
        "import sys; from pathlib import Path\n"
        "from tests.tasks.io.test_damaged_pixels import Unreadable, read\n"
        "try: read(Path(sys.argv[1]))\n"
        "except Unreadable as error: print(error)"
    )
    ended = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, timeout=60)
    assert "dsm.asc cannot be read: " in ended.stdout, ended.stderr


def good_file(kind, folder):
    """Write a good file, and return a function that reads it."""
    path = folder / f"good.{kind.split()[0]}"
    match kind:
        case "gpkg":
            line = LineString([(GRID.west, GRID.south), (GRID.west + 50, GRID.south + 50)])
            query = Query(write_roads(path, [line], crs=UTM), None, None, ("id",), None, UTM)

            def read_roads():
                for cached in (_layers, _part):
                    cached.cache_clear()
                return read_near(query, GRID.bounds).geometry.length.to_numpy()

            return read_roads
        case "tif photo":
            write(path, np.arange(ROWS * COLS).reshape(ROWS, COLS).astype(np.uint8))
            return lambda: read_photo(Source("dop", (path,)), GRID).colour
        case "xyz":
            write_xyz(path, HEIGHTS, GRID.west, NORTH)
        case _:
            write(path, HEIGHTS, driver="AAIGrid" if kind == "asc" else "GTiff")
    if "world file" in kind:
        path.with_suffix(".tfw").write_text(f"1\n0\n0\n-1\n{GRID.west + 0.5}\n{NORTH - 0.5}\n")
    return lambda: read(path).values


@pytest.mark.parametrize("kind", ["tif", "tif with world file", "asc", "xyz", "tif photo", "gpkg"])
def test_source_read_after_a_damaged_one_is_as_without_it(kind, tmp_path):
    read_good, bad = good_file(kind, tmp_path), made(tmp_path, "strips")
    damage(bad, 30, 0)
    before = read_good()
    for _ in range(2):
        assert "dsm.tif cannot be read" in str(read(bad).fault)
        np.testing.assert_array_equal(read_good(), before)
