"""Clean a predicted road mask: close gaps, fill holes, drop small pieces.

Widths and areas are in metres and m2 for any cell size. Pieces and holes that touch the edge of the grid may
continue beyond it, so they are kept.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.distances import within
from flexroad.tasks.types import Bools, TileData

cv2 = lazy("cv2")

SLACK = 1e-9
"""Tolerance of sizes as a fraction of a cell, so that 0.6 m is three cells of 0.2 m."""


CLOSE_M = 2.0
"""Gaps up to this width (m) are closed, such as shadows of poles."""
FILL_M2, DROP_M2 = 10.0, 25.0
"""Holes up to a car's area (m2) are filled; pieces smaller than two parking bays (m2) are dropped."""
CORRIDOR_M = 5.0
"""Width of the corridor around the roads of the catalog (m): widths and places of centre lines are rough."""

Cleanup = Literal["none", "pieces", "corridor"]


def clean(mask: Bools, data: TileData, cleanup: Cleanup) -> Bools:
    """Return the cleaned mask, ``(H, W)``; cells beyond the survey are never added.

    Gaps are closed before areas are measured, so that a road in fragments is one piece.
    """
    if cleanup == "none":
        return mask
    cell = data.grid.cell
    if cleanup == "corridor":
        mask = mask & within(_roads(data), cell, CORRIDOR_M)
    filled = fill(close(mask, cell, CLOSE_M), cell, FILL_M2)
    return drop(mask | (filled & ~data.beyond_extent()), cell, DROP_M2)


def close(mask: Bools, cell: float, width_m: float) -> Bools:
    """Close gaps and notches up to ``width_m`` wide, ``(H, W)``; cells are only added.

    A morphological closing with a disc one cell wider than the gap. Outside the grid there is no road.
    """
    n = math.floor(width_m / cell + SLACK) + 1
    if n == 1:
        return mask
    centre = np.arange(n) - (n - 1) / 2
    disc = (centre[:, None] ** 2 + centre**2 <= (n / 2) ** 2).astype(np.uint8)
    # The centre of a disc of even size lies between cells, so the erosion needs the mirrored anchor.
    anchor, mirrored = (n // 2, n // 2), (n - 1 - n // 2, n - 1 - n // 2)
    wide = cv2.dilate(np.pad(_bytes(mask), n), disc, anchor=anchor)
    closed: Bools = cv2.erode(wide, disc, anchor=mirrored)[n:-n, n:-n].astype(bool)
    return closed


def fill(mask: Bools, cell: float, area_m2: float) -> Bools:
    """Fill holes of at most ``area_m2``, ``(H, W)``; holes are 4-connected."""
    pieces, areas, inner = _pieces(~mask, cell, connectivity=4)
    small: Bools = inner & (areas <= area_m2 + SLACK)
    return np.logical_or(mask, small[pieces])


def drop(mask: Bools, cell: float, area_m2: float) -> Bools:
    """Drop pieces smaller than ``area_m2``, ``(H, W)``; pieces are 8-connected."""
    pieces, areas, inner = _pieces(mask, cell, connectivity=8)
    small: Bools = inner & (areas < area_m2 - SLACK)
    return np.logical_and(mask, ~small[pieces])


def _pieces(mask: Bools, cell: float, connectivity: int) -> tuple[NDArray[np.int32], Any, Bools]:
    """Return each cell's piece (0: no piece), the areas of pieces (m2), and which touch no grid edge."""
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(_bytes(mask), connectivity=connectivity)
    inner = np.ones(count, bool)
    for edge in (pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]):
        inner[edge] = False
    inner[0] = False
    return pieces, stats[:, cv2.CC_STAT_AREA] * cell**2, inner


def _roads(data: TileData) -> Bools:
    """Return the cells of the catalog's roads."""
    if data.roads is None:
        raise TaskError(
            "cleanup: corridor needs roads, which the tile lacks; give --roads to `flexroad catalog "
            "rasters`, or set segment.cleanup: pieces",
            layer="roads",
        )
    return rasterise.rasterise_roads(data)


def _bytes(mask: Bools) -> NDArray[np.uint8]:
    return np.ascontiguousarray(mask, np.uint8)
