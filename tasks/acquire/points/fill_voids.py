"""Voids of a raster up to a size: linear between the cells around them, the wider ones left void.

A void stays void wherever a disc of the given size fits into it; so a lake keeps its shore, and the survey
does not grow at its border.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.tin import tin
from flexroad.tasks.types import Floats

DIAGONAL = math.sqrt(2)
"""Centres of touching cells are up to so many cells apart: where known cells have no void between them."""


def fill(heights: Floats, grid: Grid, size_m: float) -> Floats:
    """Return the heights with voids of up to ``size_m`` filled, ``(H, W)``, m.

    The centres of the cells around the voids are joined to triangles (see `tin`). A square or a strip of n
    cells across is filled if ``size_m`` is at least n cells.
    """
    void = np.isnan(heights)
    around = ~void & ndimage.binary_dilation(void, np.ones((3, 3), bool))
    row, col = np.indices(grid.shape, np.float64)
    east, north = (col + 0.5) * grid.cell, -(row + 0.5) * grid.cell
    between = tin(east, north, np.where(around, heights, np.nan), grid, size_m + DIAGONAL * grid.cell)
    return np.where(void, between, heights)


def reach_m(size_m: float, cell: float) -> float:
    """Return how far from a cell others can change what `fill` puts there (m): a disc, and what is around."""
    return (math.ceil(size_m / cell + DIAGONAL) + 1) * cell
