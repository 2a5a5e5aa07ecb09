"""The coarser spline of a multigrid cycle: the matrix of its functions, and the way to it and back.

A function of the spline with every other knot is a sum of p + 2 functions of the finer one. Function J is
made of those from ``2 J - p`` to ``2 J + 1``, as far as they exist, along both axes.
"""

from __future__ import annotations

import numpy as np

from flexroad.tasks.compiled import compiled
from flexroad.tasks.spline.stencil import Lags
from flexroad.tasks.types import Floats


@compiled(error_model="numpy", fused=True)
def coarsen(fine: Floats, weights: Floats, coarse: Floats, lags: Lags) -> None:
    """Write the matrix of the coarser spline, whose functions are sums of the finer one's, to ``coarse``."""
    p = len(lags) - 1
    n, width = fine.shape[0], fine.shape[3]
    half = np.zeros((len(lags), width))
    for J in range(coarse.shape[0]):
        for L in range(min(len(lags), coarse.shape[0] - J)):
            half[:] = 0.0
            for a in range(p + 2):
                for b in range(p + 2):
                    f, g = 2 * J - p + a, 2 * (J + L) - p + b
                    low, apart = min(f, g), abs(f - g)
                    if low >= 0 and low + apart < n and apart <= p:
                        weight = weights[a] * weights[b]
                        for k in range(len(lags)):
                            for i in range(width):
                                half[k, i] += weight * fine[low, apart, k, i]
            _coarsen_lines(half, weights, coarse[J, L], lags)


@compiled(error_model="numpy", fused=True)
def _coarsen_lines(half: Floats, weights: Floats, coarse: Floats, lags: Lags) -> None:
    p = len(lags) - 1
    end = half.shape[1] - p
    coarse[:] = 0.0
    for K in range(len(lags)):
        for a in range(p + 2):
            for b in range(max(0, a - 2 * K - p), min(p + 2, a - 2 * K + p + 1)):
                weight = weights[a] * weights[b]
                ahead = 2 * K + b - a
                apart = abs(ahead)
                # Function i of a line is at i + p in it; the zeros at its ends stand for those beyond.
                for at in range(p, coarse.shape[1] - p):
                    low = 2 * (at - p) + a + min(ahead, 0)
                    if low >= p and low + apart < end:
                        coarse[K, at] += weight * half[apart, low]


@compiled(error_model="numpy", fused=True)
def restrict(fine: Floats, weights: Floats, free: Floats, coarse: Floats, lags: Lags) -> None:
    """Write the sums of ``fine`` over the functions of the coarser spline to ``coarse``."""
    p = len(lags) - 1
    n, width = fine.shape
    # One longer, because the last function of the coarser line may reach over the end of the finer line.
    line = np.zeros(width + 1)
    for J in range(len(coarse)):
        line[:] = 0.0
        for a in range(p + 2):
            f = 2 * J - p + a
            if 0 <= f < n:
                for i in range(width):
                    line[i] += weights[a] * fine[f, i]
        for at in range(p, coarse.shape[1] - p):
            total = 0.0
            if free[J, at] != 0.0:
                for a in range(p + 2):
                    total += weights[a] * line[2 * (at - p) + a]
            coarse[J, at] = total


@compiled(error_model="numpy", fused=True)
def add_coarse(coarse: Floats, weights: Floats, free: Floats, fine: Floats, lags: Lags) -> None:
    """Add the coarser spline ``coarse`` to ``fine``."""
    p = len(lags) - 1
    n, width = fine.shape
    # The coarser line's functions may reach over the end of the finer line.
    line = np.zeros(2 * coarse.shape[1] + p + 2)
    for J in range(len(coarse)):
        line[:] = 0.0
        for at in range(p, coarse.shape[1] - p):
            for a in range(p + 2):
                line[2 * (at - p) + a] += weights[a] * coarse[J, at]
        for a in range(p + 2):
            f = 2 * J - p + a
            if 0 <= f < n:
                for i in range(p, width - p):
                    fine[f, i] += weights[a] * line[i] * free[f, i]
