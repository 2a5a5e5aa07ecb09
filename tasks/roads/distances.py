"""Distances from cells to the nearest cell of a mask, computed only for wanted cells.

A search from a cell goes row by row away from it, and ends when no further row can be nearer. Gaps in rasters
are mostly narrow, so it is much faster than a distance transform of the complete raster, and as exact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats


def distances(wanted: Bools, mask: Bools) -> Floats:
    """Return the distance from each wanted cell to the nearest cell of the mask, ``(n,)``, in cells.

    - `wanted`, `mask`: the result is in row-major order of the wanted cells, and inf if the mask is empty.
    """
    squares, _ = _nearest(np.flatnonzero(wanted), columns_aside(mask))
    return np.asarray(np.sqrt(squares))


def filled(values: Floats, wanted: Bools | None = None) -> Floats:
    """Return a raster with NaN replaced by the nearest value; ``wanted`` limits this to some cells.

    If several are equally near, the most western is used, then the most northern.
    """
    missing = np.isnan(values)
    holes = missing if wanted is None else missing & wanted
    if not holes.any() or missing.all():
        return values
    result = values.copy()
    result[holes] = values.ravel()[_nearest(np.flatnonzero(holes), columns_aside(~missing))[1]]
    return result


def within(mask: Bools, cell: float, reach_m: float) -> Bools:
    """Return the cells whose centre lies within ``reach_m`` of the centre of a mask cell, ``(H, W)``."""
    # A quotient like 0.3 / 0.1 is a little below 3.
    # One layout in memory is used, because the function is compiled for every layout.
    return _within(np.ascontiguousarray(mask), reach_m / cell + 1e-9)


@compiled()
def _within(mask: Bools, reach: float) -> Bools:
    rows, cols = mask.shape
    aside, near, most = columns_aside(mask), np.zeros((rows, cols), np.bool_), min(int(reach), rows - 1)
    for down in range(-most, most + 1):
        # In a row without a mask cell, `aside` is larger than any column, but not larger than any reach.
        wide = min(int(math.sqrt(reach**2 - down**2)), cols - 1)
        for r in range(max(down, 0), min(rows + down, rows)):
            for c in range(cols):
                near[r, c] |= abs(aside[r - down, c]) <= wide
    return near


@compiled()
def columns_aside(mask: Bools) -> NDArray[np.int32]:
    """Return the column of the nearest cell of a mask in the same row minus the own column, ``(H, W)``.

    In rows without such a cell its absolute value is larger than any distance in the grid.
    """
    rows, cols = mask.shape
    aside = np.empty((rows, cols), np.int32)
    for r in range(rows):
        last = -(rows + cols)
        for c in range(cols):
            if mask[r, c]:
                last = c
            aside[r, c] = last - c
        last = cols + rows + cols
        for c in range(cols - 1, -1, -1):
            if mask[r, c]:
                last = c
            if last - c < -aside[r, c]:
                aside[r, c] = last - c
    return aside


@compiled()
def _nearest(cells: NDArray[np.intp], aside: NDArray[np.int32]) -> tuple[Floats, NDArray[np.intp]]:
    """Return the squared distance from each cell to the nearest mask cell, and that cell's flat index.

    Without a mask cell, they are inf and the cell itself. If several are equally near, the first by column
    and then by row is used.
    """
    rows, cols = aside.shape
    squares, found = np.full(len(cells), np.inf), cells.copy()
    for k in range(len(cells)):
        r, c, nearest = cells[k] // cols, cells[k] % cols, 2 * cols
        for down in range(rows):
            if down * down > squares[k]:
                break
            for row in (r - down, r + down):
                col = c + aside[row, c] if 0 <= row < rows else -1
                if not 0 <= col < cols:
                    continue
                square = float(down * down + (col - c) ** 2)
                if square < squares[k] or (square == squares[k] and col < nearest):
                    squares[k], found[k], nearest = square, row * cols + col, col
    return squares, found


@compiled()
def columns_of(mask: Bools) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Return the columns of the mask cells, row by row, and the number of mask cells before each cell.

    The columns of row ``r`` from ``c`` up to ``d`` are ``columns[before[r * W + c] : before[r * W + d]]``.

    - `columns`: ascending within a row.
    - `before`: number of cells of the mask before each cell.
    """
    rows, wide = mask.shape
    before, number = np.zeros(mask.size + 1, np.int32), 0
    columns = np.empty(mask.size, np.intp)
    for r in range(rows):
        for c in range(wide):
            if mask[r, c]:
                columns[number] = c
                number += 1
            before[r * wide + c + 1] = number
    return columns[:number].copy(), before
