"""Iteratively reweighted least squares for a batch of tiles, in torch.

The steps are those of `tasks.spline.irls`. Their normal equations are solved by conjugate gradients with
`tasks.spline.torch_normal`. Arrays of a batch have the tiles first. Control points have zeros behind their
last row and column, ``(B, M, N)`` with M = m + q and N = n + p: see `torch_normal.multiply`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from flexroad.tasks.spline.irls import COOLING, FINAL_M, INITIAL_M, MAX_STEP
from flexroad.tasks.spline.torch_normal import Bases, NormalEquations, bases_of, multiply
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import torch

    from flexroad.tasks.spline.problem import Problem

TOLERANCE = 1e-5
"""Tolerance of the normal equations. The fit stops long before the loss is lowest, so batches must take the
steps that `tasks.spline.irls` takes: with 1e-3 in the first step a surface over a void differed by 12 mm."""
EVALUATIONS, SLOPE_TOLERANCE = 40, 1e-5
"""Largest number of evaluations along a step, and largest slope at its end, as a share of the first one."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Tiles of one shape on a device."""

    bases: Bases
    """Basis functions, equal for all tiles."""
    target: torch.Tensor
    """Heights to fit, ``(B, H, W)``, m; 0 where the factor is 0."""
    factor: torch.Tensor
    """Loss per metre of difference, ``(B, H, W)``."""
    stencil: torch.Tensor
    """Second derivatives of the bending energy, ``(q + 1, p + 1, B, M, N)``."""
    diagonals: tuple[torch.Tensor, ...]
    """Those of the coarser splines, ``(B, ., .)`` each; only the diagonals."""
    free: torch.Tensor
    """1 at control points that are fitted, 0 at others, ``(B, M, N)``."""
    z: torch.Tensor
    """Control heights, ``(B, M, N)``, m."""

    @classmethod
    def of(cls, problems: Sequence[Problem], device: str, precision: str) -> Batch:
        """Copy problems of one shape to the device."""
        import torch

        if device == "cpu":
            # The program runs one process for each core, and at these sizes threads do not pay.
            torch.set_num_threads(1)
        bases = bases_of(problems[0].space, device, precision)
        counts = [np.count_nonzero(np.isfinite(p.heights)) for p in problems]

        def stacked(arrays: Sequence[Floats]) -> torch.Tensor:
            return torch.tensor(np.stack(arrays), dtype=torch.float64, device=device)

        stiffness = stacked([p.stiffness / count for p, count in zip(problems, counts, strict=True)])
        stencil, diagonals = bases.bending(stiffness)
        return cls(
            bases,
            target=stacked([np.nan_to_num(p.heights) for p in problems]),
            factor=stacked(
                [
                    np.where(np.isfinite(p.heights), p.weight, 0) / count
                    for p, count in zip(problems, counts, strict=True)
                ]
            ),
            stencil=stencil,
            diagonals=diagonals,
            free=bases.padded(stacked([np.where(p.held, 0.0, 1.0) for p in problems])),
            z=bases.padded(stacked([p.first for p in problems])),
        )

    def take(self, tiles: torch.Tensor) -> Batch:
        """Return the batch of some of the tiles."""
        return Batch(
            self.bases,
            self.target[tiles],
            self.factor[tiles],
            self.stencil[:, :, tiles],
            tuple(diagonal[tiles] for diagonal in self.diagonals),
            self.free[tiles],
            self.z[tiles],
        )

    def with_heights(self, z: torch.Tensor) -> Batch:
        """Return the batch with other control heights."""
        return replace(self, z=z)

    def residuals(self) -> torch.Tensor:
        """Return the surface minus the targets, ``(B, H, W)``, m."""
        return self.bases.heights(self.z) - self.target


