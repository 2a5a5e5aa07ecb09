"""Solve the normal equations of a narrow tensor-product spline by a Cholesky factorisation of its band.

The border of a tile is a long strip. If its control points are numbered across it, the matrix has few
diagonals beside the main one, and factorising it takes less time than the iterations of
`tasks.spline.multigrid`. The solution is exact up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.stencil import from_lines, to_lines
from flexroad.tasks.types import Bools, Floats

WIDEST = 64
"""Largest number of diagonals on one side of the main one: above, `Multigrid` is faster."""
RIDGE = 1e-9
"""Share of the diagonal's mean that is added to it: undetermined control points then keep their height."""


def undetermined(point: int) -> TaskError:
    """Return the error that says which control point, counted from 1, the equations do not determine."""
    return TaskError(
        f"control point {point} of the surface is undetermined; use fewer control points (a larger "
        "fit.spacing_m), or raise fit.bending_m3"
    )


@dataclass(frozen=True, eq=False)
class Banded:
    """The solver of one spline's normal equations; see `tasks.spline.multigrid.Multigrid`."""

    shape: tuple[int, int]
    """Number of control points along northing and easting, (m, n)."""
    degree: int
    held: Bools | None
    """Control points that keep their height, ``(m, n)``; None if all are free."""

    @staticmethod
    def suits(shape: tuple[int, int], degree: int) -> bool:
        """Return whether a spline is narrow enough."""
        return degree * (min(shape) + 1) <= WIDEST

    def solve(self, stencil: Floats, right: Floats, tolerance: float = 0.0, refresh: bool = True) -> Floats:
        """Return the solution for one right-hand side, lines ``(n, width)``; 0 at held control points.

        - `stencil` ``(n, p + 1, p + 1, width)``: the matrix.
        - `right` ``(n, width)``: the right-hand side.
        - `tolerance`, `refresh`: not used: the solution is exact, and nothing is kept from an earlier one.
        """
        (m, n), p = self.shape, self.degree
        free = np.ones(self.shape) if self.held is None else (~self.held).astype(np.float64)
        band = np.zeros((m * n, p * (min(m, n) + 1) + 1))
        ridge = RIDGE * float(stencil[:, 0, 0, p : p + m].mean()) + 1e-300
        _to_band(stencil, free, ridge, band)
        # Numbered from the south for a strip to the east, and from the west for one to the north.
        order: Literal["C", "F"] = "F" if m <= n else "C"
        values = (from_lines(right, m, p) * free).ravel(order)
        factor, failed = scipy.linalg.lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
        if failed:
            raise undetermined(failed)
        solution, _ = scipy.linalg.lapack.dpbtrs(factor, values, lower=1)
        return to_lines(solution.reshape((m, n), order=order), p)


@compiled(error_model="numpy")
def _to_band(stencil: Floats, free: Floats, ridge: float, band: Floats) -> None:
    """Write the main diagonal and those below it of the matrix, by columns, ``(points, diagonals)``.

    Held points have the equation 0 = 0.
    """
    (m, n), lags = free.shape, stencil.shape[1]
    p = lags - 1
    # Steps from one point to the next along u and along v.
    step_u, step_v = (m, 1) if m <= n else (1, n)
    for j in range(n):
        for l in range(min(lags, n - j)):  # noqa: E741
            for k in range(lags):
                for i in range(m - k):
                    value = stencil[j, l, k, p + i]
                    # Two pairs of points have these distances: one falls along u while the other rises.
                    a, b = j * step_u + i * step_v, (j + l) * step_u + (i + k) * step_v
                    band[a, b - a] = value * free[i, j] * free[i + k, j + l]
                    a, b = j * step_u + (i + k) * step_v, (j + l) * step_u + i * step_v
                    band[min(a, b), abs(b - a)] = value * free[i + k, j] * free[i, j + l]
    for j in range(n):
        for i in range(m):
            band[j * step_u + i * step_v, 0] += ridge if free[i, j] > 0.0 else 1.0
