"""The NURBS fit in torch with autograd: for GPUs, and to test the hand-written gradient."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.adam import BETA_1, BETA_2, EPSILON, Schedule
from flexroad.tasks.spline.objective import NEIGHBOURS, Objective
from flexroad.tasks.spline.surface import dense
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import torch
else:
    torch = lazy("torch")


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
        elif not torch.cuda.is_available():
            raise TaskError(f"no device {device!r} on this machine; set fit.device to cpu")
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


def minimise(
    objective: Objective, start: Floats, limit: Floats, schedule: Schedule, device: str
) -> tuple[Floats, list[float]]:
    """Minimise like `tasks.spline.adam.minimise`, with torch's Adam and autograd, on ``device``."""
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
