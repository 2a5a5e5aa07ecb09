"""Lines of a mesh along the edges of steps."""

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.meshing.survey_limit import APART, breaklines
from flexroad.tasks.spline.stepped import SteppedSurface

CELLS = Grid("EPSG:25832", 500000.0, 5600030.0, 1.0, 30, 30)
LOCAL = (0.0, 0.0, 30.0, 30.0)
NOISE = 0.1 * np.random.default_rng(0).standard_normal(CELLS.shape)
HIGH = np.zeros(CELLS.shape, bool)
HIGH[10:20] = True


def level(steps) -> SteppedSurface:
    """A level spline with steps."""
    knots = np.array([0.0, 0, 1, 1])
    spline = {"crs": CELLS.crs, "bounds": CELLS.exact_bounds, "degree": (1, 1), "datum": 0.0}
    spline |= {"knots_u": knots, "knots_v": knots, "A": np.full((2, 2), 100.0), "W": np.ones((2, 2))}
    steps = np.asarray(steps, np.float32)
    spline |= {"south_north": np.zeros((2, CELLS.width)), "west_east": np.zeros((2, CELLS.height))}
    return SteppedSurface(**spline, origin=CELLS.origin, steps=steps, cells=CELLS)


def test_noise_of_single_cells_has_no_line():
    assert breaklines(level(NOISE), LOCAL)[0].is_empty


@pytest.mark.parametrize("step", [0.3, -4.0])
def test_edge_with_noise_has_two_lines_with_its_heights(step):
    lines, height = breaklines(level(np.where(HIGH, step, 0.0) + 0.3 * NOISE), LOCAL)
    _, low, _, high = lines.bounds
    assert (low, high) == pytest.approx((10 - APART / 2, 20 + APART / 2))
    # Two lines around a block that ends one cell from the border of the tile.
    assert lines.length == pytest.approx(2 * 2 * (28 + 10), rel=0.05)
    sides = np.array([[15.5, 20 - APART / 2], [15.5, 20 + APART / 2]])
    np.testing.assert_allclose(height(sides), [100 + step, 100], atol=0.2)
