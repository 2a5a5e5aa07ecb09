from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog import CatalogError, Grid

UTM = "EPSG:25832"
TILE = Grid(UTM, 295500.0, 5629500.0, 1.0, 250, 250)


def test_paper_tile_centres_span_249_m():
    assert TILE.eastings[-1] - TILE.eastings[0] == 249
    assert TILE.northings[0] - TILE.northings[-1] == 249
    assert TILE.bounds == (295500, 5629250, 295750, 5629500)
    assert TILE.transform @ (0, 0) == (295500, 5629500)


@pytest.mark.parametrize(
    ("west", "north", "size", "ids"),
    [
        (295500.0, 5629500.0, 250, ["295500_5629250"]),
        (295499.9999, 5629500.0001, 250, ["295500_5629250"]),  # an error of rounding adds no tile
        (295499.0, 5629501.0, 10, ["295250_5629250", "295500_5629250", "295250_5629500", "295500_5629500"]),
        (-10.0, -5.0, 5, ["-250_-250"]),
    ],
)
def test_tile_ids_are_the_south_west_corner(west, north, size, ids):
    assert [name for name, _ in Grid(UTM, west, north, 1.0, size, size).tiles(250)] == ids


@pytest.mark.parametrize("size", [250.5, 0.3])
def test_tiles_size_not_whole_raises_error(size):
    with pytest.raises(CatalogError, match="whole number"):
        list(TILE.tiles(size))


@given(halo=st.floats(0, 60), cell=st.sampled_from([0.25, 0.5, 1.0, 2.0]))
def test_buffered_core_is_in_the_middle(halo, cell):
    core = Grid(UTM, 500000.0, 5600000.0, cell, 40, 30)
    outer = core.buffered(halo)
    rows, cols = outer.window(core)
    assert (rows.stop - rows.start, cols.stop - cols.start) == core.shape
    assert rows.start == outer.height - rows.stop == cols.start == outer.width - cols.stop
    assert halo - 1e-5 <= rows.start * cell < halo + cell + 1e-5


def test_window_other_lattice_or_larger_grid_raises_error():
    with pytest.raises(CatalogError, match="does not lie"):
        TILE.window(Grid(UTM, 295500.4, 5629500.0, 1.0, 10, 10))
    with pytest.raises(CatalogError, match="does not lie"):
        TILE.window(TILE.buffered(5))


@given(row=st.integers(0, 249), col=st.integers(0, 249))
def test_cells_of_centre_is_its_own_cell_and_of_other_points_the_nearest(row, col):
    got = TILE.cells(TILE.eastings[col], TILE.northings[row])
    assert (int(got[0]), int(got[1])) == (row, col)
    got = TILE.cells(TILE.west - 5, TILE.northings[row])
    assert (int(got[0]), int(got[1])) == (row, 0)
    got = TILE.cells(TILE.eastings[col], TILE.south - 5)
    assert (int(got[0]), int(got[1])) == (249, col)


def test_grid_invalid_size_raises_error():
    with pytest.raises(CatalogError, match="cell size"):
        Grid(UTM, 0, 0, 0.0, 1, 1)
    with pytest.raises(CatalogError, match="at least one cell"):
        Grid(UTM, 0, 0, 1.0, 0, 1)


@pytest.mark.parametrize(
    ("change", "shape"),
    [
        ({"west": 500060.0}, (60, 120)),
        ({"west": 499000.0, "north": 5600300.0}, (360, 1060)),
        ({"west": 500060.25}, None),
        ({"cell": 0.5}, None),
        ({"crs": "EPSG:25833"}, None),
        ({"west": 5e9}, None),
    ],
)
def test_holding_has_the_cells_of_all_grids(change, shape):
    grid = Grid(UTM, 500000.0, 5600000.0, 1.0, 60, 60)
    common = Grid.holding([grid, replace(grid, **change)])
    assert (common and common.shape) == shape
