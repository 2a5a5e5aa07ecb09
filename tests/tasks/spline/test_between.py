"""Filled values are those of the exact solution, and stay between the known ones."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.spline.stepped import between

ROW, COL = np.indices((12, 15)).astype(float)
INSIDE = COL > 0


def test_plane_with_a_hole_is_filled_with_the_plane():
    plane = 3 + 0.2 * ROW - 0.1 * COL
    hole = (ROW > 3) & (ROW < 8) & (COL > 4) & (COL < 10)
    np.testing.assert_allclose(between(np.where(hole, np.nan, plane), INSIDE), plane, atol=1e-6)


def test_cells_outside_have_no_effect():
    values = np.where(COL == 1, 5.0, np.where(INSIDE, np.nan, 1e6))
    np.testing.assert_allclose(between(values, INSIDE)[INSIDE], 5.0, atol=1e-5)


def test_part_without_a_known_value_is_zero():
    values = np.where(INSIDE, np.nan, 7.0)
    assert not between(values, INSIDE)[INSIDE].any()


@given(st.integers(0, 999), st.floats(0.1, 0.9))
@settings(max_examples=30, deadline=None)
def test_each_filled_value_is_the_mean_of_its_neighbours(seed, share):
    rng = np.random.default_rng(seed)
    cells = INSIDE & (rng.random(ROW.shape) < 0.8)
    known = rng.normal(size=ROW.shape)
    unknown = cells & (rng.random(ROW.shape) < share)
    filled = between(np.where(unknown, np.nan, known), cells)
    np.testing.assert_array_equal(filled[~unknown], known[~unknown])
    for row, col in np.argwhere(unknown):
        away = np.abs(ROW - row) + np.abs(COL - col)
        beside = filled[cells & (away == 1)]
        assert abs(filled[row, col] - (beside.mean() if beside.size else 0.0)) < 1e-5
