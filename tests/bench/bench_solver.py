"""The convex solver compared with 200 Adam iterations: same start, same losses, unit weights.

Two losses: the height differences alone, and with the bending energy. "to win" is the time until the solver's
loss is below the lowest loss of all Adam steps, "whole" the time until it stops by itself. Adam uses the
objective that bench_fit.py measures; the gradient of the bending energy is added by the solver's stencil.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

from collections.abc import Callable

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import nurbs
from flexroad.tasks.spline import adam, irls
from flexroad.tasks.spline.objective import Objective
from flexroad.tasks.spline.space import start_heights
from flexroad.tasks.spline.stencil import from_lines, multiply, to_lines
from flexroad.tasks.spline.thin_plate import bending_energy
from flexroad.tasks.types import Floats, RoadClusters, TileData
from tests.bench.timing import cpu_s

SIZE, ITERATIONS, ROUNDS = 250, 200, 5
STIFFNESS_M3, TERRAIN = 100.0, 0.02


def case() -> tuple[TileData, RoadClusters]:
    """Return a tile with hilly ground, noise, and a winding road with cars."""
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, SIZE, SIZE)
    e, n = np.meshgrid(grid.eastings - grid.west, grid.northings - grid.south)
    rng = np.random.default_rng(0)
    truth = 160 + 0.02 * e + 3 * np.sin(e / 40) + 2 * np.cos(n / 55)
    road = np.abs(n - 125 - 20 * np.sin(e / 50)) < 6
    dtm = truth + rng.normal(0, 0.05, e.shape)
    dsm = truth + rng.normal(0, 0.05, e.shape) + np.where(rng.random(e.shape) < 0.05, 1.5, 0)
    return TileData("bench", grid, grid, dsm, dtm), RoadClusters(grid, road.astype(np.int32))


def with_bending(objective: Objective, bending: Floats) -> Callable[[Floats], tuple[float, Floats]]:
    def loss(variables: Floats) -> tuple[float, Floats]:
        value, gradient = objective(variables)
        lines = to_lines(variables[0], 3)
        pull = np.empty_like(lines)
        multiply(bending, lines, pull, (0.0,) * 4)
        gradient[0] += from_lines(pull, len(variables[0]), 3)
        return value + float(np.vdot(pull, lines)) / 2, gradient

    return loss


def compare(points: int, smoothness: str) -> float:
    """Print one row; return the ratio of Adam's time to the solver's time for the same loss."""
    data, clusters = case()
    options = nurbs.Options(weights="unit", control_points=(points, points), lambda_reg=0)
    space = nurbs.space_of(data, options)
    heights, datum = start_heights(data.dsm, data.dtm, clusters.mask, space, True)
    objective = nurbs.objective_of(data, clusters.mask, space, datum, options)
    start, shape = heights - datum, (points, points)
    stiffness = STIFFNESS_M3 * np.where(clusters.mask, 1.0, TERRAIN) / clusters.mask.size
    bending = bending_energy(stiffness, space) if smoothness == "bending" else None
    loss = objective if bending is None else with_bending(objective, bending)
    variables, limit = np.stack([start, np.zeros_like(start)]), np.full((2, 1, 1), np.inf)
    schedule = adam.Schedule(options.learning_rate, ITERATIONS, 0, 20)

    def solve(steps: int) -> irls.Solution:
        return irls.minimise(
            irls.HuberObjective(objective, shape, bending=bending), start, steps, options.stop_tolerance
        )

    _, losses = adam.minimise(loss, variables, limit, schedule)
    lowest, solution = min(losses), solve(ITERATIONS)
    steps = int(np.argmax(np.array(solution.losses) < lowest))
    if not steps:
        raise SystemExit(
            f"{smoothness}, {points}: the solver stopped at {solution.losses[-1]:.6f}, above Adam"
        )
    slow, fast, whole = (
        1e3 * cpu_s(f, ROUNDS)
        for f in (
            lambda: adam.minimise(loss, variables, limit, schedule),
            lambda: solve(steps),
            lambda: solve(ITERATIONS),
        )
    )
    print(
        f"{points:>6} {smoothness:<9}{lowest:>10.6f}{slow:>8.0f}{solution.losses[-1]:>10.6f}{whole:>8.0f}"
        f"{steps:>7}{fast:>8.0f}{slow / fast:>8.1f}{slow / whole:>8.1f}"
    )
    return slow / fast


def main() -> None:
    """Print the table; exit with an error if the solver is not at least three times as fast."""
    print(f"{SIZE} x {SIZE} cells, one thread; losses in m, times in ms")
    print("points smoothness   Adam      ms   solver   whole  steps  to win   ratio   whole")
    ratios = {(n, kind): compare(n, kind) for n in (35, 70) for kind in ("none", "bending")}
    if min(ratios[35, kind] for kind in ("none", "bending")) < 3:
        raise SystemExit("the solver is slower than required")


if __name__ == "__main__":
    main()
