"""Solve the normal equations of a tensor-product spline.

The border of a tile is a long strip. If its control points are numbered across it, the matrix has few
diagonals beside the main diagonal, and `solve_banded` factorises this band. Other matrices are solved by
`Multigrid`: conjugate gradients with a multigrid cycle.

Where cells have a height, the matrix is well conditioned, and a few Gauss-Seidel sweeps would be enough. In a
void only the bending energy is left: a differential equation of fourth order over many control points, which
sweeps alone solve slowly. So a cycle has coarser splines with every other knot, down to a few control points
(Briggs, Henson and McCormick, "A multigrid tutorial", chapters 3 and 10). One sweep solves the equations of
one line of control points after the other. The cycle is symmetric, down from the first line and back from the
last. Therefore it is a preconditioner for conjugate gradients for all stiffnesses.

A function of the coarser spline is a sum of p + 2 functions of the finer spline: function J is made from the
functions ``2 J - p`` to ``2 J + 1``, if they exist, along both axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.stencil import (
    Lags,
    add_lower,
    add_upper,
    from_lines,
    line_width,
    multiply,
    to_lines,
)
from flexroad.tasks.types import Bools, Floats

WIDEST = 64
"""Largest number of diagonals on one side of the main diagonal: above it, `Multigrid` is faster."""
RIDGE = 1e-9
"""Share of the diagonal's mean that is added to it, so that undetermined control points keep their height."""

COARSEST = 8
"""Splines with at most this many control points along an axis are not made coarser."""
COARSEST_SWEEPS = 4
"""Pairs of sweeps over the coarsest control points, which then are nearly exact."""
MAX_ITERATIONS = 300
"""Largest number of iterations for one system; it takes 3 to 20."""

SMALLEST_M = 2e-5
"""Smallest change of control heights for a further iteration (m)."""

Levels = NDArray[np.int64]
"""For each level: number of lines, their width, and the start of its lines and stencil in the buffers."""


def _undetermined(point: int) -> TaskError:
    """Return the error for a control point, counted from 1, that the equations do not determine."""
    return TaskError(
        f"control point {point} of the surface is undetermined; use fewer control points (a larger "
        "fit.spacing_m), or raise fit.bending_m3"
    )


def is_narrow(shape: tuple[int, ...], degree: int) -> bool:
    """Return whether a spline with this many control points is narrow enough for `solve_banded`."""
    return degree * (min(shape) + 1) <= WIDEST


def solve_banded(stencil: Floats, right: Floats, held: Bools) -> Floats:
    """Return the solution, exact up to rounding; the parameters are as in `Multigrid`."""
    (m, n), p = held.shape, stencil.shape[1] - 1
    free = (~held).astype(np.float64)
    band = np.zeros((m * n, p * (min(m, n) + 1) + 1))
    ridge = RIDGE * float(stencil[:, 0, 0, p : p + m].mean()) + 1e-300
    _to_band(stencil, free, ridge, band)
    # Points are numbered from the south in a strip to the east, and from the west in a strip to the north.
    order: Literal["C", "F"] = "F" if m <= n else "C"
    values = (from_lines(right, m, p) * free).ravel(order)
    factor, failed = scipy.linalg.lapack.dpbtrf(band.T, lower=1, overwrite_ab=1)
    if failed:
        raise _undetermined(failed)
    solution, _ = scipy.linalg.lapack.dpbtrs(factor, values, lower=1)
    return to_lines(solution.reshape((m, n), order=order), p)


