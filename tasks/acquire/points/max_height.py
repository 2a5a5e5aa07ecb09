"""The highest point of each cell, and single points too high to believe."""

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
    top, _, _ = _tops(cells, height, shape[0] * shape[1])
    return np.where(np.isneginf(top), np.nan, top).reshape(shape)


def spikes(cells: Cells, height: Floats, shape: tuple[int, int], despike_m: float) -> NDArray[np.int64]:
    """Return the indices of single points that stick out of everything around them, ``(k,)``.

    A cell's highest point is a spike if it lies more than ``despike_m`` above the second highest of its
    cell and above the highest points of all 8 neighbours. A pole or a crown that was hit twice is none,
    and so is a point with nothing around to compare it with. A cell loses one point at most.
    """
    top, second, who = _tops(cells, height, shape[0] * shape[1])
    around = ndimage.maximum_filter(top.reshape(shape), footprint=AROUND, mode="constant", cval=-np.inf)
    rest = np.maximum(second, around.ravel())
    single: NDArray[np.int64] = who[np.isfinite(rest) & (top > rest + despike_m)]
    return single


@compiled()
def _tops(cells: Cells, height: Floats, size: int) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return the two greatest heights per cell (-inf if there is none) and the index of the greatest."""
    top, second = np.full(size, -np.inf), np.full(size, -np.inf)
    who = np.full(size, -1, np.int64)
    for i in range(cells.size):
        c = cells[i]
        if c < 0:
            continue
        if height[i] > top[c]:
            second[c], top[c], who[c] = top[c], height[i], i
        elif height[i] > second[c]:
            second[c] = height[i]
    return top, second, who
