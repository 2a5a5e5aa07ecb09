"""A raster with damaged pixels changes nothing for the files that are read after it."""

import numpy as np
import pytest
from shapely import LineString

from flexroad.catalog import Grid
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.io.raster import read_window
from flexroad.tasks.io.vectors import Query, _layers, _part, read_near
from flexroad.tasks.types import Source
from tests.make_rasters import UTM, damage, write, write_xyz
from tests.make_roads import write as write_roads

SIZE = 60
GRID = Grid(UTM, 295500.0, 5629500.0, 1.0, SIZE, SIZE)
HEIGHTS = np.random.default_rng(0).normal(100, 1, (SIZE, SIZE)).round(2)
NORTH = GRID.north


def heights(path):
    return window(path).values


def window(path):
    return read_window(path, path.name, GRID, GRID, UTM, heights=True)


def tif(folder):
    path = write(folder / "good.tif", HEIGHTS, north=NORTH)
    return lambda: heights(path)


def with_world_file(folder):
    path = write(folder / "good.tif", HEIGHTS, north=NORTH)
    path.with_suffix(".tfw").write_text(f"1\n0\n0\n-1\n{GRID.west + 0.5}\n{NORTH - 0.5}\n")
    return lambda: heights(path)


def ascii_grid(folder):
    path = write(folder / "good.asc", HEIGHTS, north=NORTH, driver="AAIGrid")
    return lambda: heights(path)


def xyz(folder):
    path = write_xyz(folder / "good.xyz", HEIGHTS, GRID.west, NORTH)
    return lambda: heights(path)


def photo(folder):
    path = write(folder / "good.tif", np.arange(SIZE**2, dtype=np.uint8).reshape(SIZE, SIZE), north=NORTH)
    return lambda: read_photo(Source("dop", (path,)), GRID).colour


def roads(folder):
    line = LineString([(GRID.west, GRID.south), (GRID.west + 50, GRID.south + 50)])
    path = write_roads(folder / "good.gpkg", [line], crs=UTM)
    query = Query(path, None, None, ("id",), None, UTM)

    def read():
        for cached in (_layers, _part):
            cached.cache_clear()
        return np.array([part.length for part in read_near(query, GRID.bounds).geometry])

    return read


def damaged_raster(folder):
    """Write a raster whose header is good and of which a block of pixels is not."""
    path = write(folder / "bad.tif", HEIGHTS, north=NORTH, compress="deflate")
    damage(path, 30, 0)
    return path


@pytest.mark.parametrize("kind", [tif, with_world_file, ascii_grid, xyz, photo, roads])
def test_source_read_after_a_damaged_one_is_as_without_it(kind, tmp_path):
    read, bad = kind(tmp_path), damaged_raster(tmp_path)
    before = read()
    for _ in range(2):
        assert "bad.tif cannot be read" in str(window(bad).fault)
        np.testing.assert_array_equal(read(), before)
