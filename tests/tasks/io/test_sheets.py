"""Sheets of one layer against the surface that they are cut from: no step at their borders.

Bilinear interpolation of a plane is exact, so every cell has its height, wherever sheets end.
"""

from datetime import UTC, datetime

import numpy as np
import pytest
from pyproj import Transformer

from flexroad.catalog import Grid, Layer, Tile
from flexroad.tasks.load import Options, load
from tests.make_rasters import UTM, write

GRID = Grid(UTM, 500_000.0, 5_600_040.0, 1.0, 40, 40)
OFF = Options(min_valid=0)
TOLERANCE_M = 1e-6


def plane(east, north):
    return 100 + 0.2 * (east - GRID.west) - 0.1 * (north - GRID.north)


def centres(west, north, cell, width, height):
    """Return eastings and northings of the centres of cells; west and north in m from the grid's corner."""
    x = GRID.west + west + (np.arange(width) + 0.5) * cell
    y = GRID.north + north - (np.arange(height) + 0.5) * cell
    return np.meshgrid(x, y)


def sheet(folder, number, west, north, cell, width, height, surface=plane):
    values = surface(*centres(west, north, cell, width, height))
    name = f"dtm_{number}.tif"
    write(folder / name, values, GRID.west + west, GRID.north + north, cell=cell)
    return name


def tile(folder, names, grid=GRID, reproject=False):
    write(folder / "dsm.tif", plane(*centres(-30, 30, 1.0, 100, 100)), GRID.west - 30, GRID.north + 30)
    layers = Layer("dsm", ("dsm.tif",)), Layer("dtm", tuple(names), reproject=reproject)
    return Tile("sheets", grid, layers, str(folder), datetime(2025, 3, 1, tzinfo=UTC))


def expected(grid):
    return plane(*np.meshgrid(grid.eastings, grid.northings))


def core(loaded):
    return loaded.dtm[loaded.grid.window(loaded.core)]


def assert_plane(loaded):
    np.testing.assert_allclose(core(loaded), expected(loaded.core), rtol=0, atol=TOLERANCE_M)


# West, north (m from the grid's corner), cell (m), columns and rows of each sheet.
SHEETS = {
    "centres on whole metres, cut at a centre": [(-10.5, 10.5, 1, 30, 61), (19.5, 10.5, 1, 31, 61)],
    "cut from north to south": [(-10.5, 10.5, 1, 61, 30), (-10.5, -19.5, 1, 61, 31)],
    "cells of 5 m": [(-10, 10, 5, 6, 12), (20, 10, 5, 6, 12)],
    "four sheets of 5 m": [(-10, 10, 5, 6, 6), (20, 10, 5, 6, 6), (-10, -20, 5, 6, 6), (20, -20, 5, 6, 6)],
    "5 m beside the tile's lattice": [(-10, 10, 5, 6, 12), (20, 10, 1, 30, 60)],
    "the tile's lattice beside 5 m": [(-10, 10, 1, 30, 60), (20, 10, 5, 6, 12)],
    "the tile's lattice beside 0.5 m": [(-10, 10, 0.5, 60, 120), (20, 10, 1, 30, 60)],
    "half a cell beside 2 m": [(-10.5, 10.5, 1, 30, 61), (19.5, 10.5, 2, 16, 32)],
    "three sizes": [(-10, 10, 1, 20, 60), (10, 10, 2.5, 4, 24), (20, 10, 1.3, 24, 47)],
    "four lattices": [
        (-10, 10, 5, 6, 6),
        (20, 10, 1, 30, 30),
        (-10.5, -20, 2, 16, 16),
        (20.3, -20, 1.5, 22, 22),
    ],
    "overlap": [(-10.5, 10.5, 1, 40, 61), (10, 10, 5, 8, 12)],
    "noise of a cell size": [(-10.5, 10.5, 1.0, 30, 61), (19.5, 10.5, 1.0000000000000349, 31, 61)],
}
SHEETS |= {
    f"{cell} m divide nothing": [(-10.13, 10.31, cell, int(60 / cell), int(60 / cell))]
    for cell in (0.95, 0.8, 0.762, 0.6, 0.4, 0.3048, 0.27, 0.2, 0.17)
}


@pytest.mark.parametrize("sheets", SHEETS.values(), ids=SHEETS)
def test_sheets_of_a_plane_have_its_heights_at_their_borders(sheets, tmp_path):
    names = [sheet(tmp_path, number, *each) for number, each in enumerate(sheets)]
    assert_plane(load(tile(tmp_path, names), OFF))


def rough(x, y):
    return 100 + 5 * np.sin(x * 1.3) * np.cos(y * 0.9)


@pytest.mark.parametrize("cell", [0.8, 0.5, 0.2, 0.1, 0.04, 0.0499])
@pytest.mark.parametrize("share", [0.41, 0.5])
def test_sheets_of_one_lattice_equal_one_file(cell, share, tmp_path):
    """Also where several cells are read as one, of which some are in the next sheet."""
    count = round(64 / cell)
    cut = round(share * count)
    corners = {"nw": (0, 0), "ne": (0, cut), "sw": (cut, 0), "se": (cut, cut)}
    heights = rough(*centres(-10.3, 10.4, cell, count, count)).astype(np.float32)
    write(tmp_path / "whole.tif", heights, GRID.west - 10.3, GRID.north + 10.4, cell=cell)
    for name, (row, col) in corners.items():
        rows, cols = (slice(start, None if start else cut) for start in (row, col))
        west, north = GRID.west - 10.3 + col * cell, GRID.north + 10.4 - row * cell
        write(tmp_path / f"{name}.tif", heights[rows, cols], west, north, cell=cell)
    one = load(tile(tmp_path, ["whole.tif"]), OFF).dtm
    parts = load(tile(tmp_path, [f"{name}.tif" for name in corners]), OFF).dtm
    np.testing.assert_allclose(parts, one, rtol=0, atol=1e-5)


