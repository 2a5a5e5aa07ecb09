"""The matrix of a tensor-product spline's quadratic form, kept as a stencil.

Two basis functions overlap only if their indices differ by at most the degree p along both axes. The matrix
is a sum over cells of products along u times products along v. So an element depends on the unordered pair
of indices along each axis: ``(p + 1)^2`` numbers per control point are enough. ``S[j, l, k, i]`` is the
element of functions j and j + l along u, and i and i + k along v.

Control points are stored transposed, ``(n, width)``: a line for each function along u. A line has the
functions along v between ``p`` zeros on the left and at least as many on the right. Loops run along a line,
so that the compiler can use vector instructions. Functions get the degree as a tuple of p + 1 zeros,
``lags``: its length is known at compile time, and short loops over it are unrolled.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from flexroad.tasks.compiled import compiled
from flexroad.tasks.spline.space import Space
from flexroad.tasks.spline.surface import KEPT, Starts, basis, dense
from flexroad.tasks.types import Floats

Derivatives = tuple[Starts, tuple[Floats, Floats, Floats]]
"""First basis function that is not zero at each cell of one axis, ``(N,)``; the functions from it on, and
their first and second derivatives, ``(N, p + 1)`` each."""
Lags = tuple[float, ...]
VECTOR = 16
"""The length of lines without the zeros at their ends is a multiple of this: no loop has a remainder."""


def line_width(points: int, degree: int) -> int:
    """Return the length of a line of this many control points, with the zeros at its ends."""
    return -(-points // VECTOR) * VECTOR + 2 * degree


def to_lines(z: Floats, degree: int) -> Floats:
    """Return control points ``(m, n)`` as lines, ``(n, width)``."""
    m, n = z.shape
    lines = np.zeros((n, line_width(m, degree)))
    lines[:, degree : degree + m] = z.T
    return lines


def from_lines(lines: Floats, points: int, degree: int) -> Floats:
    """Return lines as control points ``(m, n)``, where m is ``points``."""
    return np.ascontiguousarray(lines[:, degree : degree + points].T)


@compiled(error_model="numpy", fused=True)
def at_cells(
    lines: Floats, start_u: Starts, along_u: Floats, start_v: Starts, along_v: Floats, out: Floats
) -> None:
    """Write the spline with these control points, ``(n, width)``, at the cells to ``out``, ``(H, W)``."""
    p, cols = along_u.shape[1] - 1, out.shape[1]
    at_col = np.zeros((cols, lines.shape[1]))
    for c in range(cols):
        for j in range(p + 1):
            _add_times(along_u[c, j], lines[start_u[c] + j], at_col[c])
    by_col = at_col.T.copy()
    for r in range(len(out)):
        out[r] = 0.0
        for i in range(p + 1):
            _add_times(along_v[r, i], by_col[p + start_v[r] + i], out[r])


@compiled(error_model="numpy", fused=True)
def add_from_cells(
    cells: Floats, start_u: Starts, along_u: Floats, start_v: Starts, along_v: Floats, out: Floats
) -> None:
    """Add the sums of the cells ``(H, W)`` times each basis function to ``out``, ``(n, width)``.

    It is the transpose of `at_cells`.
    """
    p, cols = along_u.shape[1] - 1, cells.shape[1]
    by_col = np.zeros((out.shape[1], cols))
    for r in range(len(cells)):
        for i in range(p + 1):
            _add_times(along_v[r, i], cells[r], by_col[p + start_v[r] + i])
    at_col = by_col.T.copy()
    for c in range(cols):
        for j in range(p + 1):
            _add_times(along_u[c, j], at_col[c], out[start_u[c] + j])


@compiled(error_model="numpy", fused=True)
def gram(
    weight: Floats, start_u: Starts, along_u: Floats, start_v: Starts, along_v: Floats, stencil: Floats
) -> None:
    """Add the weighted products of basis functions, summed over the cells, to a stencil.

    - `weight` ``(H, W)``: weight of each cell.
    - `start_u`, `start_v` ``(W,)``: first basis function at each column and at each row.
    - `along_u`, `along_v` ``(W, p + 1)``: basis functions there, or their derivatives.
    - `stencil` ``(n, p + 1, p + 1, width)``: changed in place.
    """
    rows, cols = weight.shape
    lags = along_v.shape[1]
    width = stencil.shape[3]
    by_col = np.zeros((cols, lags, width))
    sums = np.zeros((lags, lags, cols))
    first = start_v[0]
    for r in range(rows):
        if start_v[r] != first:
            _store(sums, first, by_col)
            first = start_v[r]
        for i in range(lags):
            for k in range(lags - i):
                product = along_v[r, i] * along_v[r, i + k]
                _add_times(product, weight[r], sums[i, k])
    _store(sums, first, by_col)
    for c in range(cols):
        for j in range(lags):
            for l in range(lags - j):  # noqa: E741
                product = along_u[c, j] * along_u[c, j + l]
                _add_times(product, by_col[c].reshape(-1), stencil[start_u[c] + j, l].reshape(-1))


@compiled(error_model="numpy", fused=True)
def _add_times(factor: float, values: Floats, out: Floats) -> None:
    for i in range(len(out)):
        out[i] += factor * values[i]


@compiled(error_model="numpy", fused=True)
def _store(sums: Floats, first: int, by_col: Floats) -> None:
    """Add the sums of the rows in one span to the sums of each column, and set them to 0."""
    lags = sums.shape[0]
    for c in range(sums.shape[2]):
        for k in range(lags):
            for i in range(lags - k):
                by_col[c, k, lags - 1 + first + i] += sums[i, k, c]
    sums[:] = 0.0


@compiled(error_model="numpy", fused=True)
def add_block(block: Floats, line: Floats, sign: float, out: Floats, lags: Lags) -> None:
    """Add ``sign`` times a stencil's part between two lines, ``(p + 1, width)``, times a line to ``out``."""
    # Indices are unsigned: signed indices may count from the end in numba, which prevents vector
    # instructions.
    p = np.uint64(len(lags) - 1)
    for i in range(p, np.uint64(len(line)) - p):
        total = block[np.uint64(0), i] * line[i]
        for k in range(np.uint64(1), np.uint64(len(lags))):
            total += block[k, i] * line[i + k] + block[k, i - k] * line[i - k]
        out[i] += sign * total


