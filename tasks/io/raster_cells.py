"""Read the cells of a window of an open raster; of a damaged one, those that can be read."""

from __future__ import annotations

from typing import Any

import numpy as np
from rasterio.enums import Resampling
from rasterio.windows import Window

from flexroad.catalog.headers.open_raster import ERRORS
from flexroad.tasks.io.raster_grid import RasterGrid
from flexroad.tasks.io.raster_header import header
from flexroad.tasks.types import Bools, Floats

Slices = tuple[slice, slice]
"""Rows, from the north, and columns of a file."""


def all_cells(
    src: Any, lattice: RasterGrid, step: int, slices: Slices, resampling: Resampling
) -> tuple[Floats, None]:
    """Return the cells of a window, ``step`` x ``step`` of them as one, rows from the north; and None.

    Raises
    ------
    RasterioError, OSError
        If any of them cannot be read.
    """
    return _cells(src, lattice, step, slices, resampling), None


def readable_cells(
    src: Any, lattice: RasterGrid, step: int, slices: Slices, resampling: Resampling
) -> tuple[Floats, Bools]:
    """Return the cells as `all_cells` does, NaN where they cannot be read, and which these are.

    GDAL reads blocks. A window with a damaged block is halved along borders of blocks, until each part is
    read, or is one block.
    """
    try:
        values = _cells(src, lattice, step, slices, resampling)
        return values, np.zeros(values.shape, np.bool_)
    except ERRORS:
        axis, halves = _halves(src, lattice, step, slices)
    if not halves:
        shape = tuple(-(-(part.stop - part.start) // step) for part in slices)
        return np.full(shape, np.nan), np.ones(shape, np.bool_)
    read = [readable_cells(src, lattice, step, half, resampling) for half in halves]
    values, unreadable = (np.concatenate(parts, axis) for parts in zip(*read, strict=True))
    return values, unreadable


def _halves(src: Any, lattice: RasterGrid, step: int, slices: Slices) -> tuple[int, list[Slices]]:
    """Return the axis along which a window is halved, and its halves; none if it is within one block."""
    rows, cols = slices
    tall, wide = src.block_shapes[0]
    # Blocks are counted from the first row of the file, which may be the southern one.
    row = _border(rows, tall, lattice.height % tall if lattice.northward else 0, step)
    col = _border(cols, wide, 0, step)
    if row and (not col or (rows.stop - rows.start) * wide >= (cols.stop - cols.start) * tall):
        return 0, [(slice(rows.start, row), cols), (slice(row, rows.stop), cols)]
    if col:
        return 1, [(rows, slice(cols.start, col)), (rows, slice(col, cols.stop))]
    return 0, []


def _border(part: slice, block: int, first: int, step: int) -> int:
    """Return the border of blocks, in whole steps, that is nearest to the middle of a slice; 0 if none."""
    middle = (part.start + part.stop) / 2
    border = (first + round((middle - first) / block) * block) // step * step
    return border if part.start < border < part.stop else 0


def _cells(src: Any, lattice: RasterGrid, step: int, slices: Slices, resampling: Resampling) -> Floats:
    """Return the cells of a window, ``step`` x ``step`` of them as one; rows from the north."""
    tall, wide = ([part for part in _whole_and_rest(part, step) if part] for part in slices)
    if len(tall) == len(wide) == 1:
        return _part(src, lattice, step, tall[0], wide[0], resampling)
    return np.block([[_part(src, lattice, step, rows, cols, resampling) for cols in wide] for rows in tall])


def _whole_and_rest(part: slice, step: int) -> tuple[slice | None, slice | None]:
    """Return the whole steps of a slice, and the last step if it has fewer cells, at the end of the file."""
    end = part.stop - (part.stop - part.start) % step
    whole, rest = slice(part.start, end), slice(end, part.stop)
    return (whole if whole.stop > whole.start else None), (rest if rest.stop > rest.start else None)


def _part(
    src: Any, lattice: RasterGrid, step: int, rows: slice, cols: slice, resampling: Resampling
) -> Floats:
    top = lattice.height - rows.stop if lattice.northward else rows.start
    tall, wide = rows.stop - rows.start, cols.stop - cols.start
    how: dict[str, Any] = {"window": Window(cols.start, top, wide, tall)}
    if step > 1:
        how |= {"out_shape": (-(-tall // step), -(-wide // step)), "resampling": resampling}
    values: Floats = src.read(1, **how).astype(np.float64)
    if (src.scales[0], src.offsets[0]) != (1.0, 0.0):
        values = values * src.scales[0] + src.offsets[0]
    has_nan, all_valid = header(src).nan_is_nodata, header(src).all_valid
    # Cells whose nodata value is NaN are NaN already.
    if not all_valid and not (has_nan and step == 1):
        how |= {"resampling": Resampling.mode} if step > 1 else {}
        values[src.read_masks(1, **how) == 0] = np.nan
    return values[::-1] if lattice.northward else values
