"""Adam within bounds, with early stopping (the paper's "Implementation Details").

Kingma and Ba, "Adam: a method for stochastic optimization", 2015, Algorithm 1, and a projection on the
bounds after each step. torch's Adam and autograd do the same on a GPU, and are the oracle of the gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from flexroad.catalog.lazy import lazy
from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.objective import NEIGHBOURS, Objective
from flexroad.tasks.spline.surface import dense
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import torch
else:
    torch = lazy("torch")

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

    - `objective`: returns the loss and its gradient at the variables.
    - `start`: variables to start from; not changed.
    - `limit`: bound on the variables' absolute values, broadcast against ``start``.
    - `schedule`: learning rate and stopping rule.
    - `variables`: those of the lowest loss, or of the last step with ``schedule.last``.
    - `losses`: the loss at the start and after each step.
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

    - `rate`: learning rate over the share of the mean that is known after so many steps.
    - `known`: the same share of the variance.
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


class TorchObjective:
    """The same loss as `tasks.spline.objective.Objective`, for tensors on one device, in float64.

    Raises
    ------
    TaskError
        If the device is not available.
    """

    def __init__(self, objective: Objective, shape: tuple[int, int], device: str) -> None:
        if device == "cpu":
            # At these sizes two threads are slower than one.
            torch.set_num_threads(1)
        elif (torch.device(device).index or 0) >= (gpus := torch.cuda.device_count()):
            devices = " or ".join(["cpu", *(f"cuda:{i}" for i in range(gpus))])
            raise TaskError(f"no device {device!r} on this machine; set fit.device to {devices}")
        m, n = shape
        self.device = device
        self.basis_u = self.tensor(dense(objective.start_u, objective.along_u.T, n))
        self.basis_v = self.tensor(dense(objective.start_v, objective.along_v, m))
        self.target, self.factor = self.tensor(objective.target), self.tensor(objective.factor)
        self.lambda_reg, self.free_weights = objective.lambda_reg, objective.free_weights

    def tensor(self, array: Floats) -> torch.Tensor:
        """Return the array on the device."""
        return torch.tensor(array, dtype=torch.float64, device=self.device)

    def __call__(self, variables: torch.Tensor) -> torch.Tensor:
        """Return the loss (m) at ``variables``, ``(2, m, n)``: z and rho."""
        z, rho = variables[0], variables[1] if self.free_weights else variables[1].detach()
        w = rho.exp()
        surface = self._spline(w * z) / self._spline(w)
        data = (self.factor * (surface - self.target).abs()).sum()
        return data + self.lambda_reg * self._regulariser(z)

    def _spline(self, coefficients: torch.Tensor) -> torch.Tensor:
        return self.basis_v @ coefficients @ self.basis_u.T

    def _regulariser(self, z: torch.Tensor) -> torch.Tensor:
        rows, cols = z.shape

        def neighbours(outside: float) -> torch.Tensor:
            padded = torch.nn.functional.pad(z, (1, 1, 1, 1), value=outside)
            shifts = [padded[1 + i : 1 + i + rows, 1 + j : 1 + j + cols] for i, j in NEIGHBOURS.tolist()]
            return torch.stack(shifts)

        high, low = neighbours(-torch.inf).max(dim=0).values, neighbours(torch.inf).min(dim=0).values
        return ((high - low) ** 2).mean()


def minimise_with_torch(
    objective: Objective, start: Floats, limit: Floats, schedule: Schedule, device: str
) -> tuple[Floats, list[float]]:
    """Minimise like `minimise`, with torch's Adam and autograd, on ``device``."""
    loss_at = TorchObjective(objective, (start.shape[1], start.shape[2]), device)
    variables = loss_at.tensor(start).requires_grad_()
    bound = loss_at.tensor(np.broadcast_to(limit, start.shape))
    adam: Any = torch.optim.Adam([variables], lr=schedule.rate, betas=(BETA_1, BETA_2), eps=EPSILON)
    best = start
    losses: list[float] = []
    while True:
        adam.zero_grad()
        loss = loss_at(variables)
        if not losses or loss.item() < min(losses):
            best = variables.detach().cpu().numpy().copy()
        losses.append(loss.item())
        if schedule.has_finished(losses):
            return best, losses
        loss.backward()
        adam.step()
        with torch.no_grad():
            variables.clamp_(-bound, bound)
