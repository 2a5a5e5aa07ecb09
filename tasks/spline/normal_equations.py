"""Normal equations of a tensor-product spline, kept as a band and solved by Cholesky.

The unknowns are the control heights ``z``, ``(m, n)``, in row-major order. Two basis functions overlap only
if their indices differ by at most the degree along both axes, so ``B^T W B`` has non-zeros only near its
diagonal. It is computed by two products with sparse matrices, first along v, then along u.
"""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats

RIDGE = 1e-9
"""Share of the diagonal's mean that is added to it: undetermined control points then keep their height."""


def pairs(basis: Floats, lags: int) -> scipy.sparse.csr_array:
    """Return the products of each function with itself and the following ones, ``(points * lags, N)``.

    Parameters
    ----------
    basis : ndarray, (N, points)
        Basis functions, or derivatives of them, at the cells of one axis.
    lags : int
        Number of partners of a function: itself and the next ``lags - 1``.
    """
    points = basis.shape[1]
    out = np.zeros((points, lags, len(basis)))
    for lag in range(lags):
        out[: points - lag, lag] = (basis[:, : points - lag] * basis[:, lag:]).T
    return scipy.sparse.csr_array(out.reshape(-1, len(basis)))


def gram(
    weight: Floats, pairs_v: scipy.sparse.csr_array, pairs_u: scipy.sparse.csr_array, lags: int
) -> Floats:
    """Return the weighted products of basis functions, summed over the cells ``(H, W)``.

    Returns
    -------
    ndarray, (m, lags, n, lags)
        ``[i, k, j, l]`` is the sum for functions i and i + k along v, j and j + l along u; by symmetry also
        for i and i + k along v, j + l and j along u.
    """
    along_v = np.ascontiguousarray((pairs_v @ weight).T)
    product = (pairs_u @ along_v).T
    return np.asarray(product.reshape(pairs_v.shape[0] // lags, lags, -1, lags))


def band(products: Floats) -> Floats:
    """Return the matrix of `gram` as its lower band, ``(m * n, width)``: ``[i, d]`` is element (i + d, i)."""
    m, lags, n, _ = products.shape
    out = np.zeros((m, n, (lags - 1) * (n + 1) + 1))
    for k in range(lags):
        for l in range(lags):  # noqa: E741
            out[:, :, k * n + l] += products[:, k, :, l]
            if k and l:
                out[:, l:, k * n - l] += products[:, k, : n - l, l]
    return out.reshape(m * n, -1)


def hold(lower: Floats, held: Bools, lags: int) -> None:
    """Remove the equations of held control points from a lower band, in place: their step is then 0.

    Parameters
    ----------
    lower : ndarray, (m * n, width)
        As by `band`.
    held : ndarray, (m, n)
        Control points that keep their height.
    lags : int
        As in `gram`.
    """
    free = ~held.ravel()
    mean = lower[:, 0].mean()
    lower[~free] = 0.0
    n = held.shape[1]
    for d in {abs(down * n + across) for down in range(lags) for across in range(1 - lags, lags)} - {0}:
        lower[: len(free) - d, d] *= free[d:]
    lower[~free, 0] = mean


def factor(lower: Floats) -> Floats:
    """Return the Cholesky factor of a lower band; the band is overwritten.

    Raises
    ------
    TaskError
        If rounding has made the matrix indefinite.
    """
    lower[:, 0] += RIDGE * lower[:, 0].mean() + np.finfo(float).tiny
    factored, failed = scipy.linalg.lapack.dpbtrf(lower.T, lower=1, overwrite_ab=1)
    if failed:
        raise TaskError(
            f"control point {failed} of the surface is undetermined; use fewer control points (a larger "
            "fit.spacing_m), or raise fit.bending_m3"
        )
    return np.asarray(factored)


def solve(factored: Floats, right: Floats) -> Floats:
    """Return the solution for one right-hand side, in the shape of that."""
    solution, _ = scipy.linalg.lapack.dpbtrs(factored, right.ravel(), lower=1)
    return np.asarray(solution.reshape(right.shape))