@compiled(error_model="numpy")
def _to_band(stencil: Floats, free: Floats, ridge: float, band: Floats) -> None:
    """Write the main diagonal and the diagonals below it, by columns, ``(points, diagonals)``.

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


@dataclass(frozen=True, eq=False)
class Multigrid:
    """Splines over the same ground; each has every other knot of the spline before."""

    degree: int
    held: Bools
    """Control points that keep their height, ``(m, n)``."""

    def solve(self, stencil: Floats, right: Floats, tolerance: float, refresh: bool) -> Floats:
        """Return the solution for one right-hand side, lines ``(n, width)``; 0 at held control points.

        - `stencil` ``(n, p + 1, p + 1, width)``: the matrix.
        - `right` ``(n, width)``: the right-hand side.
        - `tolerance`: stop when an iteration changes no control height by more than this share of the
          largest.
        - `refresh`: whether to compute the coarser matrices, instead of using the coarser matrices of an
          earlier, similar matrix.
        """
        stencils, bands, vectors, free = self._buffers
        stencils[: stencil.size] = stencil.ravel()
        depth = len(self.levels) if refresh else 1
        failed = _prepare(stencils, bands, free, self.levels, depth, self._weights, self._lags, RIDGE)
        if failed:
            raise _undetermined(failed)
        return _conjugate_gradients(
            stencils, bands, vectors, free, self.levels, self._weights, right, tolerance, SMALLEST_M,
            MAX_ITERATIONS, COARSEST_SWEEPS, self._lags,
        )  # fmt: skip

    @cached_property
    def levels(self) -> Levels:
        """The sizes of the splines."""
        (m, n), p = self.held.shape, self.degree
        rows, lines, elements = [], 0, 0
        while True:
            width = line_width(m, p)
            rows.append((n, width, lines, elements))
            lines, elements = lines + n * width, elements + n * width * (p + 1) ** 2
            coarse = (m + p - 1) // 2 + 1, (n + p - 1) // 2 + 1
            if min(m, n) <= COARSEST or coarse == (m, n):
                return np.array(rows, dtype=np.int64)
            m, n = coarse

    @cached_property
    def _lags(self) -> Lags:
        return (0.0,) * (self.degree + 1)

    @cached_property
    def _weights(self) -> Floats:
        """Factors of a function of the coarser spline in functions of the finer spline."""
        p = self.degree
        return np.array([comb(p + 1, k) / 2.0**p for k in range(p + 2)])

    @cached_property
    def _buffers(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Stencils and factors of all levels, vectors, and 1 at free control points, one after another."""
        p, (n, width, lines, elements) = self.degree, self.levels[-1]
        size = lines + n * width
        free = np.zeros(size)
        fine = (~self.held).astype(float)
        for count, wide, first, _ in self.levels:
            free[first : first + count * wide] = to_lines(fine, p).ravel()
            fine = self._coarse_free(fine)
        stencils = np.zeros(elements + n * width * (p + 1) ** 2)
        return stencils, np.zeros((size, p + 1)), np.zeros((4, size)), free

    def _coarse_free(self, fine: Floats) -> Floats:
        """Return 1 for functions of the coarser spline made only of free functions, else 0."""
        p = self.degree
        for axis in (0, 1):
            free = np.moveaxis(fine, axis, 0)
            padded = np.ones((len(free) + 3 * p + 4, free.shape[1]))
            padded[p : p + len(free)] = free
            count = (len(free) + p - 1) // 2 + 1
            coarse = np.min([padded[k : k + 2 * count : 2] for k in range(p + 2)], axis=0)
            fine = np.moveaxis(coarse, 0, axis)
        return fine


@compiled(error_model="numpy", fused=True)
def _stencil_of(stencils: Floats, levels: Levels, level: int, lags: Lags) -> Floats:
    n, width, _, start = levels[level]
    size = n * width * len(lags) * len(lags)
    return stencils[start : start + size].reshape((n, len(lags), len(lags), width))


@compiled(error_model="numpy", fused=True)
def _lines_of(vector: Floats, levels: Levels, level: int) -> Floats:
    n, width, start, _ = levels[level]
    return vector[start : start + n * width].reshape((n, width))


@compiled(error_model="numpy", fused=True)
def _band_of(bands: Floats, levels: Levels, level: int, lags: Lags) -> Floats:
    n, width, start, _ = levels[level]
    return bands[start : start + n * width].reshape((n, width, len(lags)))


