"""Minimise the loss of the production fit for many tiles at once, in torch: for GPUs.

Tiles of one shape have the same splines, and a batch of them is one array operation after the other:
`tasks.spline.torch_batch` takes the steps of `tasks.spline.irls` for all of them. A tile leaves its batch
when it has converged, so its result does not depend on the others except for rounding.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.problem import Problem
from flexroad.tasks.types import Floats


@dataclass(frozen=True)
class Engine:
    """Where batches are solved, and how large they are."""

    device: str = "cpu"
    """cpu, cuda, cuda:1, or auto: cuda if there is one, else cpu."""
    precision: str = "float64"
    """float64, or float32: of the normal equations; residuals, gradients and heights are always float64."""
    memory_bytes: int = 2 * 1024**3
    """What a batch may use at most; a batch has at least one tile."""

    def chosen_device(self) -> str:
        """Return the device, or raise an error if this machine does not have it.

        Raises
        ------
        TaskError
            If there is no such device.
        """
        import torch

        if self.device == "auto":
            return "cuda" if torch.cuda.is_available() else "cpu"
        if self.device != "cpu" and not torch.cuda.is_available():
            raise TaskError(f"no device {self.device!r} on this machine; set the device to cpu or auto")
        return self.device

    def batch_size(self, problem: Problem) -> int:
        """Return the number of tiles like this one that a batch may have, at least 1."""
        return max(1, int(self.memory_bytes // bytes_per_tile(problem, self.precision)))


FRAGMENTATION = 1.75
"""Memory of a process over that of the arrays of a batch. Measured on the CPU with 8 and 24 tiles: from 0.5,
if freed memory returns to the system at once, to 1.7 with the system's usual allocator."""


def bytes_per_tile(problem: Problem, precision: str = "float64") -> int:
    """Return the memory that one tile of a batch needs at most (bytes), by arrays times `FRAGMENTATION`.

    With H x W cells, M x N control points including p zeros along each axis, and L = p + 1, these are ten
    rasters (targets, factors, residuals, their change, temporary ones), two stencils of L^2 M N (the second
    when tiles leave the batch), ten arrays M N; and in the working precision two rasters, three stencils (the
    normal equations, and before them their transpose), one factor of the gram product, H L N, and twenty
    arrays M N in the conjugate gradients.
    """
    height, width = map(int, problem.heights.shape)
    p = max(problem.space.degree)
    lags = p + 1
    n, m = (points + p for points in problem.space.points)
    working = 4 if precision == "float32" else 8
    rasters = 10 * 8 + 2 * working
    stencils = 2 * 8 + 3 * working
    arrays = (
        rasters * height * width
        + stencils * lags**2 * m * n
        + working * (min(height, width) * lags * max(m, n) + 20 * m * n)
        + 8 * 10 * m * n
    )
    return int(FRAGMENTATION * arrays)


def minimise(
    problems: Sequence[Problem], huber_m: float, iterations: int, tolerance: float, engine: Engine
) -> list[Floats]:
    """Return the control heights ``(m, n)`` of each problem, m above its datum.

    Parameters
    ----------
    problems : sequence of Problem
        Of any shapes; those of one shape are solved together.
    huber_m, iterations, tolerance
        As of `tasks.spline.irls`.
    engine : Engine
        The device and the size of batches.

    Raises
    ------
    TaskError
        If the device is not available.
    """
    from flexroad.tasks.spline import torch_batch

    device, results = engine.chosen_device(), [np.zeros(0)] * len(problems)
    for numbers in batches(problems, engine):
        batch = torch_batch.Batch.of([problems[i] for i in numbers], device, engine.precision)
        solved = torch_batch.minimise(batch, huber_m, iterations, tolerance)
        for i, z in zip(numbers, solved, strict=True):
            results[i] = z
    return results


def batches(problems: Sequence[Problem], engine: Engine) -> Iterator[list[int]]:
    """Yield the indices of problems that are solved together: of one shape, and within the memory."""
    groups: dict[object, list[int]] = {}
    for i, problem in enumerate(problems):
        groups.setdefault(problem.shape, []).append(i)
    for numbers in groups.values():
        size = engine.batch_size(problems[numbers[0]])
        for first in range(0, len(numbers), size):
            yield numbers[first : first + size]
