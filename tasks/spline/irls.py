"""Minimise a convex loss over unit weights by iteratively reweighted least squares.

With unit weights the surface is linear in its control heights and the loss is convex. Each step replaces
every absolute difference by a quadratic function, solves the normal equations, and searches the line to their
solution for the lowest loss (Huber and Ronchetti, "Robust Statistics", section 7.8).

Under Huber's function, the later steps of a narrow spline with a small tolerance are nearly steps of Newton's
method, see `OUTLIERS`.

The normal equations of wide splines are solved from step to step more precisely
(`tasks.spline.normal_equations`): the error of a step is corrected by the next steps, which are shorter.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexroad.tasks.compiled import compiled
from flexroad.tasks.spline.normal_equations import Multigrid, is_narrow, solve_banded
from flexroad.tasks.spline.objective import Objective
from flexroad.tasks.spline.stencil import (
    add_from_cells,
    at_cells,
    from_lines,
    gram,
    multiply,
    to_lines,
)
from flexroad.tasks.spline.surface import Starts
from flexroad.tasks.types import Bools, Floats

FINAL_M, INITIAL_M = 0.003, 0.03
"""Smaller differences get the weight of this value (m), in the last steps under L1 and in the first step."""
COOLING = 0.6
"""Factor by which that value falls from step to step."""
MAX_STEP, SLOPE_TOLERANCE = 3.0, 1e-4
"""Longest step, as a multiple of the step to the quadratic model's minimum. Largest slope of the loss at its
end, as a share of the slope at its start."""
SETTLED, OUTLIERS = 2, 0.1
"""After this many steps, differences above `huber_m` have this share of their weight in the quadratic model.
Huber's function has no curvature there, so the model is closer to it, and fewer steps are needed."""
PRECISE = 1e-6
"""Largest tolerance with which this is done: with a larger tolerance the steps end before the minimum."""
SHORT = 0.5
"""A step shorter than this multiple of the step to the model's minimum means that the share is too small."""
LOOSE, TIGHT = 5e-4, 1e-5
"""Tolerances of the normal equations (`Multigrid.solve`): of the first step, and the smallest."""
MAX_EVALUATIONS = 40
"""Largest number of evaluations between two points of a line; it takes 0 to 5."""
STEP_TOLERANCE = 1e-6
"""Tolerance of the length of a step, as a multiple of the step to the quadratic model's minimum."""


@dataclass(frozen=True, eq=False)
class HuberObjective:
    """Huber's function of the height differences plus the bending energy, with unit weights."""

    objective: Objective
    """Targets, their factors and the basis, of one degree along both axes; its regulariser is ignored."""
    held: Bools
    """Control points that keep their height, ``(m, n)``: rows along northing."""
    bending: Floats
    """Second derivatives of the bending energy (`tasks.spline.stencil.bending_energy`)."""
    huber_m: float
    """The loss of smaller differences d is ``d^2 / (2 huber_m)``, else ``|d| - huber_m / 2``; 0 is L1."""

    @cached_property
    def multigrid(self) -> Multigrid | None:
        """The solver of the normal equations, with its memory; None for a narrow spline."""
        return None if is_narrow(self.held.shape, self.degree) else Multigrid(self.degree, self.held)

    @property
    def degree(self) -> int:
        """Degree of the basis along both axes."""
        return int(self.objective.along_v.shape[1]) - 1

    @cached_property
    def basis(self) -> tuple[Starts, Floats, Starts, Floats]:
        """First basis functions and their values at the columns, then at the rows."""
        o = self.objective
        return o.start_u, np.ascontiguousarray(o.along_u.T), o.start_v, o.along_v

    def __call__(self, z: Floats) -> float:
        """Return the loss (m) at control heights ``(m, n)``."""
        lines = to_lines(z, self.degree)
        differences = self.heights(lines) - self.objective.target
        total, _ = _along(differences, np.zeros_like(differences), 0.0, self.objective.factor, self.huber_m)
        return float(total + np.vdot(self.bend(lines), lines) / 2)

    def heights(self, lines: Floats) -> Floats:
        """Return the surface above the datum at the cells, ``(H, W)``, m."""
        out = np.empty(self.objective.target.shape)
        at_cells(lines, *self.basis, out)
        return out

    def bend(self, lines: Floats) -> Floats:
        """Return the gradient of the bending energy."""
        out = np.empty_like(lines)
        multiply(self.bending, lines, out, (0.0,) * (self.degree + 1))
        return out

    def model_step(
        self, bend: Floats, residuals: Floats, floor_m: float, share: float, tolerance: float, refresh: bool
    ) -> tuple[Floats, float]:
        """Return the step to the minimum of the quadratic model, as lines, and the loss's slope along it.

        - `bend` ``(n, width)``: gradient of the bending energy.
        - `residuals` ``(H, W)``: surface minus targets (m).
        - `floor_m`: smaller differences get the weight of this difference (m).
        - `share`: share of the weight of larger differences that enters the matrix.
        - `tolerance`, `refresh`: see `Multigrid.solve`.
        """
        weight, pull = np.empty_like(residuals), np.empty_like(residuals)
        _weigh(residuals, self.objective.factor, floor_m, share, weight, pull)
        stencil, slope = self.bending.copy(), bend.copy()
        gram(weight, *self.basis, stencil)
        add_from_cells(pull, *self.basis, slope)
        if self.multigrid:
            step = self.multigrid.solve(stencil, -slope, tolerance, refresh)
        else:
            step = solve_banded(stencil, -slope, self.held)
        return step, float(np.vdot(slope, step))