@compiled(error_model="numpy", fused=True)
def _prepare(
    stencils: Floats, bands: Floats, free: Floats, levels: Levels, depth: int, weights: Floats, lags: Lags,
    ridge: float,
) -> int:  # fmt: skip
    """Compute the matrices and factors of the first levels; return the number of an undetermined point."""
    p = len(lags) - 1
    for level in range(depth):
        stencil, is_free = _stencil_of(stencils, levels, level, lags), _lines_of(free, levels, level)
        if level == 0:
            n, width = levels[0, 0], levels[0, 1]
            mean = stencil[:, 0, 0].sum() / (n * (width - 2 * p))
            added = ridge * mean + 1e-300
            for j in range(n):
                for i in range(p, width - p):
                    stencil[j, 0, 0, i] += added
        else:
            coarsen(_stencil_of(stencils, levels, level - 1, lags), weights, stencil, lags)
        failed = _factor(stencil, is_free, _band_of(bands, levels, level, lags), lags)
        if failed:
            return failed
    return 0


@compiled(error_model="numpy", fused=True)
def _factor(stencil: Floats, free: Floats, band: Floats, lags: Lags) -> int:
    """Write the Cholesky factors of the equations of each line, ``(n, width, p + 1)``, to ``band``.

    Element 0 is the inverse of the squared diagonal. The other elements belong to a factor with a unit
    diagonal. Held points have the equation 0 = 0. The result is the number of a point with a pivot of at most
    0, or 0.
    """
    p = len(lags) - 1
    n, width = free.shape
    pivots = np.ones(width)
    for j in range(n):
        for i in range(p, width - p):
            for k in range(len(lags) - 1, -1, -1):
                total = stencil[j, 0, k, i - k] * free[j, i - k]
                for s in range(k + 1, len(lags)):
                    total -= band[j, i, s] * band[j, i - k, s - k] * pivots[i - s]
                if k:
                    band[j, i, k] = free[j, i] * total * band[j, i - k, 0]
                elif free[j, i] == 0.0:
                    pivots[i], band[j, i, 0] = 1.0, 1.0
                elif total > 0.0:
                    pivots[i], band[j, i, 0] = total, 1.0 / total
                else:
                    return int(j * (width - 2 * p) + i - p + 1)
    return 0


@compiled(error_model="numpy", fused=True)
def _solve_line(band: Floats, free: Floats, right: Floats, out: Floats, lags: Lags) -> None:
    """Write the solution of one line's equations to ``out``; ``right`` is overwritten."""
    p, width = len(lags) - 1, len(out)
    # The last solutions are a tuple, which stays in registers, because each point waits for the point before.
    last = lags[1:]
    for i in range(p, width - p):
        total = right[i] * free[i]
        for k in range(p, 0, -1):
            total -= band[i, k] * last[k - 1]
        last = (total,) + last[:-1]  # noqa: RUF005 - numba has no starred tuples
        out[i] = total
    for i in range(p, width - p):
        out[i] *= band[i, 0]
    last = lags[1:]
    for i in range(width - p - 1, p - 1, -1):
        total = out[i]
        for k in range(p, 0, -1):
            total -= band[i + k, k] * last[k - 1]
        last = (total,) + last[:-1]  # noqa: RUF005 - numba has no starred tuples
        out[i] = total


@compiled(error_model="numpy", fused=True)
def _sweep_down(
    stencil: Floats, band: Floats, free: Floats, right: Floats, x: Floats, whole: bool, lags: Lags
) -> None:
    """Solve one line after the other from the first; ``whole`` is False if ``x`` is 0 at the start."""
    work = np.zeros(x.shape[1])
    for j in range(len(x)):
        for i in range(len(work)):
            work[i] = right[j, i]
        add_lower(stencil, x, j, -1.0, work, lags)
        if whole:
            add_upper(stencil, x, j, -1.0, work, lags)
        _solve_line(band[j], free[j], work, x[j], lags)


