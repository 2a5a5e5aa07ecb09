"""Linear interpolation of the voids of a raster up to a width.

Cells remain void where a disc of the given diameter fits into the void, so that lakes keep their shore and
the survey does not grow at its border.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points.tin import tin
from flexroad.tasks.types import Floats

DIAGONAL = math.sqrt(2)
"""Largest distance of the centres of touching cells (cells), added to the width of a void."""


def fill(heights: Floats, grid: Grid, size_m: float) -> Floats:
    """Return the heights with voids of up to ``size_m`` filled, ``(H, W)``, m.

    The centres of the cells around the voids are triangulated (see `tin`). A square or a strip of n cells
    across is filled if ``size_m`` is at least n cells.
    """
    void = np.isnan(heights)
    border = ~void & ndimage.binary_dilation(void, np.ones((3, 3), bool))
    row, col = np.indices(grid.shape, np.float64)
    east, north = (col + 0.5) * grid.cell, -(row + 0.5) * grid.cell
    interpolated = tin(east, north, np.where(border, heights, np.nan), grid, size_m + DIAGONAL * grid.cell)
    return np.where(void, interpolated, heights)


def reach_m(size_m: float, cell: float) -> float:
    """Return the largest distance from a cell at which other cells can change the result of `fill` (m)."""
    return (math.ceil(size_m / cell + DIAGONAL) + 1) * cell
