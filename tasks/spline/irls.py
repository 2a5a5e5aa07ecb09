"""Fit unit weights by iteratively reweighted least squares, in place of Adam.

With unit weights the surface is linear in its control heights and the loss convex. Each step puts a parabola
in the place of every absolute difference, solves the normal equations and goes along the line to their
solution as far as the loss falls (Huber and Ronchetti, "Robust Statistics", section 7.8). The range of
neighbours has edges, where another neighbour becomes the highest: `tasks.spline.smooth_range` rounds them
off, from step to step less.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from flexroad.tasks.spline.normal_equations import band, factor, gram, pairs, solve
from flexroad.tasks.spline.objective import NEIGHBOURS, Objective, range_term
from flexroad.tasks.spline.smooth_range import add_soft_range
from flexroad.tasks.spline.surface import dense
from flexroad.tasks.spline.thin_plate import Plate
from flexroad.tasks.types import Bools, Floats

SHARP_M, FIRST_M = 0.003, 0.03
"""Smaller differences weigh as if they were this large: under L1 in the end, and in the first step."""
SHARP, FIRST = 0.001, 0.1
"""Temperature of the softmax, as part of the range: in the end, and in the first step."""
COOLING = 0.6
"""Both fall by this factor from step to step."""
FARTHEST, NEAR = 3.0, 0.01
"""Longest step, as a multiple of the way to the parabolas' solution, and how closely its length is sought."""


@dataclass(frozen=True, eq=False)
class Convex:
    """What is minimised: the objective with unit weights, its differences counted by Huber, and a plate."""

    objective: Objective
    shape: tuple[int, int]
    """Number of control points along northing and easting, (m, n)."""
    huber_m: float = 0.0
    """Smaller differences d count as ``d^2 / (2 huber_m)``, others as ``|d| - huber_m / 2``; 0 is L1."""
    plate: Plate | None = None

    @cached_property
    def along_v(self) -> Floats:
        """Basis functions at the rows, ``(H, m)``."""
        return dense(self.objective.start_v, self.objective.along_v, self.shape[0])

    @cached_property
    def along_u(self) -> Floats:
        """Basis functions at the columns, ``(W, n)``."""
        return dense(self.objective.start_u, self.objective.along_u.T, self.shape[1])

    @cached_property
    def pairs(self) -> tuple[csr_array, csr_array]:
        """Products of the basis functions that overlap, along v and along u."""
        return pairs(self.along_v, self.lags), pairs(self.along_u, self.lags)

    @cached_property
    def stiff(self) -> Floats | float:
        """Second derivatives of the plate's energy."""
        return self.plate.hessian(self.lags) if self.plate else 0.0

    @property
    def lags(self) -> int:
        """How far apart control points may be that one term joins, and one more; neighbours of a third: 2."""
        return int(max(len(self.objective.along_u), self.objective.along_v.shape[1], 3))

    def __call__(self, z: Floats) -> float:
        """Return the loss (m) at control heights ``(m, n)``."""
        off = self.heights(z) - self.objective.target
        return self.along(z, off, np.zeros_like(z), np.zeros_like(off))(0.0)

    def heights(self, z: Floats) -> Floats:
        """Return the surface above the datum at the cells, ``(H, W)``, m."""
        return self.along_v @ z @ self.along_u.T

    def parabola(self, z: Floats, off: Floats, weight: Floats, softness: float) -> tuple[Floats, Floats]:
        """Return the factored second derivatives and the gradient of what stands for the loss near ``z``."""
        lower = band(gram(weight, *self.pairs, self.lags) + self.stiff)
        slope = self.along_v.T @ (weight * off) @ self.along_u
        if self.plate:
            slope += self.plate(z)[1]
        if self.objective.lambda_reg:
            add_soft_range(z, self.objective.lambda_reg, NEIGHBOURS, softness, slope, lower)
        return factor(lower), slope

    def along(self, z: Floats, off: Floats, way: Floats, change: Floats) -> Callable[[float], float]:
        """Return the loss (m) as a function of how far to go along ``way``, which changes the differences."""
        bent = rise = bends = 0.0
        if self.plate:
            (bent, slope), (bends, _) = self.plate(z), self.plate(way)
            rise = float(np.vdot(slope, way))

        def loss(far: float) -> float:
            total = _differences(off, change, far, self.objective.factor, self.huber_m)
            if self.objective.lambda_reg:
                ahead = z + far * way
                total += range_term(ahead, self.objective.lambda_reg, NEIGHBOURS, np.empty_like(z))
            return float(total + bent + far * (rise + far * bends))

        return loss


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the steps led."""

    z: Floats
    """Control heights, ``(m, n)``, m."""
    losses: list[float]
    """The loss at the start and after each step (m); it never rises."""
    off: Floats
    """Differences of the surface to the targets, ``(H, W)``, m."""
    weight: Floats
    """Weights of the last normal equations, ``(H, W)``, 1/m."""
    factored: Floats
    """Their Cholesky factor."""


def minimise(convex: Convex, start: Floats, iterations: int, tolerance: float) -> Solution:
    """Take steps from ``start`` until the loss falls by no more than ``tolerance`` of it, or ``iterations``.

    Parameters
    ----------
    convex : Convex
    start : ndarray, (m, n)
        Control heights (m); not changed.
    iterations : int
        Most steps, 1 and more.
    tolerance : float
    """
    z, off = start, convex.heights(start) - convex.objective.target
    losses = [convex(start)]
    sharp_m = convex.huber_m or SHARP_M
    for step in range(iterations):
        least, softness = FIRST_M * COOLING**step, FIRST * COOLING**step
        weight = convex.objective.factor / np.maximum(np.abs(off), max(least, sharp_m))
        factored, slope = convex.parabola(z, off, weight, max(softness, SHARP))
        way = solve(factored, -slope)
        change = convex.heights(way)
        loss = convex.along(z, off, way, change)
        found = minimize_scalar(loss, bounds=(0, FARTHEST), method="bounded", options={"xatol": NEAR})
        if found.fun < losses[-1]:
            z, off = z + found.x * way, off + found.x * change
        losses.append(min(float(found.fun), losses[-1]))
        cold = least <= sharp_m and (softness <= SHARP or not convex.objective.lambda_reg)
        if cold and losses[-2] - losses[-1] <= tolerance * losses[-2]:
            break
    return Solution(z, losses, off, weight, factored)


def freedom(convex: Convex, solution: Solution, cells: Bools) -> float:
    """Return the degrees of freedom that the surface spends on some cells: a trace of its hat matrix.

    Estimated from one vector of random signs (Hutchinson 1990), always the same one.
    """
    signs = np.random.default_rng(0).choice([-1.0, 1.0], cells.shape) * cells
    right = convex.along_v.T @ (solution.weight * signs) @ convex.along_u
    return float(np.vdot(signs, convex.heights(solve(solution.factored, right))))


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _differences(off: Floats, change: Floats, far: float, factor: Floats, huber_m: float) -> float:
    """Return the sum over cells of Huber's function of ``off + far * change`` times the factor (m)."""
    sums = np.zeros(off.shape[1])
    # What is within counts by half its part of huber_m; nothing is within under L1.
    inverse = 0.5 / huber_m if huber_m > 0 else 0.0
    for r in range(off.shape[0]):
        for c in range(off.shape[1]):
            difference = abs(off[r, c] + far * change[r, c])
            within = min(difference, huber_m)
            sums[c] += factor[r, c] * (difference - within + inverse * within * within)
    return float(sums.sum())
