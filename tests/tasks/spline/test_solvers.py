"""The two solvers of the normal equations, and their stencils, against dense matrices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.normal_equations import Multigrid, is_narrow, solve_banded
from flexroad.tasks.spline.stencil import add_from_cells, at_cells, from_lines, gram, line_width, to_lines
from flexroad.tasks.spline.surface import basis, dense, uniform_knots


def made(m, n, p, cells=None, seed=0):
    """Return the stencil of random weights of very different size, the dense matrix, and the basis."""
    rng = np.random.default_rng(seed)
    cells = cells or (3 * m, 3 * n)
    axes = []
    for points, count in ((n, cells[1]), (m, cells[0])):
        knots = uniform_knots(0, points - p, p)
        axes += basis(knots, p, np.sort(rng.uniform(0, points - p, count)))[:2]
    weight = 10 ** rng.uniform(-2, 0, cells)
    stencil = np.zeros((n, p + 1, p + 1, line_width(m, p)))
    gram(weight, *axes, stencil)
    design = np.kron(dense(axes[2], axes[3], m), dense(axes[0], axes[1], n))
    return stencil, design.T @ (weight.ravel()[:, None] * design), axes, design


def determined(m, n, p, held_share, seed=0):
    """Return a stencil, held points and a right-hand side, and the dense solution for the free points."""
    stencil, matrix, *_ = made(m, n, p, seed=seed)
    rng = np.random.default_rng(seed)
    held, right = rng.random((m, n)) < held_share, rng.normal(size=(m, n))
    stencil[:, 0, 0, p : p + m] += 1e-3
    matrix += 1e-3 * np.eye(m * n)
    free, expected = ~held.ravel(), np.zeros(m * n)
    expected[free] = np.linalg.solve(matrix[np.ix_(free, free)], right.ravel()[free])
    return stencil, held, to_lines(right, p), expected


@settings(max_examples=20)
@given(st.integers(0, 999), st.integers(2, 3), st.integers(6, 37), st.integers(6, 37), st.floats(0, 0.6))
def test_multigrid_equals_dense_solution(seed, p, m, n, held_share):
    """Held points keep their height."""
    stencil, held, right, expected = determined(m, n, p, held_share, seed)
    solution = from_lines(Multigrid(p, held).solve(stencil, right, 1e-10, True), m, p)
    np.testing.assert_allclose(solution.ravel(), expected, atol=1e-4 + 1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("m", "n"), [(17, 31), (31, 17), (12, 12), (6, 20), (20, 6)])
@pytest.mark.parametrize("p", [2, 3, 4])
def test_banded_equals_dense_solution(m, n, p):
    stencil, held, right, expected = determined(m, n, p, 0.2)
    solution = from_lines(solve_banded(stencil, right, held), m, p)
    np.testing.assert_allclose(solution.ravel(), expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("p", [1, 2, 3])
def test_splines_at_cells_equal_dense_products(p):
    m, n, cells = 17, 16, (40, 35)
    _, _, axes, design = made(m, n, p, cells)
    z, pull = (np.random.default_rng(1).normal(size=shape) for shape in ((m, n), cells))
    heights, sums = np.empty(cells), to_lines(np.zeros((m, n)), p)
    at_cells(to_lines(z, p), *axes, heights)
    add_from_cells(pull, *axes, sums)
    np.testing.assert_allclose(heights.ravel(), design @ z.ravel(), atol=1e-12)
    np.testing.assert_allclose(from_lines(sums, m, p).ravel(), design.T @ pull.ravel(), atol=1e-12)


def test_solve_with_indefinite_matrix_raises():
    stencil, held = np.zeros((9, 4, 4, line_width(9, 3))), np.zeros((9, 9), bool)
    stencil[:, 0, 0, 3:12] = -1.0
    right = to_lines(np.ones((9, 9)), 3)
    with pytest.raises(TaskError, match="control point 1 of the surface is undetermined"):
        solve_banded(stencil, right, held)
    with pytest.raises(TaskError, match="control point 1 of the surface is undetermined"):
        Multigrid(3, held).solve(stencil, right, 1e-6, True)


def test_multigrid_undetermined_points_keep_their_height():
    stencil, *_ = made(20, 20, 3)
    stencil[10:, :] = 0.0
    right = np.zeros((20, 20))
    right[:, :5] = 1.0
    grids = Multigrid(3, np.zeros((20, 20), bool))
    solution = from_lines(grids.solve(stencil, to_lines(right, 3), 1e-8, True), 20, 3)
    assert np.isfinite(solution).all()
    np.testing.assert_array_equal(solution[:, 15:], 0.0)


def test_is_narrow_strips_alone():
    assert [is_narrow(shape, 3) for shape in ((17, 87), (400, 17), (73, 73))] == [True, True, False]
