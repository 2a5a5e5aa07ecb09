"""Minimise a convex loss over unit weights by iteratively reweighted least squares.

With unit weights the surface is linear in its control heights and the loss is convex. Each step replaces
every absolute difference by a quadratic function, solves the normal equations, and searches the line to their
solution for the lowest loss (Huber and Ronchetti, "Robust Statistics", section 7.8).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from flexroad.tasks.compiled import compiled
from flexroad.tasks.spline.normal_equations import band, factor, gram, hold, pairs, solve
from flexroad.tasks.spline.objective import Objective
from flexroad.tasks.spline.surface import dense
from flexroad.tasks.spline.thin_plate import BendingEnergy
from flexroad.tasks.types import Bools, Floats

FINAL_M, INITIAL_M = 0.003, 0.03
"""Smaller differences get the weight of this value (m): in the last steps under L1, and in the first step."""
COOLING = 0.6
"""Factor by which that value falls from step to step."""
MAX_STEP, STEP_TOLERANCE = 3.0, 0.01
"""Longest step, and tolerance of its length, as multiples of the step to the quadratic model's minimum."""


@dataclass(frozen=True, eq=False)
class HuberObjective:
    """Huber's function of the height differences plus the bending energy, with unit weights."""

    objective: Objective
    """Targets, their factors and the basis; its regulariser is ignored."""
    shape: tuple[int, int]
    """Number of control points along northing and easting, (m, n)."""
    huber_m: float = 0.0
    """Smaller differences d count as ``d^2 / (2 huber_m)``, others as ``|d| - huber_m / 2``; 0 is L1."""
    bending: BendingEnergy | None = None
    """Bending energy of the surface; None if the loss has the height differences only."""
    held: Bools | None = None
    """Control points that keep their height, ``(m, n)``; None if all are free."""

    @cached_property
    def along_v(self) -> Floats:
        """Basis functions at the rows, ``(H, m)``."""
        return dense(self.objective.start_v, self.objective.along_v, self.shape[0])

    @cached_property
    def along_u(self) -> Floats:
        """Basis functions at the columns, ``(W, n)``."""
        return dense(self.objective.start_u, self.objective.along_u.T, self.shape[1])

    @cached_property
    def pairs(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """Products of overlapping basis functions, along v and along u."""
        return pairs(self.along_v, self.lags), pairs(self.along_u, self.lags)

    @cached_property
    def stiffness(self) -> Floats | float:
        """Second derivatives of the bending energy, laid out as by `normal_equations.gram`; 0 without it."""
        return self.bending.hessian(self.lags) if self.bending else 0.0

    @property
    def lags(self) -> int:
        """One more than the largest distance of two control points that share a cell."""
        return int(max(len(self.objective.along_u), self.objective.along_v.shape[1]))

    def __call__(self, z: Floats) -> float:
        """Return the loss (m) at control heights ``(m, n)``."""
        residuals = self.heights(z) - self.objective.target
        return self.line_loss(z, residuals, np.zeros_like(z), np.zeros_like(residuals))(0.0)

    def heights(self, z: Floats) -> Floats:
        """Return the surface above the datum at the cells, ``(H, W)``, m."""
        return self.along_v @ z @ self.along_u.T

    def quadratic_model(self, z: Floats, residuals: Floats, weight: Floats) -> tuple[Floats, Floats]:
        """Return the factored second derivatives and the gradient of the quadratic model near ``z``."""
        lower = band(gram(weight, *self.pairs, self.lags) + self.stiffness)
        slope = self.along_v.T @ (weight * residuals) @ self.along_u
        if self.bending:
            slope += self.bending(z)[1]
        if self.held is not None:
            hold(lower, self.held, self.lags)
            slope[self.held] = 0.0
        return factor(lower), slope

    def line_loss(
        self, z: Floats, residuals: Floats, step: Floats, change: Floats
    ) -> Callable[[float], float]:
        """Return the loss (m) at ``z + t * step`` as a function of t.

        Parameters
        ----------
        z, step : ndarray, (m, n)
            Control heights and their change (m).
        residuals, change : ndarray, (H, W)
            Surface minus targets at ``z`` (m), and the change of that by ``step``.
        """
        energy = energy_slope = step_energy = 0.0
        if self.bending:
            (energy, slope), (step_energy, _) = self.bending(z), self.bending(step)
            energy_slope = float(np.vdot(slope, step))

        def loss(t: float) -> float:
            total = _differences(residuals, change, t, self.objective.factor, self.huber_m)
            return float(total + energy + t * (energy_slope + t * step_energy))

        return loss


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of `minimise`."""

    z: Floats
    """Control heights, ``(m, n)``, m."""
    losses: list[float]
    """The loss at the start and after each step (m); it never rises."""


def minimise(loss: HuberObjective, start: Floats, iterations: int, tolerance: float) -> Solution:
    """Minimise the loss: stop when a step lowers it by at most ``tolerance`` of it, or after ``iterations``.

    Parameters
    ----------
    loss : HuberObjective
        The convex loss.
    start : ndarray, (m, n)
        Control heights (m); not changed.
    iterations : int
        Largest number of steps, at least 1.
    tolerance : float
        Relative decrease of the loss at which to stop.
    """
    z, residuals = start, loss.heights(start) - loss.objective.target
    losses = [loss(start)]
    floor_m = loss.huber_m or FINAL_M
    for number in range(iterations):
        least = INITIAL_M * COOLING**number
        weight = loss.objective.factor / np.maximum(np.abs(residuals), max(least, floor_m))
        factored, slope = loss.quadratic_model(z, residuals, weight)
        step = solve(factored, -slope)
        change = loss.heights(step)
        loss_along_step = loss.line_loss(z, residuals, step, change)
        line_minimum = scipy.optimize.minimize_scalar(
            loss_along_step, bounds=(0, MAX_STEP), method="bounded", options={"xatol": STEP_TOLERANCE}
        )
        if line_minimum.fun < losses[-1]:
            z, residuals = z + line_minimum.x * step, residuals + line_minimum.x * change
        losses.append(min(float(line_minimum.fun), losses[-1]))
        if least <= floor_m and losses[-2] - losses[-1] <= tolerance * losses[-2]:
            break
    return Solution(z, losses)


@compiled(error_model="numpy")
def _differences(residuals: Floats, change: Floats, t: float, factor: Floats, huber_m: float) -> float:
    """Return the sum over cells of Huber's function of ``residuals + t * change`` times the factor (m)."""
    sums = np.zeros(residuals.shape[1])
    # The part of a difference up to huber_m is squared; under L1 that part is 0.
    inverse = 0.5 / huber_m if huber_m > 0 else 0.0
    for r in range(residuals.shape[0]):
        for c in range(residuals.shape[1]):
            difference = abs(residuals[r, c] + t * change[r, c])
            within = min(difference, huber_m)
            sums[c] += factor[r, c] * (difference - within + inverse * within * within)
    return float(sums.sum())
