"""Corners and edges of tiles: the same from all tiles around them."""

import numpy as np
import pytest

from flexroad.catalog.borders import border_of
from flexroad.catalog.grid import Grid

KINDS = ["corner"] * 4 + ["east"] * 2 + ["north"] * 2


def tile(column, row, west=295500.0, south=5629250.0, cell=1.0, size=(250, 200)):
    """A tile of a block, made as the catalog makes it: from its own north-west corner."""
    width, height = size[0] * cell, size[1] * cell
    return Grid("EPSG:25832", west + column * width, south + (row + 1) * height, cell, *size)


@pytest.mark.parametrize(
    ("west", "cell"), [(295500.0, 1.0), (295500.0, 0.2), (295500.25, 0.5), (1000.1, 0.1), (-500.0, 2.0)]
)
def test_neighbours_have_equal_corners_and_edges(west, cell):
    here, east, north, diagonal = (
        border_of(tile(column, row, west, cell=cell), 100) for row in (0, 1) for column in (0, 1)
    )
    assert [border.kind for border in here] == KINDS
    assert (here[1], here[3], here[7]) == (east[0], east[2], east[6])
    assert (here[2], here[3], here[5]) == (north[0], north[1], north[4])
    assert here[3] == diagonal[0]
    assert len({*here, *east, *north, *diagonal}) == 9 + 6 + 6


def test_border_of_whole_numbers_equals_that_of_fractions():
    """Cutting gives tiles with whole numbers, reading gives fractions; fingerprints are of their text."""
    whole = Grid("EPSG:25832", 295500, 5629450, 1.0, 250, 200)
    assert [repr(border) for border in border_of(whole, 100)] == [
        repr(border) for border in border_of(tile(0, 0), 100)
    ]


def test_border_cells_reach_around_corner_and_edge():
    south_west, *_, south, _, west, _ = border_of(tile(0, 0), 100)
    assert south_west.grid.bounds == (295400, 5629150, 295600, 5629350)
    assert south.grid.bounds == (295400, 5629150, 295850, 5629350)
    assert west.grid.bounds == (295400, 5629150, 295600, 5629550)
    assert west.within(30) == (295470, 5629220, 295530, 5629480)
    assert (south.cell, west.cell) == ((100, 100), (300, 100))


@pytest.mark.parametrize("number", range(8))
def test_border_sides_are_cells_along_it(number):
    border = border_of(tile(0, 0), 30)[number]
    east, north = np.meshgrid(border.grid.eastings, border.grid.northings)
    first, second = ((east[side], north[side]) for side in border.sides)
    length = {"corner": 2, "east": 250, "north": 200}[border.kind]
    assert first[0].size == second[0].size == length
    across = 0 if border.kind == "north" else 1
    start = border.start[across]
    # The first side is in the north or west, each half a cell away.
    sign = -1 if across == 0 else 1
    np.testing.assert_allclose(first[across], start + sign * 0.5)
    np.testing.assert_allclose(second[across], start - sign * 0.5)
    along = border.start[1 - across] - (1 if border.kind == "corner" else 0)
    np.testing.assert_allclose(np.sort(first[1 - across].ravel()), along + 0.5 + np.arange(length))


def test_along_edges_has_cells_of_both_sides_from_the_start():
    here = tile(0, 0)
    for border in border_of(here, 20)[4:]:
        eastings, northings = np.meshgrid(border.grid.eastings, border.grid.northings)
        x, y = border.along(eastings), border.along(northings)
        if border.kind == "east":
            np.testing.assert_allclose(x, [here.eastings] * 2)
            np.testing.assert_allclose(y[:, 0] - border.start[1], [0.5, -0.5])
        else:
            np.testing.assert_allclose(y, [here.northings[::-1]] * 2)
            np.testing.assert_allclose(x[:, 0] - border.start[0], [-0.5, 0.5])


@pytest.mark.parametrize("number", range(8))
@pytest.mark.parametrize("reach", [0, 3, 29])
def test_strip_is_cells_beside_border(number, reach):
    border = border_of(tile(0, 0), 30)[number]
    (rows, cols), strip = border.strip(reach)
    east, north = np.meshgrid(border.grid.eastings, border.grid.northings)
    away = []
    for side in border.sides:
        beyond = [(at[side].min() - at, at - at[side].max()) for at in (east, north)]
        away.append(np.max([*beyond[0], *beyond[1]], axis=0))
    assert np.minimum(*away)[rows, cols].max() == reach
    assert (np.minimum(*away) <= reach).sum() == strip.grid.width * strip.grid.height
    assert border.grid.part(rows, cols) == strip.grid
    cells = np.arange(border.grid.width * border.grid.height).reshape(border.grid.shape)
    np.testing.assert_array_equal(strip.along(cells[rows, cols]), border.along(cells))


def test_strip_ends_with_grid():
    border = border_of(tile(0, 0), 30)[4]
    assert border.strip(100)[1] == border
