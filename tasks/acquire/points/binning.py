"""The cell of each point, and means per cell."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats

Cells = NDArray[np.int64]
"""Row-major index of the cell of each point, ``(n,)``; -1 outside the grid."""

NUDGE = 1e-6
"""Part of a cell that is more than the rounding error of its edge's coordinates."""


def bins(easting: Floats, northing: Floats, grid: Grid) -> Cells:
    """Return the cell of each point, ``(n,)``, row-major; -1 outside the grid.

    A point on the border of two cells belongs to the eastern or southern one. Rounding does not change that,
    so all grids of the same lattice give the same result.
    """
    cells: Cells = _bins(
        np.asarray(easting), np.asarray(northing), grid.west, grid.north, grid.cell, grid.height, grid.width
    )
    return cells


@compiled()
def _bins(
    easting: Floats, northing: Floats, west: float, north: float, cell: float, rows: int, cols: int
) -> Cells:
    cells = np.full(easting.size, -1, np.int64)
    for i in range(easting.size):
        col = math.floor((easting[i] - west) / cell + NUDGE)
        row = math.floor((north - northing[i]) / cell + NUDGE)
        if 0 <= row < rows and 0 <= col < cols:
            cells[i] = row * cols + col
    return cells


def means(cells: Cells, shape: tuple[int, int], *values: Floats) -> tuple[Floats, ...]:
    """Return the mean of each array of values per cell, each ``(H, W)``; NaN in cells without points.

    Values are summed in the order of the points: another order changes only the last digits.

    Parameters
    ----------
    cells : Cells
        The cells of the points, ``(n,)``; points outside the grid are left out.
    shape : tuple of int
        Rows and columns.
    *values : Floats
        One value per point, ``(n,)``.
    """
    inside = cells >= 0
    cells = cells[inside]
    size = shape[0] * shape[1]
    count = np.bincount(cells, minlength=size)
    with np.errstate(invalid="ignore"):
        return tuple(
            (np.bincount(cells, value[inside], minlength=size) / count).reshape(shape) for value in values
        )