@compiled(error_model="numpy", fused=True)
def _sweep_up(stencil: Floats, band: Floats, free: Floats, right: Floats, x: Floats, lags: Lags) -> None:
    """Solve one line after the other from the last."""
    work = np.zeros(x.shape[1])
    for j in range(len(x) - 1, -1, -1):
        for i in range(len(work)):
            work[i] = right[j, i]
        add_lower(stencil, x, j, -1.0, work, lags)
        add_upper(stencil, x, j, -1.0, work, lags)
        _solve_line(band[j], free[j], work, x[j], lags)


@compiled(error_model="numpy", fused=True)
def _cycle(
    stencils: Floats, bands: Floats, right: Floats, x: Floats, work: Floats, free: Floats, levels: Levels,
    weights: Floats, coarsest_sweeps: int, lags: Lags,
) -> None:  # fmt: skip
    """Write an approximate solution for the right-hand side ``right`` to ``x``; buffers of all levels."""
    last = len(levels) - 1
    for level in range(last + 1):
        stencil, band = _stencil_of(stencils, levels, level, lags), _band_of(bands, levels, level, lags)
        is_free, b = _lines_of(free, levels, level), _lines_of(right, levels, level)
        y, r = _lines_of(x, levels, level), _lines_of(work, levels, level)
        y[:] = 0.0
        _sweep_down(stencil, band, is_free, b, y, False, lags)
        if level < last:
            # After the sweep, the residual has only the contributions of later lines.
            for j in range(len(y)):
                r[j] = 0.0
                add_upper(stencil, y, j, -1.0, r[j], lags)
                for i in range(r.shape[1]):
                    r[j, i] *= is_free[j, i]
            restrict(
                r, weights, _lines_of(free, levels, level + 1), _lines_of(right, levels, level + 1), lags
            )
        else:
            for _ in range(coarsest_sweeps - 1):
                _sweep_up(stencil, band, is_free, b, y, lags)
                _sweep_down(stencil, band, is_free, b, y, True, lags)
    for level in range(last, -1, -1):
        stencil, band = _stencil_of(stencils, levels, level, lags), _band_of(bands, levels, level, lags)
        is_free, b = _lines_of(free, levels, level), _lines_of(right, levels, level)
        y = _lines_of(x, levels, level)
        if level < last:
            add_coarse(_lines_of(x, levels, level + 1), weights, is_free, y, lags)
        _sweep_up(stencil, band, is_free, b, y, lags)


@compiled(error_model="numpy", fused=True)
def _product(a: Floats, b: Floats, out: Floats) -> None:
    for j in range(a.shape[0]):
        for i in range(a.shape[1]):
            out[j, i] = a[j, i] * b[j, i]


@compiled(error_model="numpy", fused=True)
def _dot(a: Floats, b: Floats) -> float:
    total = 0.0
    for j in range(a.shape[0]):
        part = 0.0
        for i in range(a.shape[1]):
            part += a[j, i] * b[j, i]
        total += part
    return total


@compiled(error_model="numpy", fused=True)
def _conjugate_gradients(
    stencils: Floats, bands: Floats, vectors: Floats, free: Floats, levels: Levels, weights: Floats,
    right: Floats, tolerance: float, smallest: float, iterations: int, coarsest_sweeps: int, lags: Lags,
) -> Floats:  # fmt: skip
    """Return the solution, lines ``(n, width)`` (Golub and Van Loan, "Matrix computations", section 11.5)."""
    stencil, is_free = _stencil_of(stencils, levels, 0, lags), _lines_of(free, levels, 0)
    residual, z = _lines_of(vectors[0], levels, 0), _lines_of(vectors[1], levels, 0)
    solution, direction = np.zeros_like(right), np.zeros_like(right)
    image = np.zeros_like(right)
    _product(right, is_free, residual)
    before = 0.0
    for number in range(iterations):
        _cycle(
            stencils, bands, vectors[0], vectors[1], vectors[2], free, levels, weights, coarsest_sweeps, lags
        )
        now = _dot(residual, z)
        if not now > 0.0:
            break
        turn = now / before if number else 0.0
        for j in range(len(z)):
            for i in range(z.shape[1]):
                direction[j, i] = z[j, i] + turn * direction[j, i]
        multiply(stencil, direction, image, lags)
        bend = _dot(direction, image)
        if not bend > 0.0:
            break
        length, before, change, size = now / bend, now, 0.0, 0.0
        for j in range(len(z)):
            for i in range(z.shape[1]):
                solution[j, i] += length * direction[j, i]
                residual[j, i] -= length * image[j, i] * is_free[j, i]
                change = max(change, abs(length * direction[j, i]))
                size = max(size, abs(solution[j, i]))
        if change <= max(tolerance * size, smallest):
            break
    return solution


