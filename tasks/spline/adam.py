"""Adam within bounds, with early stopping (the paper's "Implementation Details").

Kingma and Ba, "Adam: a method for stochastic optimization", 2015, Algorithm 1, and a projection on the bounds
after each step. torch's Adam and autograd do the same on a GPU, and tests check the gradient with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
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


STOP_TOLERANCE, STOP_WINDOW = 1e-4, 20
"""The fit stops early if the loss changes by at most this share over this number of steps."""


def _has_finished(losses: Sequence[float], iterations: int) -> bool:
    """Return whether to stop, from the losses at the start and after each previous step."""
    steps = len(losses) - 1
    if steps >= iterations or steps < STOP_WINDOW:
        return steps >= iterations
    before, now = losses[steps - STOP_WINDOW], losses[steps]
    return abs(before - now) <= STOP_TOLERANCE * before


def minimise(
    objective: Callable[[Floats], tuple[float, Floats]], start: Floats, limit: Floats, rate: float,
    iterations: int, last: bool = False,
) -> tuple[Floats, list[float]]:  # fmt: skip
    """Take Adam steps from ``start``; return the variables of the step with the lowest loss, or of the last.

    The length of a step does not fall with the gradient, so the last step may not be the best: from a start
    that fits exactly, every step raises the loss.

    - `objective`: returns the loss and its gradient at the variables.
    - `start`: variables to start from; not changed.
    - `limit`: bound on the variables' absolute values, broadcast against ``start``.
    - `rate`: learning rate, in units of the variables.
    - `iterations`: largest number of steps.
    - `last`: whether the result is the last step, whatever its loss.
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
        if _has_finished(losses, iterations):
            return (variables if last else best), losses
        step = len(losses)
        _step(
            variables.reshape(-1), gradient.ravel(), mean, variance, limits,
            rate / (1 - BETA_1**step), 1 - BETA_2**step,
        )  # fmt: skip


@compiled(error_model="numpy")
def _step(
    variables: Floats, gradient: Floats, mean: Floats, variance: Floats, limit: Floats, rate: float,
    known: float,
) -> None:  # fmt: skip
    """Take one step in place, all arrays ``(n,)``.

    - `rate`: learning rate, divided by Adam's bias correction of the mean.
    - `known`: Adam's bias correction of the variance.
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


def torch_loss(
    objective: Objective, shape: tuple[int, int], device: str
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a function: z and rho, float64 tensors ``(2, m, n)`` on a device, to the same loss (m)."""
    m, n = shape
    basis_u = _tensor(dense(objective.start_u, objective.along_u.T, n), device)
    basis_v = _tensor(dense(objective.start_v, objective.along_v, m), device)
    target, factor = _tensor(objective.target, device), _tensor(objective.factor, device)

    def loss(variables: torch.Tensor) -> torch.Tensor:
        z, rho = variables[0], variables[1] if objective.free_weights else variables[1].detach()
        w = rho.exp()
        surface = (basis_v @ (w * z) @ basis_u.T) / (basis_v @ w @ basis_u.T)
        return (factor * (surface - target).abs()).sum() + objective.lambda_reg * _range_term(z)

    return loss


def _tensor(array: Floats, device: str) -> torch.Tensor:
    return torch.tensor(array, dtype=torch.float64, device=device)


def _range_term(z: torch.Tensor) -> torch.Tensor:
    """Return the regulariser divided by ``lambda_reg``, as `tasks.spline.objective.range_term`."""
    rows, cols = z.shape

    def neighbours(outside: float) -> torch.Tensor:
        padded = torch.nn.functional.pad(z, (1, 1, 1, 1), value=outside)
        shifts = [padded[1 + i : 1 + i + rows, 1 + j : 1 + j + cols] for i, j in NEIGHBOURS.tolist()]
        return torch.stack(shifts)

    high, low = neighbours(-torch.inf).max(dim=0).values, neighbours(torch.inf).min(dim=0).values
    return ((high - low) ** 2).mean()


def minimise_with_torch(
    objective: Objective, start: Floats, limit: Floats, rate: float, iterations: int, device: str
) -> tuple[Floats, list[float]]:
    """Minimise like `minimise`, with torch's Adam and autograd, on ``device`` if that is available."""
    if device == "cpu":
        # At these sizes two threads are slower than one.
        torch.set_num_threads(1)
    elif (torch.device(device).index or 0) >= (gpus := torch.cuda.device_count()):
        devices = " or ".join(["cpu", *(f"cuda:{i}" for i in range(gpus))])
        raise TaskError(f"no device {device!r} on this machine; set fit.device to {devices}")
    loss_at = torch_loss(objective, (start.shape[1], start.shape[2]), device)
    variables = _tensor(start, device).requires_grad_()
    bound = _tensor(np.broadcast_to(limit, start.shape), device)
    adam: Any = torch.optim.Adam([variables], lr=rate, betas=(BETA_1, BETA_2), eps=EPSILON)
    best = start
    losses: list[float] = []
    while True:
        adam.zero_grad()
        loss = loss_at(variables)
        if not losses or loss.item() < min(losses):
            best = variables.detach().cpu().numpy().copy()
        losses.append(loss.item())
        if _has_finished(losses, iterations):
            return best, losses
        loss.backward()
        adam.step()
        with torch.no_grad():
            variables.clamp_(-bound, bound)
