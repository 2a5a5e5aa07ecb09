"""Normal equations of a tensor-product spline, kept as a band and solved by Cholesky.

Control heights ``z``, ``(m, n)``, in row-major order: two basis functions overlap only if they are at most
a degree apart along both axes, so ``B^T W B`` has non-zeros only near its diagonal. It is put together by two
products with sparse matrices, first along v, then along u.
"""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

RIDGE = 1e-9
"""Part of the diagonal's mean added to it: control points that nothing holds then stay where they are."""


def pairs(basis: Floats, lags: int) -> scipy.sparse.csr_array:
    """Return each function times itself and the next ones, ``(points * lags, N)``.

    Parameters
    ----------
    basis : ndarray, (N, points)
        Basis functions, or derivatives of them, at the cells of one axis.
    lags : int
        One more than the distance up to which functions are paired.
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
        ``[i, k, j, l]``: functions i and i + k along v, j and j + l along u. By symmetry also i and i + k
        with j + l and j.
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


def factor(lower: Floats) -> Floats:
    """Return the Cholesky factor of a lower band, in its place.

    Raises
    ------
    TaskError
        If rounding has made the matrix indefinite.
    """
    lower[:, 0] += RIDGE * lower[:, 0].mean() + np.finfo(float).tiny
    factored, failed = scipy.linalg.lapack.dpbtrf(lower.T, lower=1, overwrite_ab=1)
    if failed:
        raise TaskError(
            f"control point {failed} of the surface is undetermined; take fewer (a larger fit.spacing_m), "
            "or raise fit.bending_m3"
        )
    return np.asarray(factored)


def solve(factored: Floats, right: Floats) -> Floats:
    """Solve for one right-hand side, in its shape."""
    solution, _ = scipy.linalg.lapack.dpbtrs(factored, right.ravel(), lower=1)
    return np.asarray(solution.reshape(right.shape))
