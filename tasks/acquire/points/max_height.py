"""The highest point of each cell, and outliers that are too high."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from flexroad.tasks.acquire.points.binning import Cells
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats

AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
"""The 8 neighbours of a cell."""


def highest(cells: Cells, height: Floats, shape: tuple[int, int]) -> Floats:
    """Return the height of the highest point per cell, ``(H, W)``; NaN in cells without points."""
    top, _, _ = _two_highest(cells, height, shape[0] * shape[1])
    return np.where(np.isneginf(top), np.nan, top).reshape(shape)


def spikes(cells: Cells, height: Floats, shape: tuple[int, int], despike_m: float) -> NDArray[np.int64]:
    """Return the indices of single points far above all points around them, ``(k,)``.

    The highest point of a cell is a spike if it is more than ``despike_m`` above the second highest point of
    its cell and above the highest points of all 8 neighbours. A pole or a crown with two points is not a
    spike, nor is a point without any points around it. A cell has at most one spike.
    """
    top, second, index = _two_highest(cells, height, shape[0] * shape[1])
    around = ndimage.maximum_filter(top.reshape(shape), footprint=AROUND, mode="constant", cval=-np.inf)
    rest = np.maximum(second, around.ravel())
    single: NDArray[np.int64] = index[np.isfinite(rest) & (top > rest + despike_m)]
    return single


@compiled()
def _two_highest(cells: Cells, height: Floats, size: int) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return the two greatest heights per cell (-inf if there is none) and the index of the greatest."""
    top, second = np.full(size, -np.inf), np.full(size, -np.inf)
    index = np.full(size, -1, np.int64)
    for i in range(cells.size):
        c = cells[i]
        if c < 0:
            continue
        if height[i] > top[c]:
            second[c], top[c], index[c] = top[c], height[i], i
        elif height[i] > second[c]:
            second[c] = height[i]
    return top, second, index