@compiled(error_model="numpy", fused=True)
def add_lower(stencil: Floats, x: Floats, j: int, sign: float, out: Floats, lags: Lags) -> None:
    """Add ``sign`` times the contribution of the lines before line j to ``out``."""
    for l in range(1, min(len(lags), j + 1)):  # noqa: E741
        add_block(stencil[j - l, l], x[j - l], sign, out, lags)


@compiled(error_model="numpy", fused=True)
def add_upper(stencil: Floats, x: Floats, j: int, sign: float, out: Floats, lags: Lags) -> None:
    """Add ``sign`` times the contribution of the lines after line j to ``out``."""
    for l in range(1, min(len(lags), len(x) - j)):  # noqa: E741
        add_block(stencil[j, l], x[j + l], sign, out, lags)


@compiled(error_model="numpy", fused=True)
def multiply(stencil: Floats, x: Floats, out: Floats, lags: Lags) -> None:
    """Write the matrix times the control points ``x`` to ``out``, both ``(n, width)``."""
    for j in range(len(x)):
        out[j] = 0.0
        add_block(stencil[j, 0], x[j], 1.0, out[j], lags)
        add_lower(stencil, x, j, 1.0, out[j], lags)
        add_upper(stencil, x, j, 1.0, out[j], lags)


def bending_energy(stiffness: Floats, space: Space) -> Floats:
    """Return the second derivatives of the bending energy by the control heights, as a stencil.

    It is the energy of a thin plate with the surface's shape: ``E = sum over cells of stiffness *
    (z_xx^2 + 2 z_xy^2 + z_yy^2)``. Derivatives are per metre, so that it does not depend on the number of
    control points; it is 0 for planes. For control heights z it is ``z^T S z / 2``, with the gradient
    ``S z``.

    - `stiffness` ``(H, W)``: weight of the squared curvature in each cell (m3).
    - `space`: the splines, of degree 2 at least, with the parameters of the raster's columns and rows.
    """
    start_u, along_u = _derivatives(
        space.knots_u.tobytes(), space.degree[0], space.u.tobytes(), space.unit_m[0]
    )
    start_v, along_v = _derivatives(
        space.knots_v.tobytes(), space.degree[1], space.v.tobytes(), space.unit_m[1]
    )
    n, m = space.points
    lags = space.degree[0] + 1
    stencil = np.zeros((n, lags, lags, line_width(m, lags - 1)))
    for times, by_u, by_v in ((1.0, 2, 0), (2.0, 1, 1), (1.0, 0, 2)):
        gram(2 * times * stiffness, start_u, along_u[by_u], start_v, along_v[by_v], stencil)
    return stencil


@lru_cache(maxsize=KEPT)
def _derivatives(knots_bytes: bytes, degree: int, u_bytes: bytes, unit_m: float) -> Derivatives:
    """Return the basis functions at u and their first and second derivatives per metre.

    They are kept for the next fit and must not be changed. A derivative is a spline of one degree less over
    the knots without the outermost (de Boor, "A practical guide to splines", chapter X).
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
