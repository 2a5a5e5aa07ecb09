"""The fit of `smoothing_spline` computed literally: sparse design matrices, and a direct solver in each step.

The same steps as in `tasks.spline.irls`, each solved exactly. It is slow; tests compare the program with it.
"""

import numpy as np
import scipy
from scipy.interpolate import BSpline

from flexroad.tasks.fit import smoothing_spline

FINAL_M, INITIAL_M, COOLING = 0.003, 0.03, 0.6


def design(knots, degree, at, order=0):
    """Return the functions' derivatives of an order at the parameters, ``(N, points)``."""
    points = len(knots) - degree - 1
    return scipy.sparse.csr_array(BSpline(knots, np.eye(points), degree)(at, nu=order))


def bending_matrix(space, stiffness):
    """Return the second derivatives of the bending energy by the control heights, row by row."""
    total = 0
    for times, by_u, by_v in ((1, 2, 0), (2, 1, 1), (1, 0, 2)):
        along_u = design(space.knots_u, space.degree[0], space.u, by_u) / space.unit_m[0] ** by_u
        along_v = design(space.knots_v, space.degree[1], space.v, by_v) / space.unit_m[1] ** by_v
        curvature = scipy.sparse.kron(along_v, along_u).tocsr()
        total = total + curvature.T @ scipy.sparse.diags_array(2 * times * stiffness.ravel()) @ curvature
    return total.tocsr()


def huber(differences, limit):
    size = np.abs(differences)
    return np.where(size <= limit, size**2 / (2 * limit), size - limit / 2) if limit else size


def minimum(space, heights, weight, stiffness, first, held, huber_m, tolerance):
    """Take the place of ``smoothing_spline._minimum``."""
    valid = np.isfinite(heights)
    target, factor = np.where(valid, heights, 0).ravel(), np.where(valid, weight, 0).ravel() / valid.sum()
    matrix = scipy.sparse.kron(
        design(space.knots_v, space.degree[1], space.v), design(space.knots_u, space.degree[0], space.u)
    ).tocsr()
    bending, free = bending_matrix(space, stiffness / valid.sum()), ~held.ravel()

    def loss(z):
        return factor @ huber(matrix @ z - target, huber_m) + z @ (bending @ z) / 2

    z, losses = first.ravel().copy(), [loss(first.ravel())]
    floor = huber_m or FINAL_M
    for number in range(smoothing_spline.ITERATIONS):
        least, residuals = INITIAL_M * COOLING**number, matrix @ z - target
        weights = factor / np.maximum(np.abs(residuals), max(least, floor))
        normal = (matrix.T @ scipy.sparse.diags_array(weights) @ matrix + bending).tocsc()
        slope = matrix.T @ (weights * residuals) + bending @ z
        step = np.zeros_like(z)
        step[free] = scipy.sparse.linalg.spsolve(normal[free][:, free], -slope[free])
        line = scipy.optimize.minimize_scalar(
            lambda t, z=z, step=step: loss(z + t * step), bounds=(0, 3), method="bounded",
            options={"xatol": 1e-5},
        )  # fmt: skip
        if line.fun < losses[-1]:
            z = z + line.x * step
        losses.append(min(line.fun, losses[-1]))
        if least <= floor and losses[-2] - losses[-1] <= tolerance * losses[-2]:
            break
    return z.reshape(first.shape)
