"""The share of a tile's cells that have a height in the surface model."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from flexroad.catalog.crs import same, transformer
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Grid
from flexroad.catalog.guard.kept_rasters import kept_raster
from flexroad.catalog.guard.open_raster import ERRORS
from flexroad.catalog.scan.rasters import georeference_fault, heights_fault, quiet
from flexroad.catalog.scan.valid_cells import read_valid
from flexroad.catalog.storage.paths import Location

LOWEST, HIGHEST = -9000.0, 1e6
"""Values outside are undeclared nodata (-9999, 3e38) in any unit; `load` knows the unit and is stricter."""
MAX_CELLS = 100_000_000
"""Largest number of cells that are read of one raster for one tile."""
AS_TEXT = (".xyz", ".gz", ".asc", ".txt")
"""Endings of formats that cannot be read in parts: their files count as without gaps."""


def height_share(grid: Grid, paths: Iterable[Location], crs: str | None = None) -> float | None:
    """Return the share (0 to 1) of a grid's cells whose centre has a height in one of the rasters.

    - `paths`: rasters of heights, north up.
    - `crs`: CRS of rasters without one; None: the grid's.
    - result: None if a raster cannot be read, or not in parts, or has far finer cells than the grid.
    """
    known = np.zeros(grid.shape, np.bool_)
    for path in paths:
        if Path(str(path)).suffix.lower() in AS_TEXT:
            return None
        try:
            # Neighbouring tiles lie on the same files.
            with quiet(), kept_raster(path) as raster:
                own_crs = crs_of(raster.crs.to_wkt() if raster.crs else None, crs, raster.bounds)
                if not _add(known, grid, raster, own_crs):
                    return None
        except (*ERRORS, CatalogError):
            return None
    return float(known.mean())


def _add(known: NDArray[Any], grid: Grid, raster: Any, crs: str | None) -> bool:
    """Set the cells of a grid that have a height in an open raster; return whether it could be read."""
    affine = raster.transform
    if georeference_fault(raster) or heights_fault(raster) or affine.b or affine.d:
        return False
    x, y = np.meshgrid(grid.eastings, grid.northings, sparse=True)
    if crs and not same(crs, grid.crs):
        x, y = transformer(grid.crs, crs).transform(*np.meshgrid(grid.eastings, grid.northings))
    columns, rows = np.floor((x - affine.c) / affine.a), np.floor((y - affine.f) / affine.e)
    inside = (columns >= 0) & (columns < raster.width) & (rows >= 0) & (rows < raster.height)
    if not inside.any():
        return True
    columns, rows = (np.broadcast_to(part, grid.shape)[inside].astype(np.int32) for part in (columns, rows))
    left, top = columns.min(), rows.min()
    window = Window(left, top, columns.max() - left + 1, rows.max() - top + 1)
    if window.width * window.height > MAX_CELLS:
        return False
    values = read_valid(raster, window=window)[rows - top, columns - left]
    heights = np.ma.filled(values * raster.scales[0] + raster.offsets[0], np.nan)
    with np.errstate(invalid="ignore"):
        known[inside] |= (heights > LOWEST) & (heights < HIGHEST)
    return True
