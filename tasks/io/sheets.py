"""Resample the files of one layer together, so that no cell at a file's border lacks its neighbours.

Interpolation uses the cells around a place. At the border of a file, some of these cells are in the next
file. Files of one lattice are joined. If the next file has another lattice, a file is extended by the cells
that interpolation needs, with heights interpolated in the next file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling

from flexroad.catalog.crs import transformer
from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.io.raster import EXACT, RasterWindow, fill_from, joined, resample_to, same_lattice
from flexroad.tasks.io.raster_grid import RasterGrid
from flexroad.tasks.types import Bools, Floats


def shared_m2(extent: Bounds | None, bounds: Bounds) -> float:
    """Return the area that an extent shares with a tile (m2), 0 if it is None."""
    if extent is None:
        return 0.0
    width = min(extent[2], bounds[2]) - max(extent[0], bounds[0])
    height = min(extent[3], bounds[3]) - max(extent[1], bounds[1])
    return max(width, 0.0) * max(height, 0.0)


def reach_m(patches: Sequence[RasterWindow], grid: Grid) -> float:
    """Return how far beyond a grid heights are needed for the heights at its edge (m); 0 for one lattice.

    Cells beyond a file's border are interpolated in files of other lattices, and so on.
    """
    lattices = [group[0].lattice for group in same_lattice(patches)]
    if len(lattices) < 2:
        return 0.0
    cells = [(lattice, *lattice.cell_of(grid)) for lattice in lattices]
    coarsest = max(max(lattice.dx / across, lattice.dy / along) for lattice, across, along in cells)
    return len(lattices) * coarsest * grid.cell


def lay_classes(patches: Sequence[RasterWindow], grid: Grid) -> Floats:
    """Return files of classes on a grid's cells, ``(H, W)``; see `lay_heights`."""
    return _filled(sorted(patches, key=_is_warped), grid, Resampling.nearest)


def lay_heights(patches: Sequence[RasterWindow], grid: Grid) -> Floats:
    """Return files of heights on a grid's cells, ``(H, W)``; NaN where no file has a value.

    Where files overlap, the first file with a value is used. Files in the grid's CRS come before other files,
    because a transformation loses precision.
    """
    ordered = sorted(patches, key=_is_warped)
    fitting = [patch for patch in ordered if patch.lattice.fits(grid)]
    loose = [patch for patch in ordered if not patch.lattice.fits(grid)]
    groups = same_lattice(loose)
    if not loose or (len(groups) == 1 and not fitting):
        return _filled(fitting or joined(loose), grid, Resampling.bilinear)
    if fitting:
        groups.insert(0, fitting)
    values = np.full(grid.shape, np.nan)
    laid = _resampled_together(groups, grid)
    of_group = {id(patch): heights for group, heights in zip(groups, laid, strict=True) for patch in group}
    for patch in ordered:
        np.copyto(values, of_group[id(patch)], where=np.isnan(values) & covered(patch, grid))
    return values


def covered(patch: RasterWindow, grid: Grid) -> Bools:
    """Return the cells of a grid whose centres lie in cells of a file with a value, ``(H, W)``."""
    return ~np.isnan(resample_to(patch, grid, Resampling.nearest))


def _is_warped(patch: RasterWindow) -> bool:
    return bool(patch.lattice.crs)


def _filled(parts: Sequence[RasterWindow], grid: Grid, resampling: Resampling) -> Floats:
    values = np.full(grid.shape, np.nan)
    for part in parts:
        fill_from(part, grid, values, resampling)
    return values


def _resampled_together(groups: Sequence[Sequence[RasterWindow]], grid: Grid) -> list[Floats]:
    """Return each group of files of one lattice on a grid's cells, interpolated with the other groups."""
    own = RasterGrid(grid.west, grid.north, grid.cell, grid.cell, grid.width, grid.height)
    sheets = [
        replace(group[0], values=_filled(group, grid, Resampling.bilinear), lattice=own)
        if group[0].lattice.fits(grid)
        else joined(group)[0]
        for group in groups
    ]
    # The mean of an incomplete step is not at its centre, so heights of other files are preferred.
    known = [
        replace(sheet, values=np.where(sheet.share < 1 - EXACT, np.nan, sheet.values))
        if sheet.share is not None
        else sheet
        for sheet in sheets
    ]
    # The coarsest comes first: its cells reach farthest beyond its border. Finer sheets then interpolate up
    # to their own borders.
    for number in sorted(range(len(sheets)), key=lambda number: -_cell_m2(sheets[number].lattice, grid)):
        others = [*known[:number], *known[number + 1 :]]
        known[number] = _extended(known[number], sheets[number], others, grid)
    return [
        resample_to(sheet if sheet.lattice.fits(grid) else wide, grid, Resampling.bilinear)
        for sheet, wide in zip(sheets, known, strict=True)
    ]


def _cell_m2(lattice: RasterGrid, grid: Grid) -> float:
    """Return the area of a cell of a lattice, in cells of a grid."""
    across, along = lattice.cell_of(grid)
    return lattice.dx / across * lattice.dy / along


def _extended(
    known: RasterWindow, sheet: RasterWindow, others: Sequence[RasterWindow], grid: Grid
) -> RasterWindow:
    """Return a sheet with cells around it, and cells without a value, interpolated in other sheets.

    - `known`: the sheet, with NaN where heights of other sheets are preferred.
    """
    lattice = sheet.lattice
    across, along = lattice.cell_of(grid)
    reach = 1 + math.ceil(max(across / lattice.dx, along / lattice.dy))
    wide = lattice.cut(slice(-reach, lattice.height + reach), slice(-reach, lattice.width + reach))
    values = np.pad(known.values, reach, constant_values=np.nan)
    for other in others:
        rows, cols = np.nonzero(np.isnan(values))
        x, y = wide.west + (cols + 0.5) * wide.dx, wide.north - (rows + 0.5) * wide.dy
        if lattice.crs != other.lattice.crs:
            x, y = transformer(lattice.crs or grid.crs, other.lattice.crs or grid.crs).transform(x, y)
        values[rows, cols] = _heights_at(other, x, y)
    own = np.pad(sheet.values, reach, constant_values=np.nan)
    return replace(sheet, values=np.where(np.isnan(values), own, values), lattice=wide)


def _heights_at(sheet: RasterWindow, x: NDArray[np.floating], y: NDArray[np.floating]) -> Floats:
    """Return bilinear heights at places, ``(n,)``; NaN where the cell there has no value.

    As in `resample_to`, cells without a value have no weight.
    """
    lattice = sheet.lattice
    col, row = (x - lattice.west) / lattice.dx, (lattice.north - y) / lattice.dy
    padded = np.pad(sheet.values, 1, constant_values=np.nan)
    inside = (col >= 0) & (col < lattice.width) & (row >= 0) & (row < lattice.height)
    col, row = np.where(inside, col, 0.0), np.where(inside, row, 0.0)
    inside &= ~np.isnan(sheet.values[row.astype(np.intp), col.astype(np.intp)])
    left, top = np.floor(col + 0.5).astype(np.intp), np.floor(row + 0.5).astype(np.intp)
    right, below = col + 0.5 - left, row + 0.5 - top
    total, weights = np.zeros(len(x)), np.zeros(len(x))
    for down in (0, 1):
        for over in (0, 1):
            height = padded[top + down, left + over]
            weight = np.where(down, below, 1 - below) * np.where(over, right, 1 - right) * ~np.isnan(height)
            total += weight * np.nan_to_num(height)
            weights += weight
    return np.where(inside, total / np.where(inside, weights, 1.0), np.nan)
