import numpy as np
import pytest

from flexroad.tasks.types import RoadMask
from flexroad.tools.export.step import covered
from tests.builders import make_grid

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
