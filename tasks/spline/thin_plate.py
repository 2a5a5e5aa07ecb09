"""The bending energy of a B-spline height field, as of a thin plate of that shape.

``E = sum over cells of stiffness * (z_xx^2 + 2 z_xy^2 + z_yy^2)`` with derivatives per metre, so that it does
not depend on the number of control points; it is 0 for planes. The sum is over cells because the stiffness
may differ from cell to cell: a road is stiffer than the ground beside it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from flexroad.tasks.spline.space import Space
from flexroad.tasks.spline.stencil import gram, line_width
from flexroad.tasks.spline.surface import KEPT, Starts, basis, dense
from flexroad.tasks.types import Floats

Derivatives = tuple[Starts, tuple[Floats, Floats, Floats]]
"""First basis function that is not zero at each cell of one axis, ``(N,)``; the functions from it on, and
their first and second derivatives, ``(N, p + 1)`` each."""


def bending_energy(stiffness: Floats, space: Space) -> Floats:
    """Return the second derivatives of the bending energy by the control heights, as a stencil.

    The energy (m) of control heights z is ``z^T S z / 2``, and ``S z`` is its gradient.

    - `stiffness` ``(H, W)``: weight of the squared curvature in each cell (m3).
    - `space`: the splines, of degree 2 at least, with the parameters of the raster's columns and rows.
    - result ``(n, p + 1, p + 1, width)``: see `tasks.spline.stencil`.
    """
    start_u, along_u = _derivatives(space.knots_u, space.degree[0], space.u, space.unit_m[0])
    start_v, along_v = _derivatives(space.knots_v, space.degree[1], space.v, space.unit_m[1])
    n, m = space.points
    lags = space.degree[0] + 1
    stencil = np.zeros((n, lags, lags, line_width(m, lags - 1)))
    for times, by_u, by_v in ((1.0, 2, 0), (2.0, 1, 1), (1.0, 0, 2)):
        gram(2 * times * stiffness, start_u, along_u[by_u], start_v, along_v[by_v], stencil)
    return stencil


def _derivatives(knots: Floats, degree: int, u: Floats, unit_m: float) -> Derivatives:
    """Return the basis functions at ``u`` and their first and second derivatives per metre.

    They are kept for the next fit and must not be changed: tiles and their borders use the same few.
    """
    return _kept_derivatives(knots.tobytes(), degree, u.tobytes(), unit_m)


@lru_cache(maxsize=KEPT)
def _kept_derivatives(knots_bytes: bytes, degree: int, u_bytes: bytes, unit_m: float) -> Derivatives:
    """Return the result of `_derivatives`.

    A derivative is a spline of one degree less over the knots without the outermost (de Boor, "A practical
    guide to splines", chapter X).
    """
    knots, u = np.frombuffer(knots_bytes), np.frombuffer(u_bytes)
    points = len(knots) - degree - 1
    coefficients, derivatives = np.eye(points), []
    first, _, _ = basis(knots, degree, u)
    support = first[:, None] + np.arange(degree + 1)
    for order in range(3):
        inner, lower = knots[order : len(knots) - order], degree - order
        start, values, _ = basis(inner, lower, u)
        derivative = dense(start, values, points - order) @ coefficients / unit_m**order
        derivatives.append(np.take_along_axis(derivative, support, axis=1))
        if lower:
            rate = lower / (inner[lower + 1 : -1] - inner[1 : points - order])
            coefficients = rate[:, None] * np.diff(coefficients, axis=0)
    return first, (derivatives[0], derivatives[1], derivatives[2])