def minimise(
    loss: HuberObjective, start: Floats, iterations: int, tolerance: float
) -> tuple[Floats, list[float]]:
    """Minimise the loss: stop when a step lowers it by at most ``tolerance`` of it, or after ``iterations``.

    - `start` ``(m, n)``: control heights (m); not changed.
    - `iterations`: largest number of steps, at least 1.
    - `tolerance`: relative decrease of the loss at which to stop.
    - `z` ``(m, n)``: control heights (m).
    - `losses`: the loss at the start and after each step (m); it never rises.
    """
    lines = to_lines(start, loss.degree)
    residuals, bend = loss.heights(lines) - loss.objective.target, loss.bend(lines)
    losses, precision = [loss(start)], LOOSE
    floor_m = loss.huber_m or FINAL_M
    newton = loss.huber_m > 0 and tolerance <= PRECISE and not loss.multigrid
    share, later = 1.0, OUTLIERS if newton else 1.0
    for number in range(iterations):
        least = INITIAL_M * COOLING**number
        share = later if number == SETTLED else share
        step, slope = loss.model_step(bend, residuals, max(least, floor_m), share, precision, number == 0)
        change, step_bend = loss.heights(step), loss.bend(step)
        line = _Line(
            residuals, change, loss.objective.factor, loss.huber_m, float(np.vdot(bend, lines)) / 2,
            float(np.vdot(bend, step)), float(np.vdot(step_bend, step)) / 2,
        )  # fmt: skip
        t, lowest = line.minimum(slope)
        share = 1.0 if t < SHORT else share
        if lowest < losses[-1]:
            lines, residuals, bend = lines + t * step, residuals + t * change, bend + t * step_bend
        losses.append(min(lowest, losses[-1]))
        decrease = losses[-2] - losses[-1]
        if least <= floor_m and decrease <= tolerance * losses[-2]:
            break
        precision = min(LOOSE, max(TIGHT, 0.1 * decrease / losses[-2]))
    return from_lines(lines, len(loss.held), loss.degree), losses


@dataclass(frozen=True, eq=False)
class _Line:
    """The loss along a step: of the differences, and of the bending energy, a parabola in t."""

    residuals: Floats
    change: Floats
    factor: Floats
    huber_m: float
    energy: float
    energy_slope: float
    step_energy: float

    def __call__(self, t: float) -> tuple[float, float]:
        """Return the loss (m) after t times the step, and its derivative by t."""
        total, slope = _along(self.residuals, self.change, t, self.factor, self.huber_m)
        total += self.energy + t * (self.energy_slope + t * self.step_energy)
        return total, slope + self.energy_slope + 2 * t * self.step_energy

    def minimum(self, start_slope: float) -> tuple[float, float]:
        """Return the t of the lowest loss up to `MAX_STEP`, and that loss: the root of the derivative.

        The derivative never falls, so the root stays between two points (Illinois method).
        """
        enough = SLOPE_TOLERANCE * abs(start_slope)
        low, low_slope, t = 0.0, start_slope, 1.0
        value, slope = self(t)
        while slope < -enough and t < MAX_STEP:
            rise = slope - low_slope
            ahead = t - slope * (t - low) / rise if rise > 0 else MAX_STEP
            low, low_slope, t = t, slope, min(ahead, 2 * t, MAX_STEP)
            value, slope = self(t)
        high, high_slope = t, slope
        for _ in range(MAX_EVALUATIONS):
            if abs(slope) <= enough or high_slope <= 0 or high - low <= STEP_TOLERANCE:
                break
            t = low - low_slope * (high - low) / (high_slope - low_slope)
            value, slope = self(t)
            if slope < 0:
                low, low_slope, high_slope = t, slope, high_slope / 2
            else:
                high, high_slope, low_slope = t, slope, low_slope / 2
        return t, value


@compiled(error_model="numpy", fused=True)
def _weigh(
    residuals: Floats, factor: Floats, floor_m: float, share: float, weight: Floats, pull: Floats
) -> None:
    """Write the weights of the quadratic model, and the slope of the loss by each residual."""
    for r in range(residuals.shape[0]):
        for c in range(residuals.shape[1]):
            difference = abs(residuals[r, c])
            whole = factor[r, c] / max(difference, floor_m)
            pull[r, c] = whole * residuals[r, c]
            weight[r, c] = whole if difference <= floor_m else share * whole


@compiled(error_model="numpy", fused=True)
def _along(
    residuals: Floats, change: Floats, t: float, factor: Floats, huber_m: float
) -> tuple[float, float]:
    """Return the sum over cells of Huber's function of ``residuals + t * change`` times the factor (m).

    The second value is its derivative by t.
    """
    total, slope = 0.0, 0.0
    # The part of a difference up to huber_m is squared; under L1 that part is 0.
    inverse = 0.5 / huber_m if huber_m > 0 else 0.0
    steepness = 1 / huber_m if huber_m > 0 else np.inf
    for r in range(residuals.shape[0]):
        row, row_slope = 0.0, 0.0
        for c in range(residuals.shape[1]):
            signed = residuals[r, c] + t * change[r, c]
            difference = abs(signed)
            within = min(difference, huber_m)
            row += factor[r, c] * (difference - within + inverse * within * within)
            pull = max(-1.0, min(1.0, signed * steepness)) if huber_m > 0 else np.sign(signed)
            row_slope += factor[r, c] * pull * change[r, c]
        total += row
        slope += row_slope
    return total, slope
