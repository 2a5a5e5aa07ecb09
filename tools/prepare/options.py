"""The options of all ``flexroad prepare`` commands, and the grid of the area.

Limits of the area, the memory and the disk are checked before rasters are made: one wrong point can make the
area thousands of kilometres wide.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.grid import Bounds
from flexroad.catalog.tile import MIN_COVER
from flexroad.pipeline.config.options import INPUTS, RASTERS, option
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import memory
from flexroad.tasks.types import Floats
from flexroad.tools.prepare.output import free_bytes

LONGEST_M = 500_000.0
"""Longest side of an area (m)."""
MAX_CELLS = 10**10
"""100 km x 100 km at 1 m."""
CELL_DISK, PIXEL_DISK = 90, 4
"""Temporary files per cell (eight numbers from points, DSM, DTM, bridges, three bands of road heights, two
masks) and per pixel (colours and their mask) (bytes)."""
ROAD_BYTES = 16
"""Memory of the road mask per cell (bytes): height and number of the highest face, and copies."""
TILE_BYTES = 8
"""Memory per cell of a tile (bytes) when its valid heights are counted."""
SMALLER = "use larger cells (--cell), or prepare a part of the area"


def written(paths: Iterable[Path]) -> datetime:
    """Return the time of the latest file."""
    return datetime.fromtimestamp(max(path.stat().st_mtime for path in paths), UTC)


@dataclass(frozen=True)
class PrepareOptions:
    """The options shared by all commands; the options of the command line are made from these fields."""

    cell_m: float = option(1.0, RASTERS, "Cell of the heights in m.", "METRES", min=0.01)
    dop_cell_m: float = option(0.5, RASTERS, "Pixel of the orthophoto in m.", "METRES", min=0.01)
    crs: str | None = option(None, INPUTS, "CRS of inputs without one, e.g. EPSG:2994.", "CRS")
    to_crs: str | None = option(None, RASTERS, "CRS of the rasters; default: the input's, in metres.", "CRS")
    height_unit: Literal["metre", "foot", "us-foot"] | None = option(
        None, INPUTS, "Unit of heights if the CRS has none; default: the unit of the plan."
    )
    roads: Path | None = option(
        None,
        INPUTS,
        "Roads: polygons, a raster or a mesh, for the mask; or lines; FILE|layername=NAME for one layer.",
        "FILE",
    )
    """A mesh is projected vertically; lines make no mask."""
    roads_where: str | None = option(None, INPUTS, "SQL condition on --roads: \"class = 'road'\".", "SQL")
    tile_size_m: float = option(250, RASTERS, "Side of a tile in m; a smaller area is one tile.", "METRES")
    min_cover: float = MIN_COVER
    """Tiles with a DSM height in less than this share of their cells are left out."""
    date: datetime | None = option(
        None, INPUTS, "Date of the survey; default: the date of the files.", "YYYY-MM-DD"
    )
    assumed_date: datetime | None = None
    """Assumed date if neither the option nor the files give a date; not on the command line."""
    dataset: str | None = None
    """Name of the data in reports; None: the name of the input."""

    @property
    def step_m(self) -> float:
        """The larger of cell and pixel (m), a multiple of the smaller; grids are aligned to its multiples."""
        small, large = sorted((self.cell_m, self.dop_cell_m))
        pair = f"--cell {self.cell_m:g} --dop-cell {self.dop_cell_m:g}"
        if not small > 0:
            raise ConfigError(
                f"--cell {self.cell_m:g} --dop-cell {self.dop_cell_m:g}: both must be greater than 0 m"
            )
        if abs(large / small - round(large / small)) > 1e-9:
            raise ConfigError(
                f"{pair}: one must be a multiple of the other; "
                f"use --dop-cell {self.cell_m / max(1, round(self.cell_m / self.dop_cell_m)):g}"
            )
        return large


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
    """Check all limits; return the grid of an area, on multiples of the cell and the pixel.

    - `common`: cell, pixel, tile size and roads.
    - `source`: the file, for messages.
    - `photo`: whether there is an orthophoto.
    - `per_cell`: memory of steps that need the complete area (bytes per cell).
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
    step = common.step_m
    west, south = (math.floor(side / step) * step for side in bounds[:2])
    east, north = (math.ceil(side / step) * step for side in bounds[2:])
    return Grid.covering(crs, (west, south, max(east, west + step), max(north, south + step)), common.cell_m)


def check_disk(out: Path, needed: float, what: str, remedy: str) -> None:
    """Check that temporary files fit on the disk of a folder.

    - `out`: the folder; it need not exist.
    - `needed`: estimated size (bytes).
    - `what`: the input, for the beginning of the message.
    """
    free = free_bytes(out)
    if needed > free:
        raise ConfigError(
            f"{what} would need about {needed / memory.GIB:,.1f} GiB of temporary files in {out}, where "
            f"{free / memory.GIB:,.1f} GiB are free; {remedy}, or free disk space"
        )


def check_extent(name: str, plan: Floats, before: Bounds | None = None) -> Bounds:
    """Check that no new point is too far away; return the bounds of the new and the earlier points.

    - `name`: the file, for the message.
    - `plan` ``(2, n)``: eastings and northings (m).
    - `before`: bounds of the earlier points: west, south, east, north (m).
    """
    bounds = np.array([plan.min(axis=1), plan.max(axis=1)])
    if before is not None:
        bounds = np.array([np.minimum(bounds[0], before[:2]), np.maximum(bounds[1], before[2:])])
    if np.ptp(bounds, axis=0).max() <= LONGEST_M:
        west, south, east, north = map(float, bounds.ravel())
        return west, south, east, north
    centre = np.median(plan, axis=1) if before is None else np.add(before[:2], before[2:]) / 2
    distance = np.abs(plan - centre[:, None]).max(axis=0)
    east, north = plan[:, distance.argmax()]
    raise CatalogError(
        f"{name} has a point at easting {east:.2f} and northing {north:.2f} (m), "
        f"{distance.max() / 1000:,.0f} km from the others, but an area has at most "
        f"{LONGEST_M / 1000:.0f} km; remove points with wrong coordinates, or prepare distant files apart"
    )
