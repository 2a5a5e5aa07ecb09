"""The NURBS fit at the paper's settings, one thread, compared with two other computations of its gradient.

Point by point: plain Python; the basis is computed at every cell in every iteration. Two iterations are
timed and scaled to 200. Dense: numpy products with full basis matrices into preallocated arrays, with a
hand-written gradient.
"""

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

from collections.abc import Callable

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.fit import nurbs
from flexroad.tasks.spline import adam
from flexroad.tasks.spline.objective import NEIGHBOURS, Objective
from flexroad.tasks.spline.space import Space, start_heights
from flexroad.tasks.spline.surface import MAX_LOG_WEIGHT, basis_matrix
from flexroad.tasks.types import RoadClusters, TileData
from tests.bench.timing import cpu_s, one_cpu_s

SIZE, ITERATIONS, SAMPLED = 250, 200, 2
OPTIONS = nurbs.Options(iterations=ITERATIONS, stop_tolerance=0)


def case() -> tuple[TileData, RoadClusters]:
    """Return a tile with hilly ground, noise, and a winding road with cars."""
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, SIZE, SIZE)
    e, n = np.meshgrid(grid.eastings - grid.west, grid.northings - grid.south)
    rng = np.random.default_rng(0)
    dtm = 160 + 0.02 * e + 3 * np.sin(e / 40) + 2 * np.cos(n / 55) + rng.normal(0, 0.05, e.shape)
    road = np.abs(n - 125 - 20 * np.sin(e / 50)) < 6
    dsm = dtm + np.where(rng.random(e.shape) < 0.05, 1.5, 0)
    return TileData("bench", grid, grid, dsm, dtm), RoadClusters(grid, road.astype(np.int32))


