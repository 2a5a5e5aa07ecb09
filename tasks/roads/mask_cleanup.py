"""Clean a road mask: combine it with a second source, close gaps, fill holes, drop small pieces.

Widths and areas are in metres and m2 for any cell size. Pieces and holes that touch the edge of the grid may
continue beyond it, so they are kept.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.lazy import lazy
from flexroad.tasks import options
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.distances import within
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.types import Bools, TileData

cv2 = lazy("cv2")

SLACK = 1e-9
"""Tolerance of sizes as a fraction of a cell, so that 0.6 m is three cells of 0.2 m."""


class Cleanup(options.Options):
    """Steps of the cleanup, in this order; 0 or none skips a step."""

    fuse: Literal["none", "union", "intersection", "corridor"] = Field(
        "none",
        description="combine with a second source: union: road in either; intersection: road in both; "
        "corridor: the mask within corridor_m of the second source",
    )
    fuse_with: Literal["roads", "road_mask"] = Field(
        "roads", description="the second source: the catalog's vectors or its road mask"
    )
    roads: rasterise.Options = Field(
        rasterise.DEFAULTS, description="selection and width of the vectors: as with method: vector"
    )
    corridor_m: float = Field(5.0, ge=0, le=100, description="width of the corridor around it (m)")
    close_m: float = Field(2.0, ge=0, le=50, description="close gaps up to this width (m)")
    fill_m2: float = Field(10.0, ge=0, description="fill holes up to this area (m2)")
    drop_m2: float = Field(25.0, ge=0, description="drop pieces smaller than this area (m2)")


NOTHING = Cleanup(close_m=0, fill_m2=0, drop_m2=0)
"""Options that leave every mask unchanged."""


def clean(mask: Bools, data: TileData, options: Cleanup) -> Bools:
    """Return the cleaned mask, ``(H, W)``; cells beyond the survey are never added.

    Gaps are closed before areas are measured, so that a road in fragments counts as one piece.
    """
    cell = data.grid.cell
    fused = mask if options.fuse == "none" else fuse(mask, _second(data, options), cell, options)
    filled = fill(close(fused, cell, options.close_m), cell, options.fill_m2)
    return drop(fused | (filled & ~beyond_extent(data)), cell, options.drop_m2)


def fuse(mask: Bools, second: Bools, cell: float, options: Cleanup) -> Bools:
    """Return the mask combined with a second one by ``options.fuse``, ``(H, W)``."""
    match options.fuse:
        case "union":
            return mask | second
        case "intersection":
            return mask & second
        case "corridor":
            return mask & within(second, cell, options.corridor_m)
        case _:
            return mask


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
    """Return each cell's piece (0: not in the mask), the pieces' areas (m2), and which touch no grid edge."""
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(_bytes(mask), connectivity=connectivity)
    inner = np.ones(count, bool)
    for edge in (pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]):
        inner[edge] = False
    inner[0] = False
    return pieces, stats[:, cv2.CC_STAT_AREA] * cell**2, inner


def _second(data: TileData, options: Cleanup) -> Bools:
    if options.fuse_with == "road_mask" and data.road_mask is not None:
        return data.road_mask
    if options.fuse_with == "roads" and data.roads is not None:
        return rasterise.rasterise_roads(data, options.roads)
    raise TaskError(
        f"cleanup.fuse: {options.fuse} needs {options.fuse_with}, which the tile lacks; give "
        f"--{options.fuse_with.replace('_', '-')} to `flexroad catalog rasters`, or set cleanup.fuse: none",
        layer=options.fuse_with,
    )


def _bytes(mask: Bools) -> NDArray[np.uint8]:
    return np.ascontiguousarray(mask, np.uint8)
