import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from flexroad.tasks.roads.extent import beyond_extent, covered
from flexroad.tasks.types import RoadMask
from tests.builders import make_grid, make_tile

CORE = make_grid(5, 4, 2.0)


def outside(inner) -> np.ndarray:
    cells = np.ones(CORE.shape, bool)
    cells[inner] = False
    return cells


@pytest.mark.parametrize(
    ("inner", "bounds", "lost_m2"),
    [
        (([1, 1, 2, 2], [2, 3, 3, 2]), (295504.0, 5629494.0, 295508.0, 5629498.0), 0.0),
        (([1, 2, 2], [3, 3, 2]), (295504.0, 5629494.0, 295508.0, 5629498.0), 4.0),
        (np.s_[:, :], CORE.bounds, 0.0),
        (np.s_[:0], CORE.bounds, 80.0),
    ],
    ids=["rectangle", "without a corner", "complete", "beyond the survey"],
)
def test_covered_is_the_rectangle_around_the_covered_cells_of_the_core(inner, bounds, lost_m2):
    """A halo of one cell has no effect."""
    cells = outside(inner)
    for grid, beyond in ((CORE, cells), (CORE.buffered(2), np.pad(cells, 1, constant_values=True))):
        assert covered(RoadMask(grid, CORE, np.zeros(grid.shape, bool), beyond)) == (bounds, lost_m2)


def tile(void, dtm_void=None):
    models = (np.where(cells, np.nan, 5.0) for cells in (void, void if dtm_void is None else dtm_void))
    return make_tile(*models)


def test_beyond_extent_cell_with_one_height_is_inside():
    row = np.indices((6, 8))[0]
    assert not beyond_extent(tile(row < 3, row >= 3)).any()
    np.testing.assert_array_equal(beyond_extent(tile(row < 3, row >= 2)), row == 2)


@given(arrays(bool, (6, 8)))
def test_beyond_extent_equals_flood_fill_from_edge(void):
    """Compared with a flood fill that spreads cell by cell, not diagonally."""
    filled = np.zeros_like(void)
    rim = np.ones_like(void)
    rim[1:-1, 1:-1] = False
    filled |= void & rim
    for _ in range(void.size):
        spread = np.pad(filled, 1)
        filled |= void & (spread[:-2, 1:-1] | spread[2:, 1:-1] | spread[1:-1, :-2] | spread[1:-1, 2:])
    np.testing.assert_array_equal(beyond_extent(tile(void)), filled)
