"""Adam within bounds, and when it may stop early (the paper's "Implementation Details").

Kingma and Ba, "Adam: a method for stochastic optimization", 2015, Algorithm 1, and a projection on the
bounds after each step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tasks.types import Floats

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class Schedule:
    """How far to go."""

    rate: float
    """Learning rate, in units of the variables."""
    iterations: int
    """Most steps."""
    tolerance: float
    """Stop when the loss changed by less than this part of it ..."""
    window: int
    """... over so many steps."""

    def has_settled(self, losses: Sequence[float]) -> bool:
        """Tell whether the loss, one value per step so far, has stopped changing."""
        if len(losses) <= self.window:
            return False
        before, now = losses[-1 - self.window], losses[-1]
        return abs(before - now) <= self.tolerance * before


def minimise(
    objective: Callable[[Floats], tuple[float, Floats]], start: Floats, limit: Floats, schedule: Schedule
) -> tuple[Floats, list[float]]:
    """Take Adam steps from ``start``.

    Parameters
    ----------
    objective : callable
        Returns the loss and its gradient at the variables.
    start : ndarray
        Variables to start from; not changed.
    limit : ndarray
        Bound on the variables' absolute values, broadcast against ``start``.
    schedule : Schedule

    Returns
    -------
    variables : ndarray
        Where the last step led.
    losses : list of float
        The loss before each step.
    """
    variables = start.copy()
    mean, variance = np.zeros_like(start), np.zeros_like(start)
    losses: list[float] = []
    for step in range(1, schedule.iterations + 1):
        loss, gradient = objective(variables)
        losses.append(loss)
        if schedule.has_settled(losses):
            break
        mean += (1 - BETA_1) * (gradient - mean)
        variance += (1 - BETA_2) * (gradient**2 - variance)
        spread = np.sqrt(variance / (1 - BETA_2**step)) + EPSILON
        variables -= schedule.rate / (1 - BETA_1**step) * mean / spread
        np.clip(variables, -limit, limit, out=variables)
    return variables, losses
