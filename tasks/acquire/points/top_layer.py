"""The mean of the highest points of each cell: the height of a hard surface under a scanner's noise.

The highest of n points with noise is above the surface, the more so the more points a cell has. The mean of
the points close below it is not, and still belongs to the uppermost surface: a deck, not the ground under it.
"""

from __future__ import annotations

import numpy as np

from flexroad.tasks.acquire.points.binning import Cells
from flexroad.tasks.acquire.types import TopLayer
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats


def top_layer(
    cells: Cells, height: Floats, highest: Floats, depth_m: float, shape: tuple[int, int]
) -> TopLayer:
    """Return mean, number and spread of the points of each cell's top layer.

    Parameters
    ----------
    cells : Cells
        The cells of the points, ``(n,)``.
    height : Floats
        The points, ``(n,)``, m.
    highest : Floats
        Highest point per cell, ``(H, W)``, m; NaN where there is none.
    depth_m : float
        Points up to this much below the highest one belong to the top layer (m).
    shape : tuple of int
        Rows and columns.
    """
    count, below, squared = _sums(cells, height, highest.ravel(), depth_m)
    with np.errstate(invalid="ignore"):
        mean, square = below / count, squared / count
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    return TopLayer(highest + mean.reshape(shape), count.reshape(shape), spread.reshape(shape))


@compiled()
def _sums(cells: Cells, height: Floats, highest: Floats, depth_m: float) -> tuple[Floats, Floats, Floats]:
    """Return number, sum and sum of squares of the heights relative to the highest, per cell."""
    count, below, squared = np.zeros_like(highest), np.zeros_like(highest), np.zeros_like(highest)
    for i in range(cells.size):
        c = cells[i]
        if c < 0:
            continue
        z = height[i] - highest[c]
        if z >= -depth_m:
            count[c] += 1.0
            below[c] += z
            squared[c] += z * z
    return count, below, squared
