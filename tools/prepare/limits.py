"""Limits of the area of a ``prepare`` command, and of the memory and the disk that its rasters take.

They are checked before rasters are made: one point with wrong coordinates makes an area of thousands of
kilometres.
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.grid import Bounds
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import memory
from flexroad.tools.prepare.options import PrepareOptions

LONGEST_M = 500_000.0
"""Longest side of an area (m)."""
MAX_CELLS = 10**10
"""100 km x 100 km at 1 m."""
CELL_DISK, PIXEL_DISK = 90, 4
"""Temporary files per cell and per pixel (bytes): eight numbers from its points; DSM, DTM, bridges, three
bands of road heights and two masks; colours and their mask."""
ROAD_BYTES = 16
"""Memory of the road mask per cell (bytes): height and number of the highest face, and copies."""
TILE_BYTES = 8
"""Memory per cell of a tile (bytes) when its valid heights are counted."""
SMALLER = "use larger cells (--cell), or prepare a part of the area"


def prepared_grid(
    bounds: Bounds,
    crs: str,
    common: PrepareOptions,
    source: str,
    out: Path,
    *,
    photo: bool,
    per_cell: int = 0,
) -> Grid:
    """Return the grid of an area: on multiples of the cell and the pixel, after all limits are checked.

    - `bounds`: bounds of the data (m).
    - `crs`: CRS of the rasters.
    - `common`: cell, pixel, tile size and roads.
    - `source`: what the data is, for messages: a file.
    - `out`: output folder.
    - `photo`: whether there is an orthophoto.
    - `per_cell`: memory of the steps that hold the complete area (bytes per cell).
    """
    west, south, east, north = bounds
    sides = east - west, north - south
    if not max(sides) <= LONGEST_M or not all(map(math.isfinite, bounds)):
        raise CatalogError(
            f"{source} reaches from easting {west:.0f} to {east:.0f}, northing {south:.0f} to {north:.0f}, "
            f"but an area has at most {LONGEST_M / 1000:.0f} km; correct its coordinates or its CRS, or "
            "prepare a part of it"
        )
    cells, pixels = (float(np.prod(np.divide(sides, size))) for size in (common.cell_m, common.dop_cell_m))
    for name, count, size in (
        ("--cell", cells, common.cell_m),
        ("--dop-cell", pixels * photo, common.dop_cell_m),
    ):
        if count > MAX_CELLS:
            raise CatalogError(
                f"{source} has {sides[0]:.0f} x {sides[1]:.0f} m, {count:.2g} cells with {name} {size:g}, "
                f"but an area has at most {MAX_CELLS:.0e}; use a larger {name}, or prepare a part of the area"
            )
    tile = min(cells, (common.tile_size_m / common.cell_m) ** 2)
    needed = cells * (per_cell + ROAD_BYTES * (common.roads is not None)) + TILE_BYTES * tile
    memory.check(needed, f"the rasters of {source}, {cells:.3g} cells,", SMALLER)
    check_disk(out, CELL_DISK * cells + PIXEL_DISK * pixels * photo, f"the rasters of {source}", SMALLER)
    return _aligned(bounds, crs, common.cell_m, common.step_m)


def _aligned(bounds: Bounds, crs: str, cell: float, step: float) -> Grid:
    """Return the smallest grid on multiples of ``step`` (m) that covers the bounds."""
    west, south, east, north = (side / step for side in bounds)
    west, south = math.floor(west) * step, math.floor(south) * step
    east, north = math.ceil(east) * step, math.ceil(north) * step
    return Grid.covering(crs, (west, south, max(east, west + step), max(north, south + step)), cell)


def check_disk(out: Path, needed: float, what: str, remedy: str) -> None:
    """Check that temporary files fit on the disk of a folder.

    - `out`: the folder; it need not exist.
    - `needed`: estimated size (bytes).
    - `what`: what needs it: the beginning of the message.
    - `remedy`: what the user can do.
    """
    existing = next(folder for folder in (out.absolute(), *out.absolute().parents) if folder.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise ConfigError(
            f"{what} would need about {needed / memory.GIB:,.1f} GiB of temporary files in {out}, where "
            f"{free / memory.GIB:,.1f} GiB are free; {remedy}, or free disk space"
        )


def check_extent(name: str, plan: NDArray[np.float64], before: Bounds | None) -> None:
    """Check that new points are not too far from each other and from the points before them.

    - `name`: the file, for the message.
    - `plan` ``(2, n)``: eastings and northings (m).
    - `before`: bounds of the points before: west, south, east, north (m).
    """
    bounds = np.array([plan.min(axis=1), plan.max(axis=1)])
    if before is not None:
        bounds = np.array([np.minimum(bounds[0], before[:2]), np.maximum(bounds[1], before[2:])])
    if np.ptp(bounds, axis=0).max() <= LONGEST_M:
        return
    centre = np.median(plan, axis=1) if before is None else np.add(before[:2], before[2:]) / 2
    distance = np.abs(plan - centre[:, None]).max(axis=0)
    east, north = plan[:, distance.argmax()]
    raise CatalogError(
        f"{name} has a point at easting {east:.2f} and northing {north:.2f} (m), "
        f"{distance.max() / 1000:,.0f} km from the others, but an area has at most "
        f"{LONGEST_M / 1000:.0f} km; remove points with wrong coordinates, or prepare distant files apart"
    )