@pytest.mark.parametrize("others", [[(20.6, 10, 5, 6, 12)], [(20.6, 10, 1, 30, 60)]])
def test_incomplete_step_beside_another_lattice_has_no_rim(others, tmp_path):
    """The last column of the first sheet is read alone, of the others two are read as one."""
    names = [
        sheet(tmp_path, number, *each) for number, each in enumerate([(-10, 10, 0.2, 153, 300), *others])
    ]
    loaded = load(tile(tmp_path, names), OFF)
    whole = load(tile(tmp_path, [sheet(tmp_path, "whole", -10, 10, 0.2, 300, 300)]), OFF)
    np.testing.assert_allclose(core(loaded), core(whole), rtol=0, atol=0.002)


def test_void_filled_by_another_sheet_has_no_rim(tmp_path):
    """A sheet ends in cells without a value, as at the border of a state."""
    heights = plane(*centres(-10.5, 10.5, 1.0, 61, 61))
    row, col = np.mgrid[:61, :61]
    heights[row + col > 50] = -9999
    write(tmp_path / "state.tif", heights, GRID.west - 10.5, GRID.north + 10.5, nodata=-9999)
    assert_plane(load(tile(tmp_path, ["state.tif", sheet(tmp_path, "next", -10, 10, 5, 12, 12)]), OFF))


def test_void_of_all_sheets_keeps_its_size(tmp_path):
    heights = plane(*centres(-10, 10, 1.0, 30, 60))
    heights[25:30, 15:20] = -9999
    write(tmp_path / "fine.tif", heights, GRID.west - 10, GRID.north + 10, nodata=-9999)
    loaded = load(tile(tmp_path, ["fine.tif", sheet(tmp_path, "coarse", 20, 10, 5, 6, 12)]), OFF)
    want = expected(GRID)
    want[15:20, 5:10] = np.nan
    np.testing.assert_allclose(core(loaded), want, rtol=0, atol=TOLERANCE_M)


def test_overlapping_sheets_of_other_lattices_use_the_first_with_a_value(tmp_path):
    """The second and the third overlap; the third is of the first one's lattice."""
    level = [lambda x, _, height=height: np.full_like(x, height) for height in (100.0, 200.0, 300.0)]
    names = [
        sheet(tmp_path, 0, -10.5, 10.5, 1, 20, 61, level[0]),
        sheet(tmp_path, 1, 9.5, 10.5, 2, 10, 31, level[1]),
        sheet(tmp_path, 2, 9.5, 10.5, 1, 41, 61, level[2]),
    ]
    dtm = load(tile(tmp_path, names), OFF).dtm
    for columns, height in ((slice(0, 7), 100), (slice(12, 27), 200), (slice(32, 40), 300)):
        assert np.unique(dtm[:, columns]) == height


@pytest.mark.parametrize("cells", [(1.0, 1.0), (1.0, 5.0), (0.2, 1.0), (0.2, 0.2)])
def test_sheets_in_another_crs_have_the_heights_at_their_borders(cells, tmp_path):
    """Zone 33 on a tile of zone 32, in which the surface is a plane."""
    to_32 = Transformer.from_crs("EPSG:25833", UTM, always_xy=True)
    middle = to_32.transform(*(GRID.west + 20, GRID.north - 20), direction="INVERSE")
    names = []
    for number, cell in enumerate(cells):
        # The second sheet begins where the first one ends, 0.1 m east of the middle of the tile.
        count = round(60 / cell) + (number == 0 and cell < 1)
        east, north = middle[0] + 0.1 - (0 if number else count * cell), middle[1] + 60
        x = east + (np.arange(count) + 0.5) * cell
        y = north - (np.arange(round(120 / cell)) + 0.5) * cell
        values = plane(*to_32.transform(*np.meshgrid(x, y)))
        names.append(f"{number}.tif")
        write(tmp_path / names[-1], values, east, north, cell=cell, crs="EPSG:25833")
    loaded = load(tile(tmp_path, names, reproject=True), OFF)
    np.testing.assert_allclose(loaded.dtm, expected(GRID), rtol=0, atol=0.002)


def test_sheet_in_another_crs_beside_one_of_the_tile_has_no_rim(tmp_path):
    to_32 = Transformer.from_crs("EPSG:25833", UTM, always_xy=True)
    east, north = to_32.transform(GRID.west + 20, GRID.north - 20, direction="INVERSE")
    x, y = np.meshgrid(east - 60 + np.arange(24) * 5 + 2.5, north + 60 - np.arange(24) * 5 - 2.5)
    write(tmp_path / "33.tif", plane(*to_32.transform(x, y)), east - 60, north + 60, cell=5, crs="EPSG:25833")
    names = ["33.tif", sheet(tmp_path, "west", -10, 10, 1, 30, 60)]
    loaded = load(tile(tmp_path, names, reproject=True), OFF)
    np.testing.assert_allclose(loaded.dtm, expected(GRID), rtol=0, atol=0.002)
