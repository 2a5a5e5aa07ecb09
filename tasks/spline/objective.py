"""The loss of the NURBS fit and its gradient (the paper's section "Surface Fitting").

``L = L_road + lambda_terrain * L_terrain + lambda_reg * L_reg`` (Eqs. loss_terrain, loss_ctrl). The data
terms add up absolute height differences, to the DSM on filtered road cells and to the DTM elsewhere; both
divide by the number of cells that have a height. ``L_reg`` is the mean over control points of the squared
range (max - min) of their 8 neighbours' heights. Variables are the control heights z (m above the datum)
and ``rho = ln w``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.spline.space import Space
from flexroad.tasks.spline.surface import Starts, kept_basis
from flexroad.tasks.types import Floats

NEIGHBOURS = np.array([(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])


@dataclass(frozen=True, eq=False)
class Objective:
    """Targets, their factors and the basis at the raster's cell centres; constant during the fit."""

    target: Floats
    """Target height of each cell above the datum, ``(H, W)``, m; 0 where the factor is 0."""
    factor: Floats
    """Loss per metre of difference, ``(H, W)``: 1 / cells on the road, lambda_terrain / cells elsewhere."""
    start_u: Starts
    """First basis function at each column, ``(W,)``."""
    along_u: Floats
    """Basis functions at the columns, ``(p + 1, W)``."""
    start_v: Starts
    """First basis function at each row, ``(H,)``; decreasing, because row 0 is in the north."""
    along_v: Floats
    """Basis functions at the rows, ``(H, q + 1)``."""
    lambda_reg: float
    """Weight of the regulariser (1/m)."""
    free_weights: bool
    """Whether rho is a variable; if not, its gradient is 0."""

    def __call__(self, variables: Floats) -> tuple[float, Floats]:
        """Return the loss (m) and its gradient at ``variables``, ``(2, m, n)``: z and rho."""
        gradient = np.zeros(variables.shape)
        z, w = variables[0], np.exp(variables[1])
        loss, by_a, by_w = self._data_terms(z, w)
        # A = e^rho z and W = e^rho.
        gradient[0] = by_a * w
        if self.free_weights:
            gradient[1] = by_a * (w * z) + by_w * w
        return loss + range_term(z, self.lambda_reg, NEIGHBOURS, gradient[0]), gradient

    def by_weight(self, z: Floats, w: Floats) -> tuple[float, Floats, Floats]:
        """Return the loss (m) and its gradient by the heights z and by the weights w, ``(m, n)`` each."""
        loss, by_a, by_w = self._data_terms(z, w)
        by_z = by_a * w
        return loss + range_term(z, self.lambda_reg, NEIGHBOURS, by_z), by_z, by_a * z + by_w

    def _data_terms(self, z: Floats, w: Floats) -> tuple[float, Floats, Floats]:
        """Return the road and terrain terms (m) and their gradient by A = w z and by W = w."""
        by_a, by_w = np.zeros(z.shape), np.zeros(z.shape)
        loss = _data_terms(
            w * z, w, self.target, self.factor,
            self.start_u, self.along_u, self.start_v, self.along_v,
            tuple(range(self.along_v.shape[1])), by_a, by_w,
        )  # fmt: skip
        return loss, by_a, by_w


def objective(
    heights: Floats,
    factor: Floats,
    space: Space,
    lambda_reg: float = 0.0,
    free_weights: bool = False,
) -> Objective:
    """Prepare the objective for a raster.

    - `heights` ``(H, W)``: heights above the datum (m); NaN cells are ignored.
    - `factor` ``(H, W)``: loss per metre of difference in each cell, before the division by the number of
      cells.
    - `space`: the splines, with the parameters of the raster's columns and rows.
    - `lambda_reg`: weight of the regulariser (1/m).
    - `free_weights`: whether the weights are variables.
    """
    valid = np.isfinite(heights)
    start_u, along_u = kept_basis(space.knots_u.tobytes(), space.degree[0], space.u.tobytes())
    start_v, along_v = kept_basis(space.knots_v.tobytes(), space.degree[1], space.v.tobytes())
    return Objective(
        target=np.where(valid, heights, 0.0),
        factor=np.where(valid, factor, 0.0) / np.count_nonzero(valid),
        start_u=start_u,
        along_u=np.ascontiguousarray(along_u.T),
        start_v=start_v,
        along_v=along_v,
        lambda_reg=lambda_reg,
        free_weights=free_weights,
    )