@dataclass(frozen=True, eq=False)
class _Line:
    """The loss along the step of each tile: of the differences, and of the bending energy, a parabola."""

    residuals: torch.Tensor
    change: torch.Tensor
    factor: torch.Tensor
    huber_m: float
    energy: torch.Tensor
    energy_slope: torch.Tensor
    step_energy: torch.Tensor

    def loss(self, t: torch.Tensor) -> torch.Tensor:
        """Return the losses (m) after t times the steps, ``(B,)``."""
        differences = (self.residuals + t[:, None, None] * self.change).abs()
        if self.huber_m:
            within = differences.clamp(max=self.huber_m)
            differences += within * (within * (0.5 / self.huber_m) - 1)
        data = (self.factor * differences).sum((1, 2))
        return data + self.energy + t * (self.energy_slope + t * self.step_energy)

    def slopes(self, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the first and second derivatives of the losses by t, ``(B,)``."""
        differences = self.residuals + t[:, None, None] * self.change
        pull, rate = self.factor * self.change, 2 * self.step_energy
        if self.huber_m:
            within = differences.abs() < self.huber_m
            rate = rate + (within * pull * self.change).sum((1, 2)) / self.huber_m
            direction = (differences / self.huber_m).clamp(-1, 1)
        else:
            direction = differences.sign()
        return (pull * direction).sum((1, 2)) + self.energy_slope + t * 2 * self.step_energy, rate

    def minimum(self) -> torch.Tensor:
        """Return the t of the lowest losses up to `MAX_STEP`, by Newton's method within a bracket.

        The first derivative does not fall. Where Newton's step leaves the bracket, this is halved.
        """
        import torch

        low, high = torch.zeros_like(self.energy), torch.full_like(self.energy, MAX_STEP)
        t, least = torch.ones_like(low), SLOPE_TOLERANCE * self.slopes(low)[0].abs()
        for number in range(EVALUATIONS):
            slope, rate = self.slopes(t)
            done = slope.abs() <= least
            if bool(done.all()):
                break
            low, high = torch.where(slope < 0, t, low), torch.where(slope < 0, high, t)
            newton = t - slope / rate
            # Every third time halved too: Newton's step can be short on one side of a bend.
            inside = (newton > low) & (newton < high) & (number % 3 != 2)
            following = torch.where(inside, newton, (low + high) / 2)
            t = torch.where(done, t, following)
        return t


def minimise(batch: Batch, huber_m: float, iterations: int, tolerance: float) -> list[Floats]:
    """Return the control heights of each tile, ``(m, n)``, m.

    Parameters
    ----------
    batch : Batch
        Tiles of one shape.
    huber_m : float
        Smaller differences are squared (m); 0 is L1.
    iterations : int
        Largest number of steps, at least 1.
    tolerance : float
        Relative decrease of the loss at which a tile has converged.
    """
    import torch

    results, tiles = torch.zeros_like(batch.z), torch.arange(len(batch.z), device=batch.z.device)
    floor_m = huber_m or FINAL_M
    for number in range(iterations):
        least = INITIAL_M * COOLING**number
        z, loss, lowest = _step(batch, huber_m, max(least, floor_m))
        results[tiles] = z
        decrease = (loss - lowest) / loss.clamp(min=torch.finfo(loss.dtype).tiny)
        running = (decrease > tolerance) | (least > floor_m)
        if not bool(running.any()):
            break
        batch, tiles = batch.with_heights(z).take(running), tiles[running]
    return [np.ascontiguousarray(z) for z in batch.bases.unpadded(results).cpu().numpy()]


def _step(batch: Batch, huber_m: float, floor_m: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the control heights after one step, and the losses before and after it (m)."""
    import torch

    residuals, bend = batch.residuals(), multiply(batch.stencil, batch.z)
    weight = batch.factor / residuals.abs().clamp(min=floor_m)
    slope = batch.free * (batch.bases.from_cells(weight * residuals) + bend)
    model = NormalEquations.of(batch.bases, weight, batch.stencil, batch.diagonals, batch.free)
    step = model.solve(-slope, TOLERANCE)
    line = _Line(
        residuals,
        batch.bases.heights(step),
        batch.factor,
        huber_m,
        (bend * batch.z).sum((1, 2)) / 2,
        (bend * step).sum((1, 2)),
        (multiply(batch.stencil, step) * step).sum((1, 2)) / 2,
    )
    t = line.minimum()
    before, after = line.loss(torch.zeros_like(t)), line.loss(t)
    t = torch.where(after < before, t, 0.0)
    return batch.z + t[:, None, None] * step, before, torch.minimum(after, before)
