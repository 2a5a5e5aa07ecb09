"""The solver for narrow splines against dense matrices and against the other solver."""

import numpy as np
import pytest

from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.banded import Banded
from flexroad.tasks.spline.multigrid import Multigrid
from flexroad.tasks.spline.stencil import from_lines, gram, line_width, to_lines
from flexroad.tasks.spline.surface import basis, dense, uniform_knots


def made(m, n, p, seed=0):
    """Return a stencil of random weights, its dense matrix, held points and a right-hand side."""
    rng = np.random.default_rng(seed)
    axes = []
    for points in (n, m):
        knots = uniform_knots(0, points - p, p)
        axes += basis(knots, p, np.sort(rng.uniform(0, points - p, 3 * points)))[:2]
    weight = 10 ** rng.uniform(-2, 0, (3 * m, 3 * n))
    stencil = np.zeros((n, p + 1, p + 1, line_width(m, p)))
    gram(weight, *axes, stencil)
    stencil[:, 0, 0, p : p + m] += 1e-3
    design = np.kron(dense(axes[2], axes[3], m), dense(axes[0], axes[1], n))
    matrix = design.T @ (weight.ravel()[:, None] * design) + 1e-3 * np.eye(m * n)
    return stencil, matrix, rng.random((m, n)) < 0.2, rng.normal(size=(m, n))


@pytest.mark.parametrize(("m", "n"), [(17, 31), (31, 17), (12, 12), (6, 20), (20, 6)])
@pytest.mark.parametrize("p", [2, 3, 4])
def test_solve_equals_dense_solution(m, n, p):
    """The free points alone; held points keep their height."""
    stencil, matrix, held, right = made(m, n, p)
    solution = from_lines(Banded((m, n), p, held).solve(stencil, to_lines(right, p)), m, p)
    free, expected = ~held.ravel(), np.zeros(m * n)
    expected[free] = np.linalg.solve(matrix[np.ix_(free, free)], right.ravel()[free])
    np.testing.assert_allclose(solution.ravel(), expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(("m", "n"), [(17, 80), (80, 17)])
def test_solve_equals_other_solver(m, n):
    stencil, _, held, right = made(m, n, 3)
    lines = to_lines(right, 3)
    exact = Banded((m, n), 3, held).solve(stencil, lines)
    close = Multigrid((m, n), 3, held).solve(stencil, lines, 1e-10, True)
    np.testing.assert_allclose(close, exact, atol=1e-4 + 1e-6 * np.abs(exact).max())


def test_solve_with_indefinite_matrix_raises():
    stencil = np.zeros((9, 4, 4, line_width(9, 3)))
    stencil[:, 0, 0, 3:12] = -1.0
    with pytest.raises(TaskError, match="control point 1 of the surface is undetermined"):
        Banded((9, 9), 3, None).solve(stencil, to_lines(np.ones((9, 9)), 3))


def test_suits_strips_alone():
    assert Banded.suits((17, 87), 3)
    assert Banded.suits((400, 17), 3)
    assert not Banded.suits((73, 73), 3)
