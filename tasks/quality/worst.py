"""The place of a tile with the largest estimated error: a connected piece of road, not a single cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.roads.union_find import Roots, find, least_cells, unite
from flexroad.tasks.types import Bools, Floats

PIECE_M2 = 25.0
"""Area of road that a mean over the tile hides, and that a car or a survey notices (m2)."""
EVERY_WAY = np.ones((3, 3), bool)
"""Neighbours of a cell: those at its corners, too."""


@dataclass(frozen=True)
class Worst:
    """The worst piece of road of a tile."""

    estimate_m: float
    """Largest value that the estimates of `PIECE_M2` of connected road reach (m)."""
    easting: float
    northing: float
    """Centre of the cell with the largest estimate in the piece (m)."""


def worst_piece(estimate: Floats, road: Bools, grid: Grid) -> Worst | None:
    """Return the worst piece of road, None without road.

    Of a tile whose largest connected road is smaller than `PIECE_M2` it is that road.

    - `estimate`: estimated error (m), finite on the road.
    - `road`: road cells.
    - `grid`: the grid of both.
    """
    parts, number = scipy.ndimage.label(road, EVERY_WAY)
    if not number:
        return None
    least = min(least_cells(PIECE_M2, grid.cell), float(np.bincount(parts[road]).max()))
    members = np.flatnonzero(road)
    values = estimate.ravel()[members]
    # Equal estimates in the order of cells, so that the place does not depend on how they are sorted.
    order = members[np.argsort(-values, kind="stable")]
    last = _joined(order, np.full(road.size, -1, np.int32), road.shape[1], least)
    value = float(estimate.ravel()[last])
    parts, _ = scipy.ndimage.label(road & (estimate >= value), EVERY_WAY)
    piece = parts == parts.ravel()[last]
    row, col = np.unravel_index(int(np.argmax(np.where(piece, estimate, -np.inf))), road.shape)
    return Worst(value, float(grid.eastings[col]), float(grid.northings[row]))


@compiled()
def _joined(order: NDArray[np.intp], roots: Roots, cols: int, least: float) -> int:
    """Return the first cell, in the given order, with which a connected piece has ``least`` cells."""
    sizes = np.ones(roots.size, np.int32)
    rows = roots.size // cols
    for i in order:
        roots[i] = i
        row, col = i // cols, i % cols
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(col - 1, 0), min(col + 2, cols)):
                j = r * cols + c
                if roots[j] < 0:
                    continue
                a, b = find(roots, i), find(roots, j)
                if a != b:
                    unite(roots, a, b)
                    sizes[min(a, b)] = sizes[a] + sizes[b]
        if sizes[find(roots, i)] >= least:
            return int(i)
    return int(order[-1])