@compiled(error_model="numpy", fused=True)
def coarsen(fine: Floats, weights: Floats, coarse: Floats, lags: Lags) -> None:
    """Write the matrix of the coarser spline, whose functions are sums of finer functions, to ``coarse``."""
    p = len(lags) - 1
    n, width = fine.shape[0], fine.shape[3]
    half = np.zeros((len(lags), width))
    for J in range(coarse.shape[0]):
        for L in range(min(len(lags), coarse.shape[0] - J)):
            half[:] = 0.0
            for a in range(p + 2):
                for b in range(p + 2):
                    f, g = 2 * J - p + a, 2 * (J + L) - p + b
                    low, apart = min(f, g), abs(f - g)
                    if low >= 0 and low + apart < n and apart <= p:
                        weight = weights[a] * weights[b]
                        for k in range(len(lags)):
                            for i in range(width):
                                half[k, i] += weight * fine[low, apart, k, i]
            _coarsen_lines(half, weights, coarse[J, L], lags)


@compiled(error_model="numpy", fused=True)
def _coarsen_lines(half: Floats, weights: Floats, coarse: Floats, lags: Lags) -> None:
    p = len(lags) - 1
    end = half.shape[1] - p
    coarse[:] = 0.0
    for K in range(len(lags)):
        for a in range(p + 2):
            for b in range(max(0, a - 2 * K - p), min(p + 2, a - 2 * K + p + 1)):
                weight = weights[a] * weights[b]
                ahead = 2 * K + b - a
                apart = abs(ahead)
                # Function i of a line is at i + p; the zeros at its ends replace functions beyond the ends.
                for at in range(p, coarse.shape[1] - p):
                    low = 2 * (at - p) + a + min(ahead, 0)
                    if low >= p and low + apart < end:
                        coarse[K, at] += weight * half[apart, low]


@compiled(error_model="numpy", fused=True)
def restrict(fine: Floats, weights: Floats, free: Floats, coarse: Floats, lags: Lags) -> None:
    """Write the sums of ``fine`` over the functions of the coarser spline to ``coarse``."""
    p = len(lags) - 1
    n, width = fine.shape
    # The line is longer by 1, as the last function of the coarser line may reach beyond the finer line.
    line = np.zeros(width + 1)
    for J in range(len(coarse)):
        line[:] = 0.0
        for a in range(p + 2):
            f = 2 * J - p + a
            if 0 <= f < n:
                for i in range(width):
                    line[i] += weights[a] * fine[f, i]
        for at in range(p, coarse.shape[1] - p):
            total = 0.0
            if free[J, at] != 0.0:
                for a in range(p + 2):
                    total += weights[a] * line[2 * (at - p) + a]
            coarse[J, at] = total


@compiled(error_model="numpy", fused=True)
def add_coarse(coarse: Floats, weights: Floats, free: Floats, fine: Floats, lags: Lags) -> None:
    """Add the coarser spline ``coarse`` to ``fine``."""
    p = len(lags) - 1
    n, width = fine.shape
    # The functions of the coarser line may reach beyond the end of the finer line.
    line = np.zeros(2 * coarse.shape[1] + p + 2)
    for J in range(len(coarse)):
        line[:] = 0.0
        for at in range(p, coarse.shape[1] - p):
            for a in range(p + 2):
                line[2 * (at - p) + a] += weights[a] * coarse[J, at]
        for a in range(p + 2):
            f = 2 * J - p + a
            if 0 <= f < n:
                for i in range(p, width - p):
                    fine[f, i] += weights[a] * line[i] * free[f, i]
