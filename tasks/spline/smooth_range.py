"""The regulariser of `spline.objective` without its edges, for solvers that take second derivatives.

The highest and the lowest neighbour are replaced by means under softmax, whose temperature is a part of
their range: so a hill and a flat street are rounded alike.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flexroad.tasks.types import Floats

LEAST_M = 1e-6
"""Least temperature (m)."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def add_soft_range(
    z: Floats, lambda_reg: float, neighbours: NDArray[np.int64], softness: float, slope: Floats, lower: Floats
) -> None:
    """Add gradient and second derivatives, the latter by `tasks.spline.normal_equations.band`'s layout.

    With the soft range ``s = sum of (hi - lo) z``: ``2 s s'`` and ``2 (s' s'^T + s / t * (covariances of hi
    and lo))``, where t is the temperature; of s' only ``hi - lo`` is kept, so that all is positive.
    """
    rows, cols = z.shape
    flat, heights, by_z = z.ravel(), np.empty(8), slope.ravel()
    around, high, low = np.empty(8, np.int64), np.empty(8), np.empty(8)
    factor = 2 * lambda_reg / z.size
    for i in range(rows):
        for j in range(cols):
            count = 0
            for k in range(8):
                a, b = i + neighbours[k, 0], j + neighbours[k, 1]
                if 0 <= a < rows and 0 <= b < cols:
                    around[count] = a * cols + b
                    heights[count] = flat[around[count]]
                    count += 1
            soft, heat = _soft_range(heights[:count], softness, high, low)
            for k in range(count):
                pull = high[k] - low[k]
                by_z[around[k]] += factor * soft * pull
                for l in range(count):  # noqa: E741
                    if around[l] > around[k]:
                        continue
                    bend = pull * (high[l] - low[l]) - soft / heat * (high[k] * high[l] + low[k] * low[l])
                    if l == k:
                        bend += soft / heat * (high[k] + low[k])
                    lower[around[l], around[k] - around[l]] += factor * bend


@njit(cache=True)  # type: ignore[untyped-decorator]
def _soft_range(heights: Floats, softness: float, high: Floats, low: Floats) -> tuple[float, float]:
    """Return the soft range and the temperature (m); write the shares of the heights in it."""
    top, bottom = heights.max(), heights.min()
    heat = softness * (top - bottom) + LEAST_M
    for k in range(heights.size):
        high[k], low[k] = np.exp((heights[k] - top) / heat), np.exp((bottom - heights[k]) / heat)
    n = heights.size
    high[:n] /= high[:n].sum()
    low[:n] /= low[:n].sum()
    return float(((high[:n] - low[:n]) * heights).sum()), float(heat)
