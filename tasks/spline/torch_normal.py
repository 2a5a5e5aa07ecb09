"""Normal equations of a batch of tensor-product splines in torch, solved by conjugate gradients.

An element of the matrix depends on the unordered pair of indices along each axis: it is a sum over cells of
products along v times products along u. So ``(q + 1) (p + 1)`` numbers per control point hold the matrix.

The preconditioner is the sum of the diagonals of ever coarser splines with every other knot (Bramble, Pasciak
and Xu, "Parallel multilevel preconditioners", 1990). In a void only the bending energy is left, an equation
of fourth order, for which a diagonal alone would need hundreds of iterations. All of it is products of
arrays, without a loop over control points as in Gauss-Seidel sweeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import TYPE_CHECKING

import numpy as np

from flexroad.tasks.spline.space import Space
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import torch

MAX_ITERATIONS = 300
"""Largest number of iterations for one system; it takes 10 to 60."""
SMALLEST = 1e-14
"""Share of the largest diagonal element below which one counts as 0."""
COARSEST = 2
"""Splines with at most this many control points per degree + 1 along an axis are not made coarser: there
would hardly be fewer, because those beyond the ends stay."""
BENDING = ((1.0, 0, 2), (2.0, 1, 1), (1.0, 2, 0))
"""Terms of the bending energy: how often, and the derivatives along v and u."""


@dataclass(frozen=True, eq=False)
class Level:
    """Coarser splines: their control points act on the finest ones."""

    to_v: torch.Tensor
    """Finest control points by coarse ones along v, ``(M, M')``, in the working precision."""
    to_u: torch.Tensor
    squares_v: tuple[torch.Tensor, ...]
    """Squares of the coarse functions at the rows, and of their derivatives, ``(H, M')``."""
    squares_u: tuple[torch.Tensor, ...]


@dataclass(frozen=True, eq=False)
class Bases:
    """Basis functions at the cells of tiles of one shape, with zero functions behind the last."""

    points: tuple[int, int]
    """Number of control points along v and u, (m, n)."""
    degree: tuple[int, int]
    """Degree along v and u, (q, p)."""
    along_v: tuple[torch.Tensor, ...]
    """Functions at the rows and their first and second derivatives per metre, ``(H, M)``, float64."""
    along_u: tuple[torch.Tensor, ...]
    pairs_v: tuple[torch.Tensor, ...]
    """Products of each function with itself and the next q, ``(M (q + 1), H)``, for the three derivatives."""
    pairs_u: tuple[torch.Tensor, ...]
    working: torch.dtype
    """Type of the normal equations."""
    levels: tuple[Level, ...]

    def padded(self, points: torch.Tensor) -> torch.Tensor:
        """Return control points ``(B, m, n)`` with zeros behind them, ``(B, M, N)``."""
        import torch

        q, p = self.degree
        return torch.nn.functional.pad(points, (0, p, 0, q))

    def unpadded(self, points: torch.Tensor) -> torch.Tensor:
        """Return control points without the zeros behind them, ``(B, m, n)``."""
        m, n = self.points
        return points[:, :m, :n]

    def heights(self, z: torch.Tensor) -> torch.Tensor:
        """Return the surfaces at the cells, ``(B, H, W)``, m."""
        return self.along_v[0] @ z @ self.along_u[0].T

    def from_cells(self, values: torch.Tensor) -> torch.Tensor:
        """Return sums over the cells of the values times each function, ``(B, M, N)``."""
        return self.along_v[0].T @ values @ self.along_u[0]

    def gram(self, weight: torch.Tensor, by_v: int = 0, by_u: int = 0) -> torch.Tensor:
        """Return the weighted products of functions or derivatives, ``(q + 1, p + 1, B, M, N)``.

        ``[k, l, :, i, j]`` is for functions i and i + k along v, j and j + l along u.
        """
        pairs_v, pairs_u = self.pairs_v[by_v].to(weight.dtype), self.pairs_u[by_u].to(weight.dtype)
        (q, p), count = self.degree, len(weight)
        product = pairs_v @ weight @ pairs_u.T
        split = product.view(count, -1, q + 1, product.shape[2] // (p + 1), p + 1)
        return split.permute(2, 4, 0, 1, 3).contiguous()

    def diagonals(self, weight: torch.Tensor, by_v: int = 0, by_u: int = 0) -> tuple[torch.Tensor, ...]:
        """Return the weighted squares of the functions or derivatives of each level, ``(B, M', N')``."""
        return tuple(
            level.squares_v[by_v].to(weight.dtype).T @ weight @ level.squares_u[by_u].to(weight.dtype)
            for level in self.levels
        )

    def bending(self, stiffness: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Return the second derivatives of the bending energy, and the diagonals for each level.

        Parameters
        ----------
        stiffness : Tensor, (B, H, W)
            Weight of the squared curvature in each cell (m3).
        """
        terms = [
            (self.gram(weight, by_v, by_u), self.diagonals(weight, by_v, by_u))
            for weight, by_v, by_u in ((2 * times * stiffness, by_v, by_u) for times, by_v, by_u in BENDING)
        ]
        stencil = terms[0][0] + terms[1][0] + terms[2][0]
        by_level = zip(*(diagonals for _, diagonals in terms), strict=True)
        return stencil, tuple((a + b + c).to(self.working) for a, b, c in by_level)


def bases_of(space: Space, device: str, precision: str) -> Bases:
    """Return the basis functions of a space on a device."""
    import torch

    (n, m), (p, q) = space.points, space.degree

    def tensors(arrays: list[Floats]) -> tuple[torch.Tensor, ...]:
        return tuple(torch.tensor(array, dtype=torch.float64, device=device) for array in arrays)

    along_v = _derivatives(space.knots_v, q, space.v, space.unit_m[1])
    along_u = _derivatives(space.knots_u, p, space.u, space.unit_m[0])
    working = {"float32": torch.float32, "float64": torch.float64}[precision]
    levels, to_v, to_u = [], np.eye(m, m + q).T, np.eye(n, n + p).T
    while to_v.shape[1] > COARSEST * (q + 1) or to_u.shape[1] > COARSEST * (p + 1):
        to_v, to_u = (
            to @ refinement(to.shape[1], d) if to.shape[1] > COARSEST * (d + 1) else to
            for to, d in ((to_v, q), (to_u, p))
        )
        levels.append(
            Level(
                tensors([to_v])[0].to(working),
                tensors([to_u])[0].to(working),
                tensors([(functions @ to_v) ** 2 for functions in along_v]),
                tensors([(functions @ to_u) ** 2 for functions in along_u]),
            )
        )
    return Bases(
        (m, n), (q, p), tensors(along_v), tensors(along_u),
        tensors([_pairs(functions, q + 1) for functions in along_v]),
        tensors([_pairs(functions, p + 1) for functions in along_u]),
        working, tuple(levels),
    )  # fmt: skip


def refinement(points: int, degree: int) -> Floats:
    """Return the matrix from uniform splines with every other knot to the fine ones, ``(points, coarse)``.

    A coarse function is a sum of degree + 2 fine ones with binomial coefficients. Fine functions that are
    zero on the domain are left out.
    """
    lowest = -((degree + 1) // 2)
    matrix = np.zeros((points, (points - 1) // 2 - lowest + 1))
    for coarse in range(matrix.shape[1]):
        for k in range(degree + 2):
            fine = 2 * (coarse + lowest) + k
            if 0 <= fine < points:
                matrix[fine, coarse] = comb(degree + 1, k) / 2**degree
    return matrix


def _derivatives(knots: Floats, degree: int, at: Floats, unit_m: float) -> list[Floats]:
    """Return the functions and their derivatives per metre, ``(N, points + degree)``; the last are zero."""
    from scipy.interpolate import BSpline

    points = len(knots) - degree - 1
    spline = BSpline(knots, np.eye(points, points + degree), degree)
    return [spline(at, nu=order) / unit_m**order for order in range(3)]


def _pairs(functions: Floats, lags: int) -> Floats:
    """Return the products of each function with itself and the following ones, ``(M * lags, N)``."""
    count, points = functions.shape
    out = np.zeros((points, lags, count))
    for lag in range(lags):
        out[: points - lag, lag] = (functions[:, : points - lag] * functions[:, lag:]).T
    return out.reshape(-1, count)


def multiply(stencil: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Return the products of the matrices with ``x``, ``(B, M, N)``.

    The whole batch is one row of numbers: the zeros behind each line and each tile keep them apart, because
    the stencil is 0 there. So every term is one product of rows that are shifted against each other.
    """
    lags_v, lags_u = stencil.shape[:2]
    line, flat = x.shape[2], x.reshape(-1)
    y = stencil[0, 0].reshape(-1) * flat
    for k in range(lags_v):
        for l in range(lags_u):  # noqa: E741
            values, down = stencil[k, l].reshape(-1), k * line
            if k or l:
                _add_symmetric(y, values, flat, 0, down + l)
            if k and l:
                _add_symmetric(y, values, flat, l, down)
    return y.view_as(x)


def _add_symmetric(y: torch.Tensor, values: torch.Tensor, x: torch.Tensor, a: int, b: int) -> None:
    """Add the elements between the points at ``a`` and ``b`` behind each one, in both directions."""
    count = len(x) - b
    y[a : a + count].addcmul_(values[:count], x[b:])
    y[b:].addcmul_(values[:count], x[a : a + count])


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The quadratic model of a batch: its matrices and their preconditioner, in the working precision."""

    stencil: torch.Tensor
    inverse: torch.Tensor
    """Inverse of the diagonal, ``(B, M, N)``; 0 where a control point is held."""
    levels: tuple[tuple[Level, torch.Tensor], ...]
    """Coarser splines and the inverses of their diagonals."""
    free: torch.Tensor

    @classmethod
    def of(
        cls,
        bases: Bases,
        weight: torch.Tensor,
        bending: torch.Tensor,
        diagonals: tuple[torch.Tensor, ...],
        free: torch.Tensor,
    ) -> NormalEquations:
        """Return the normal equations with these weights of the cells, ``(B, H, W)``.

        Parameters
        ----------
        bending, diagonals : Tensor, tuple of Tensor
            As by `Bases.bending`.
        free : Tensor, (B, M, N)
            1 at control points that are fitted, 0 at others.
        """
        weight, free = weight.to(bases.working), free.to(bases.working)
        stencil = bases.gram(weight).add_(bending)
        sums = (a + b for a, b in zip(bases.diagonals(weight), diagonals, strict=True))
        coarse = tuple((level, _inverse(total)) for level, total in zip(bases.levels, sums, strict=True))
        return cls(stencil, free * _inverse(stencil[0, 0]), coarse, free)

    def precondition(self, residual: torch.Tensor) -> torch.Tensor:
        """Return an approximate solution; the map is symmetric and positive."""
        result = self.inverse * residual
        for level, inverse in self.levels:
            coarse = inverse * (level.to_v.T @ residual @ level.to_u)
            result += self.free * (level.to_v @ coarse @ level.to_u.T)
        return result

    def solve(self, right: torch.Tensor, tolerance: float) -> torch.Tensor:
        """Return the solutions in float64, ``(B, M, N)``.

        Parameters
        ----------
        right : Tensor, (B, M, N)
            Right-hand sides; 0 at held control points.
        tolerance : float
            Norm of the preconditioned residual at which to stop, as a share of that at the start. A tile that
            has reached it is not changed by further iterations.
        """
        import torch

        scale = right.abs().amax((1, 2), keepdim=True).clamp(min=torch.finfo(right.dtype).tiny)
        residual = (right / scale).to(self.stencil.dtype)
        x, towards = torch.zeros_like(residual), self.precondition(residual)
        direction, size = towards, _dot(residual, towards)
        goal = size * tolerance**2
        for _ in range(MAX_ITERATIONS):
            running = size > goal
            if not bool(running.any()):
                break
            image = self.free * multiply(self.stencil, direction)
            length = torch.where(running, size / _dot(direction, image), 0.0)
            x += length * direction
            residual = residual - length * image
            towards = self.precondition(residual)
            before, size = size, torch.where(running, _dot(residual, towards), size)
            direction = towards + (size / before) * direction
        return x.to(right.dtype) * scale


def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the sums over control points, ``(B, 1, 1)``."""
    return (a * b).sum((1, 2), keepdim=True)


def _inverse(values: torch.Tensor) -> torch.Tensor:
    """Return the inverses; 0 where a value is all but 0: a function without any cell is not changed."""
    import torch

    least = SMALLEST * values.amax((1, 2), keepdim=True)
    return torch.where(values > least, 1 / values, 0.0)
