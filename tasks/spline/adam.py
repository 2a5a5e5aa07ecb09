"""Adam within bounds, with early stopping (the paper's "Implementation Details").

Kingma and Ba, "Adam: a method for stochastic optimization", 2015, Algorithm 1, and a projection on the
bounds after each step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class Schedule:
    """Step size, largest number of steps, and rule for early stopping."""

    rate: float
    """Learning rate, in units of the variables."""
    iterations: int
    """Largest number of steps."""
    tolerance: float
    """Stop when the loss changed by at most this share of it over ``window`` steps."""
    window: int
    """Number of steps over which the change of the loss is taken."""
    last: bool = False
    """Whether the result is the last step, whatever its loss; else it is the one with the lowest loss."""

    def has_finished(self, losses: Sequence[float]) -> bool:
        """Return whether to stop, from the losses at the start and after each step so far."""
        steps = len(losses) - 1
        if steps >= self.iterations or steps < self.window:
            return steps >= self.iterations
        before, now = losses[steps - self.window], losses[steps]
        return abs(before - now) <= self.tolerance * before


def minimise(
    objective: Callable[[Floats], tuple[float, Floats]], start: Floats, limit: Floats, schedule: Schedule
) -> tuple[Floats, list[float]]:
    """Take Adam steps from ``start`` and return the variables with the lowest loss of all steps, or the last.

    The length of a step does not fall with the gradient, so the last step need not be the best: from a start
    that fits exactly, every step raises the loss.

    Parameters
    ----------
    objective : callable
        Returns the loss and its gradient at the variables.
    start : ndarray
        Variables to start from; not changed.
    limit : ndarray
        Bound on the variables' absolute values, broadcast against ``start``.
    schedule : Schedule
        Learning rate and stopping rule.

    Returns
    -------
    variables : ndarray
        Those of the lowest loss, or of the last step with ``schedule.last``.
    losses : list of float
        The loss at the start and after each step.
    """
    variables = best = start.copy()
    mean, variance = np.zeros(start.size), np.zeros(start.size)
    limits = np.broadcast_to(limit, start.shape).ravel()
    losses: list[float] = []
    lowest = math.inf
    while True:
        loss, gradient = objective(variables)
        if loss < lowest or not losses:
            lowest, best = loss, variables.copy()
        losses.append(loss)
        if schedule.has_finished(losses):
            return (variables if schedule.last else best), losses
        step = len(losses)
        _step(
            variables.reshape(-1), gradient.ravel(), mean, variance, limits,
            schedule.rate / (1 - BETA_1**step), 1 - BETA_2**step,
        )  # fmt: skip


@compiled(error_model="numpy")
def _step(
    variables: Floats, gradient: Floats, mean: Floats, variance: Floats, limit: Floats, rate: float,
    known: float,
) -> None:  # fmt: skip
    """Take one step in place, all arrays ``(n,)``.

    Parameters
    ----------
    rate : float
        Learning rate over the share of the mean that is known after so many steps.
    known : float
        The same share of the variance.
    """
    for i in range(variables.size):
        mean[i] += (1 - BETA_1) * (gradient[i] - mean[i])
        variance[i] += (1 - BETA_2) * (gradient[i] ** 2 - variance[i])
        spread = math.sqrt(variance[i] / known) + EPSILON
        variables[i] -= rate * mean[i] / spread
        if variables[i] > limit[i]:
            variables[i] = limit[i]
        elif variables[i] < -limit[i]:
            variables[i] = -limit[i]