class Dense:
    """The objective computed with products of full basis matrices."""

    def __init__(self, objective: Objective, space: Space) -> None:
        knots_u, knots_v, (p, q) = space
        self.objective = objective
        self.u, _ = basis_matrix(knots_u, p, np.linspace(0, 1, SIZE))
        self.v, _ = basis_matrix(knots_v, q, np.linspace(1, 0, SIZE))
        # Preallocated: allocating an array of this size takes longer than a product.
        self.den, self.s, self.difference, self.pull = np.empty((4, SIZE, SIZE))

    def __call__(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        z, w = variables[0], np.exp(variables[1])
        a = w * z
        den, s, difference, pull = self.den, self.s, self.difference, self.pull
        np.matmul(self.v @ w, self.u.T, out=den)
        np.matmul(self.v @ a, self.u.T, out=s)
        np.divide(s, den, out=s)
        np.subtract(s, self.objective.target, out=difference)
        np.sign(difference, out=pull)
        np.multiply(pull, self.objective.factor, out=pull)
        loss = np.vdot(pull, difference)
        np.divide(pull, den, out=pull)
        by_a = self.v.T @ (pull @ self.u)
        np.multiply(pull, s, out=pull)
        by_w = -self.v.T @ (pull @ self.u)
        reg, by_z = self.regulariser(z)
        return loss + reg, np.stack([by_a * w + by_z, by_a * a + by_w * w])

    def regulariser(self, z: np.ndarray) -> tuple[float, np.ndarray]:
        m, n = z.shape
        by_z, ends = np.zeros_like(z), []
        rows, cols = np.indices(z.shape)
        for sign in (1, -1):
            padded = np.pad(sign * z, 1, constant_values=-np.inf)
            around = np.stack([padded[1 + i : 1 + i + m, 1 + j : 1 + j + n] for i, j in NEIGHBOURS])
            k = around.argmax(axis=0)
            end = np.take_along_axis(around, k[None], axis=0)[0]
            ends.append((sign, rows + NEIGHBOURS[k, 0], cols + NEIGHBOURS[k, 1], end))
        span = ends[0][3] + ends[1][3]
        factor = self.objective.lambda_reg / z.size
        for sign, i, j, _ in ends:
            np.add.at(by_z, (i, j), sign * 2 * factor * span)
        return factor * (span**2).sum(), by_z


class PointByPoint(Dense):
    """The objective in plain Python, with the basis computed at every cell."""

    def __init__(self, objective: Objective, space: Space) -> None:
        super().__init__(objective, space)
        self.knots_u, self.knots_v, self.degree = (
            space.knots_u.tolist(),
            space.knots_v.tolist(),
            space.degree[0],
        )

    def __call__(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        z, w = variables[0].tolist(), np.exp(variables[1]).tolist()
        reg, by_z = self.regulariser(variables[0])
        by_z, by_rho = by_z.tolist(), np.zeros_like(by_z).tolist()
        target, factor = self.objective.target.tolist(), self.objective.factor.tolist()
        loss = reg
        for r in range(SIZE):
            for c in range(SIZE):
                terms = self.terms(r, c, w)
                den = sum(b for _, _, b in terms)
                s = sum(b * z[i][j] for i, j, b in terms) / den
                difference = s - target[r][c]
                loss += factor[r][c] * abs(difference)
                pull = factor[r][c] * ((difference > 0) - (difference < 0)) / den
                for i, j, b in terms:
                    by_z[i][j] += pull * b
                    by_rho[i][j] += pull * b * (z[i][j] - s)
        return loss, np.array([by_z, by_rho])

    def terms(self, row: int, col: int, w: list[list[float]]) -> list[tuple[int, int, float]]:
        """Return (row, column, weighted basis) of the control points that affect a cell."""
        first_u, along_u = self.basis(self.knots_u, col / (SIZE - 1))
        first_v, along_v = self.basis(self.knots_v, 1 - row / (SIZE - 1))
        return [
            (first_v + i, first_u + j, bv * bu * w[first_v + i][first_u + j])
            for i, bv in enumerate(along_v)
            for j, bu in enumerate(along_u)
        ]

    def basis(self, knots: list[float], u: float) -> tuple[int, list[float]]:
        """Return the index of the first non-zero basis function and the non-zero values (Eq. cox_de_boor)."""
        p = self.degree
        span = p
        while knots[span + 1] <= u and span < len(knots) - p - 2:
            span += 1
        values = [1.0]
        for k in range(1, p + 1):
            raised = [0.0] * (k + 1)
            for j, value in enumerate(values):
                left, right = knots[span - k + 1 + j], knots[span + 1 + j]
                raised[j] += (right - u) / (right - left) * value
                raised[j + 1] += (u - left) / (right - left) * value
            values = raised
        return span - p, values


def main() -> None:
    """Print the table; exit with an error if the three results differ or the fit is too slow."""
    data, clusters = case()
    space = nurbs.space_of(data, OPTIONS)
    heights, datum = start_heights(data.dsm, data.dtm, clusters.mask, space, True)
    objective = nurbs.objective_of(data, clusters.mask, space, datum, OPTIONS)
    start = np.stack([heights - datum, np.zeros_like(heights)])
    limit = np.array([np.inf, MAX_LOG_WEIGHT])[:, None, None]
    dense, by_point = Dense(objective, space), PointByPoint(objective, space)
    # Away from the start, so that neighbouring heights differ.
    variables = start + np.random.default_rng(1).normal(0, 0.2, start.shape)
    loss, gradient = objective(variables)
    for other in (dense, by_point):
        other_loss, other_gradient = other(variables)
        np.testing.assert_allclose(other_loss, loss, rtol=1e-9)
        np.testing.assert_allclose(other_gradient, gradient, rtol=1e-6, atol=1e-12)

    def run(loss: Callable[[np.ndarray], tuple[float, np.ndarray]], iterations: int) -> Callable[[], object]:
        return lambda: adam.minimise(loss, start, limit, adam.Schedule(0.1, iterations, 0, 20))

    run(objective, 1)()
    ours = cpu_s(lambda: nurbs.fit(data, clusters, OPTIONS), 7)
    # n iterations take n + 1 evaluations in both cases.
    slow = one_cpu_s(run(by_point, SAMPLED - 1)) / SAMPLED * (ITERATIONS + 1)
    dense_s = cpu_s(run(dense, ITERATIONS), 3)
    torch = cpu_s(lambda: nurbs.fit(data, clusters, OPTIONS.model_copy(update={"engine": "torch"})), 3)
    print(f"{SIZE} x {SIZE} cells, 35 x 35 control points, {ITERATIONS} iterations, one thread")
    print(f"{'method':<34}{'s':>10}{'ratio':>10}{'required':>10}")
    for name, seconds, required in (
        ("fit, whole stage", ours, ""),
        ("dense numpy, gradient by hand", dense_s, ">= 1"),
        ("torch, autograd, whole stage", torch, ""),
        ("point by point in Python (scaled)", slow, ">= 50"),
    ):
        print(f"{name:<34}{seconds:>10.3f}{seconds / ours:>10.1f}{required:>10}")
    if slow < 50 * ours or dense_s < ours:
        raise SystemExit("the fit is slower than required")


if __name__ == "__main__":
    main()