@compiled(error_model="numpy")
def _data_terms(
    a: Floats, w: Floats, target: Floats, factor: Floats, start_u: Starts, along_u: Floats,
    start_v: Starts, along_v: Floats, taps: tuple[int, ...], by_a: Floats, by_w: Floats,
) -> float:  # fmt: skip
    """Return the road and terrain terms and add their gradient by A and W to ``by_a`` and ``by_w``.

    The sums are separable: along u once per control row, then along v once per cell. The gradient is computed
    in the reverse order. Inner loops run over consecutive numbers, so that the compiler can use vector
    instructions. ``taps`` are the indices of the functions along v: the compiler then knows their number.
    """
    rows, cols = target.shape
    a_u, w_u = _along_u(a, start_u, along_u), _along_u(w, start_u, along_u)
    by_a_u, by_w_u = np.zeros_like(a_u), np.zeros_like(w_u)
    losses, num, den = np.zeros(cols), np.empty(cols), np.empty(cols)
    for r in range(rows):
        first = start_v[r]
        for c in range(cols):
            numerator = denominator = 0.0
            for i in taps:
                numerator += along_v[r, i] * a_u[first + i, c]
                denominator += along_v[r, i] * w_u[first + i, c]
            num[c], den[c] = numerator, denominator
        for c in range(cols):
            height = num[c] / den[c]
            difference = height - target[r, c]
            losses[c] += factor[r, c] * abs(difference)
            # d|x|/dx is the sign of x, 0 at 0; then dS/dA = N / W and dS/dW = -S N / W.
            sign = 1.0 if difference > 0 else (-1.0 if difference < 0 else 0.0)
            pull = factor[r, c] * sign / den[c]
            num[c] = pull
            den[c] = -pull * height
        for i in range(along_v.shape[1]):
            b = along_v[r, i]
            for c in range(cols):
                by_a_u[first + i, c] += b * num[c]
                by_w_u[first + i, c] += b * den[c]
    by_a += _back_along_u(by_a_u, start_u, along_u, by_a.shape[1])
    by_w += _back_along_u(by_w_u, start_u, along_u, by_w.shape[1])
    return float(losses.sum())


@compiled()
def _along_u(coefficients: Floats, start_u: Starts, along_u: Floats) -> Floats:
    """Return the sums along u in each column, for all control rows, ``(m, W)``."""
    columns = np.ascontiguousarray(coefficients.T)
    out = np.zeros((start_u.size, columns.shape[1]))
    for c in range(start_u.size):
        for j in range(along_u.shape[0]):
            k, b = start_u[c] + j, along_u[j, c]
            for i in range(columns.shape[1]):
                out[c, i] += b * columns[k, i]
    return np.ascontiguousarray(out.T)


@compiled()
def _back_along_u(gradient: Floats, start_u: Starts, along_u: Floats, points: int) -> Floats:
    """Return the gradient by the coefficients of `_along_u`, ``(m, points)``, from the gradient by sums."""
    columns = np.ascontiguousarray(gradient.T)
    out = np.zeros((points, columns.shape[1]))
    for c in range(start_u.size):
        for j in range(along_u.shape[0]):
            k, b = start_u[c] + j, along_u[j, c]
            for i in range(columns.shape[1]):
                out[k, i] += b * columns[c, i]
    return np.ascontiguousarray(out.T)


@compiled()
def range_term(z: Floats, lambda_reg: float, neighbours: NDArray[np.int64], by_z: Floats) -> float:
    """Return the regulariser (Eq. loss_ctrl) and add its gradient to ``by_z``.

    The range of ``P_ij - P_l`` over l is the range of the neighbours' heights: P_ij itself cancels.
    """
    rows, cols = z.shape
    factor = lambda_reg / z.size
    total = 0.0
    for i in range(rows):
        for j in range(cols):
            high, low = -np.inf, np.inf
            high_i = high_j = low_i = low_j = 0
            for k in range(8):
                a, b = i + neighbours[k, 0], j + neighbours[k, 1]
                if 0 <= a < rows and 0 <= b < cols:
                    if z[a, b] > high:
                        high, high_i, high_j = z[a, b], a, b
                    if z[a, b] < low:
                        low, low_i, low_j = z[a, b], a, b
            total += (high - low) ** 2
            by_z[high_i, high_j] += 2 * factor * (high - low)
            by_z[low_i, low_j] -= 2 * factor * (high - low)
    return factor * total
