"""The bending energy of a B-spline height field, as of a thin plate of that shape.

``E = sum over cells of stiffness * (z_xx^2 + 2 z_xy^2 + z_yy^2)`` with derivatives per metre, so that it does
not depend on the number of control points; it is 0 for planes. The sum is over cells because the stiffness
may differ from cell to cell: a road is stiffer than the ground beside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.spline.normal_equations import gram, pairs
from flexroad.tasks.spline.space import Space
from flexroad.tasks.spline.surface import basis, dense
from flexroad.tasks.types import Floats

Derivatives = tuple[Floats, Floats, Floats]
"""Basis functions at the cells of one axis, and their first and second derivatives, ``(N, points)`` each."""


@dataclass(frozen=True, eq=False)
class BendingEnergy:
    """The bending energy of a thin plate over a raster."""

    stiffness: Floats
    """Weight of the squared curvature in each cell, ``(H, W)``, m3."""
    along_u: Derivatives
    """Basis functions at the columns and their derivatives per metre."""
    along_v: Derivatives
    """Basis functions at the rows and their derivatives per metre."""

    def __call__(self, z: Floats) -> tuple[float, Floats]:
        """Return the energy (m) of control heights ``(m, n)``, and its gradient."""
        loss, gradient = 0.0, np.zeros_like(z)
        for times, along_v, along_u in self._parts():
            curvature = along_v @ z @ along_u.T
            pull = times * self.stiffness * curvature
            loss += float(np.vdot(pull, curvature))
            gradient += 2 * along_v.T @ pull @ along_u
        return loss, gradient

    def hessian(self, lags: int) -> Floats:
        """Return the second derivatives by the control heights, laid out as by `normal_equations.gram`."""
        parts = [
            gram(2 * times * self.stiffness, pairs(along_v, lags), pairs(along_u, lags), lags)
            for times, along_v, along_u in self._parts()
        ]
        return np.asarray(sum(parts))

    def _parts(self) -> Iterator[tuple[float, Floats, Floats]]:
        yield 1.0, self.along_v[0], self.along_u[2]
        yield 2.0, self.along_v[1], self.along_u[1]
        yield 1.0, self.along_v[2], self.along_u[0]


def bending_energy(stiffness: Floats, space: Space) -> BendingEnergy:
    """Return the bending energy over a raster.

    Parameters
    ----------
    stiffness : ndarray, (H, W)
        Weight of the squared curvature in each cell (m3).
    space : Space
        The splines, of degree 2 at least, with the parameters of the raster's columns and rows.
    """
    along_u = _derivatives(space.knots_u, space.degree[0], space.u, space.unit_m[0])
    along_v = _derivatives(space.knots_v, space.degree[1], space.v, space.unit_m[1])
    return BendingEnergy(stiffness, along_u, along_v)


def _derivatives(knots: Floats, degree: int, u: Floats, unit_m: float) -> Derivatives:
    """Return the basis functions at ``u`` and their first and second derivatives per metre.

    A derivative is a spline of one degree less over the knots without the outermost (de Boor, "A practical
    guide to splines", chapter X).
    """
    points = len(knots) - degree - 1
    coefficients, derivatives = np.eye(points), []
    for order in range(3):
        inner, lower = knots[order : len(knots) - order], degree - order
        start, values, _ = basis(inner, lower, u)
        derivatives.append(dense(start, values, points - order) @ coefficients / unit_m**order)
        if lower:
            rate = lower / (inner[lower + 1 : -1] - inner[1 : points - order])
            coefficients = rate[:, None] * np.diff(coefficients, axis=0)
    return derivatives[0], derivatives[1], derivatives[2]
