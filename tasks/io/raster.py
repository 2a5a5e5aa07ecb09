"""Read the window of a raster file that covers a grid, and resample it to the grid's cells."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rasterio.enums import Resampling
from rasterio.io import MemoryFile
from rasterio.vrt import WarpedVRT
from rasterio.warp import reproject
from rasterio.windows import Window

from flexroad.catalog.crs import short
from flexroad.catalog.grid import Grid
from flexroad.catalog.guard.open_raster import ERRORS, has_own_blocks, kept_raster, open_raster
from flexroad.catalog.guard.source_files import InputRejected, files_of, read_through
from flexroad.catalog.scan.rasters import heights_fault, transparent
from flexroad.catalog.storage.paths import Location, is_remote
from flexroad.catalog.text import reason
from flexroad.tasks.errors import TaskError, Unusable
from flexroad.tasks.io.raster_grid import RasterGrid, file_crs, header, place
from flexroad.tasks.types import Bools, Floats

T = TypeVar("T")

EXACT = 1e-9
"""Largest error of transformed positions, in cells; GDAL's default is 0.125, and 0 would mean the default."""
STRIP = 64
"""Number of rows of means that are computed at a time if an alpha band is read cell by cell."""
Slices = tuple[slice, slice]
"""Rows, from the north, and columns of a file."""


class Unreadable(Unusable):
    """A file that is missing or broken, so that its position is unknown."""


class DamagedCells(Unreadable):
    """A file that can be opened, but some of its cells cannot be read."""


@dataclass(frozen=True, eq=False)
class RasterWindow:
    """The cells of one file under a grid."""

    name: str
    """Name of the file in messages: ``dsm a.tif``."""
    file: str
    """Full path or address."""
    values: Floats
    """``(rows, cols)``, row 0 in the north; NaN where the file has nodata."""
    lattice: RasterGrid
    """The lattice of the cells, in the CRS of the tile or of the file (`RasterGrid.crs`)."""
    unit: str
    """Unit of the values, declared by the band or (for heights) given by the caller; else empty."""
    crs: str | None
    """CRS of the file, else the CRS given by the caller."""
    unit_assumed: bool = False
    """Whether the file does not declare the unit."""
    step: int = 1
    """Number of cells of the file along an axis that were read as one cell."""
    share: Floats | None = None
    """Share of each joined cell that the file has, ``(rows, cols)``; None if it has all of every cell."""
    unreadable: Bools | None = None
    """Cells that cannot be read, ``(rows, cols)``, because the file is damaged; None if all can be read."""
    fault: Unusable | None = None
    """Why these cells cannot be read; None if all can be read."""

    @property
    def file_lattice(self) -> RasterGrid:
        """The lattice of the file's own cells in the window."""
        grid, n = self.lattice, self.step
        return replace(grid, dx=grid.dx / n, dy=grid.dy / n, width=grid.width * n, height=grid.height * n)

    def reached(self, grid: Grid) -> Bools:
        """Return the cells of a grid that lie within the window and could be read, ``(H, W)``."""
        reached = self.lattice.reached(grid)
        if self.unreadable is not None:
            reached[reached] = ~self.unreadable[self.lattice.cells_at(grid, reached)]
        return reached


def read_window(
    path: Location,
    name: str,
    grid: Grid,
    core: Grid,
    crs: str | None,
    heights: bool = False,
    reproject: bool = False,
    missing: frozenset[str] | None = None,
) -> RasterWindow | None:
    """Read the part of a file that covers a grid.

    If a cell of the grid has many cells of the file, several cells are read as one, from overviews if
    possible. So the memory does not depend on the resolution of the file. Unreadable cells of a damaged file
    are left out (`RasterWindow.unreadable`).

    - `name`: name of the file in messages: ``dsm a.tif``.
    - `core`: position of a file without georeference, if it has as many cells.
    - `crs`: CRS of a file that declares none.
    - `heights`: whether the file must have heights: one band of real numbers. Joined cells then have the
      mean, else the most frequent of their values.
    - `reproject`: whether the file may be in another CRS than the grid; the window is then on its own
      lattice.
    - `missing`: see `read_raster`.
    - result: None if the file does not overlap the grid.
    """

    def read(src: Any, damaged: bool = False) -> RasterWindow | None:
        resampling = Resampling.average if heights else Resampling.mode
        fault = heights_fault(src) if heights else None
        if fault:
            raise Unusable(f"{name} {fault}", str(path))
        lattice = place(src, path, name, grid, core, crs, reproject)
        slices = lattice.window_for(grid) if lattice else None
        if lattice is None or slices is None:
            return None
        step = lattice.step_for(grid)
        slices = lattice.whole_steps(step, *slices)
        cells = src, lattice, step, slices, resampling
        values, unreadable = readable_cells(*cells) if damaged else (_cells(*cells), None)
        shown, unit = lattice.cut(*slices).coarser(step), src.units[0] or ""
        return RasterWindow(
            name,
            str(path),
            values,
            shown,
            unit,
            file_crs(src, crs),
            step=step,
            share=_share(lattice.cut(*slices), step),
            unreadable=unreadable,
        )

    try:
        return read_raster(path, name, read, kept_raster, missing)
    except DamagedCells as error:
        if not (isinstance(path, Path) and has_own_blocks(path)):
            raise
        window = read_raster(path, name, partial(read, damaged=True), kept_raster, missing)
        if window is None or window.unreadable is None or window.unreadable.all():
            raise
        return replace(window, fault=error)


def read_raster(
    path: Location,
    name: str,
    read: Callable[[Any], T],
    by: Callable[[Location], AbstractContextManager[Any]] = open_raster,
    missing: frozenset[str] | None = None,
) -> T:
    """Return the result of a function that reads an open raster.

    Only a file whose own bytes are at fault is `Unreadable`, so that it may be left out. If a disk or object
    storage fails, results must not be stored as if the file had been read.

    - `path`, `name`: as in `read_window`.
    - `read`: takes the open raster.
    - `missing`: full names of the files that are known to be missing; None if that is not known.
    """

    def attempt() -> T:
        src = None
        try:
            with by(path) as src:
                return read(src)
        except ERRORS as error:
            raise _fault(path, name, error, missing, src is not None) from error

    try:
        return attempt()
    except Unreadable:
        # The system may have failed temporarily; a damaged file fails again.
        return attempt()


def _fault(
    path: Location, name: str, error: Exception, missing: frozenset[str] | None, opened: bool
) -> TaskError:
    """Return the error of a file that could not be opened or read; see `read_raster`."""
    absent = missing is not None and str(path) in missing
    if isinstance(error, FileNotFoundError) or _is_gone(path):
        if missing is None or absent:
            return Unreadable(f"{name} is missing; restore it or build the catalog again", str(path))
        return TaskError(f"{name} was there when the run looked, and is missing now; run again", str(path))
    why = reason(error.__cause__ or error)
    if isinstance(path, Path):
        if unread := _unread(path):
            text = f"{name} cannot be read: {unread}; mend that and run again"
            return Unreadable(text, str(path)) if absent else TaskError(text, str(path))
    elif not isinstance(error, InputRejected):
        return TaskError(f"{name} cannot be read: {why}; run again, or repair it", str(path))
    if isinstance(error, InputRejected):
        return Unreadable(f"{name} {error}", str(path))
    kind = DamagedCells if opened else Unreadable
    return kind(f"{name} cannot be read: {why}; fetch it again", str(path))


def _is_gone(path: Location) -> bool:
    """Return whether there is no such file on disk."""
    if is_remote(path):
        return False
    try:
        path.stat()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return False


def _unread(path: Path) -> str:
    """Return why the system cannot read all bytes of a raster on disk; empty if it can."""
    try:
        for file in files_of(path):
            read_through(file)
    except InputRejected:
        return ""
    except OSError as error:
        which = f" ({error.filename})" if error.filename not in (None, str(path)) else ""
        return f"{error.strerror or error}{which}"
    return ""


def resample_to(patch: RasterWindow, grid: Grid, resampling: Resampling) -> Floats:
    """Return the patch on the grid's cells, ``(H, W)``; NaN where it has no value.

    Cells that coincide are copied. Other cells are resampled: source cells without a value have no weight. A
    cell whose centre lies in a source cell without a value gets no value, so that voids keep their size.
    """
    lattice = patch.lattice
    if lattice.crs:
        return _warped(patch, grid, resampling)
    values = np.full(grid.shape, np.nan)
    if cells := _coinciding(lattice, grid):
        values[cells] = patch.values
        return values
    reproject(
        patch.values,
        values,
        src_transform=lattice.transform,
        dst_transform=grid.transform,
        src_crs=grid.crs,
        dst_crs=grid.crs,
        src_nodata=np.nan,
        dst_nodata=np.nan,
        resampling=resampling,
        # GDAL would estimate the ratio of the cells from the window. A cell of two overlapping windows could
        # then have two values.
        XSCALE=_scale(lattice.dx / grid.cell),
        YSCALE=_scale(lattice.dy / grid.cell),
    )
    return values


def fill_from(patch: RasterWindow, grid: Grid, values: Floats, resampling: Resampling) -> None:
    """Fill the cells of a grid that have no value, ``(H, W)``, from a patch, in place; see `resample_to`."""
    if cells := _coinciding(patch.lattice, grid):
        part = values[cells]
        np.copyto(part, patch.values, where=np.isnan(part))
    else:
        np.copyto(values, resample_to(patch, grid, resampling), where=np.isnan(values))


def _coinciding(lattice: RasterGrid, grid: Grid) -> tuple[slice, slice] | None:
    """Return the cells of a grid that a part of a file covers, None if their cells do not coincide."""
    if not lattice.fits(grid):
        return None
    row = round((grid.north - lattice.north) / grid.cell)
    col = round((lattice.west - grid.west) / grid.cell)
    return slice(row, row + lattice.height), slice(col, col + lattice.width)


def _warped(patch: RasterWindow, grid: Grid, resampling: Resampling) -> Floats:
    """Return a patch in another CRS on the grid's cells, ``(H, W)``.

    Every cell is transformed by itself (`EXACT`), so that overlapping windows have equal values.
    """
    lattice = patch.lattice
    rows, cols = patch.values.shape
    cell_x, cell_y = lattice.cell_of(grid)
    place = {"transform": lattice.transform, "width": cols, "height": rows}
    with MemoryFile() as memory:
        with memory.open(driver="GTiff", count=1, dtype="float64", nodata=np.nan, **place) as target:
            target.write(patch.values, 1)
        with (
            memory.open() as source,
            WarpedVRT(
                source,
                # GeoTIFF cannot store every CRS.
                src_crs=lattice.crs,
                crs=grid.crs,
                transform=grid.transform,
                width=grid.width,
                height=grid.height,
                resampling=resampling,
                nodata=np.nan,
                tolerance=EXACT,
                XSCALE=_scale(lattice.dx / cell_x),
                YSCALE=_scale(lattice.dy / cell_y),
            ) as warped,
        ):
            values: Floats = warped.read(1)
    return values


def _scale(ratio: float) -> float:
    """Return the ratio of cells for GDAL, which averages below 0.95: wanted only from two cells in one on.

    Only averages over a whole number of cells are exact on a plane. The ratio of a warped file differs a
    little from window to window, so the number must not change near usual cell sizes.
    """
    return 1 / max(1, math.floor(1 / ratio + 0.2))


def joined(patches: Sequence[RasterWindow]) -> list[RasterWindow]:
    """Return the windows, joined if they have one lattice, so that no seam is interpolated.

    Where windows overlap, the first one with a value is used.
    """
    return [_union(group) if len(group) > 1 else group[0] for group in same_lattice(patches)]


def same_lattice(patches: Sequence[RasterWindow]) -> list[list[RasterWindow]]:
    """Return the windows in groups of one lattice each, in the order of the first of each group."""
    groups: list[list[RasterWindow]] = []
    for patch in patches:
        group = next((g for g in groups if g[0].lattice.continues(patch.lattice)), None)
        if group is None:
            groups.append([patch])
        else:
            group.append(patch)
    return groups


def _union(group: Sequence[RasterWindow]) -> RasterWindow:
    lattice = group[0].lattice
    cells = [patch.lattice.cells_in(lattice) for patch in group]
    top, left = min(rows.start for rows, _ in cells), min(cols.start for _, cols in cells)
    bottom, right = max(rows.stop for rows, _ in cells), max(cols.stop for _, cols in cells)
    total, share = np.zeros((2, bottom - top, right - left))
    for patch, (rows, cols) in zip(group, cells, strict=True):
        part = slice(rows.start - top, rows.stop - top), slice(cols.start - left, cols.stop - left)
        more = np.where(np.isnan(patch.values), 0.0, 1.0 if patch.share is None else patch.share)
        more[share[part] + more > 1 + EXACT] = 0
        total[part] += more * np.nan_to_num(patch.values)
        share[part] += more
    values = np.divide(total, share, out=np.full(total.shape, np.nan), where=share > 0)
    whole = lattice.cut(slice(top, bottom), slice(left, right))
    complete = all(patch.share is None for patch in group)
    return replace(group[0], values=values, lattice=whole, share=None if complete else share)


def misalignment(lattice: RasterGrid, grid: Grid) -> str:
    """Return the reason why cells do not coincide, for a note; empty if they do."""
    if lattice.crs:
        return f"from {short(lattice.crs)} to {short(grid.crs)}"
    if lattice.fits(grid):
        return ""
    if not math.isclose(lattice.dx, grid.cell, rel_tol=1e-5) or not math.isclose(lattice.dy, lattice.dx):
        cells = (
            f"{lattice.dx:.6g} m" if lattice.dx == lattice.dy else f"{lattice.dx:.6g} x {lattice.dy:.6g} m"
        )
        return f"its cells are {cells}, the tile's {grid.cell:.6g} m"
    east, north = lattice.offset(grid)
    return f"its lattice is off by ({east:.2f}, {north:.2f}) m"


def _share(lattice: RasterGrid, step: int) -> Floats | None:
    """Return the share of each step that a part of a file has; see `RasterWindow.share`."""
    first, counts = lattice.before(step), (lattice.height, lattice.width)
    if not any(first) and not any(count % step for count in counts):
        return None
    rows, cols = (
        np.bincount((np.arange(count) + before) // step) / step
        for before, count in zip(first, counts, strict=True)
    )
    return np.outer(rows, cols)


def readable_cells(
    src: Any, lattice: RasterGrid, step: int, slices: Slices, resampling: Resampling
) -> tuple[Floats, Bools]:
    """Return the cells as `_cells` does, NaN where they cannot be read, and a mask of unreadable cells.

    GDAL reads blocks. A window with a damaged block is halved along borders of blocks, until each part is
    read, or is one block.
    """
    try:
        values = _cells(src, lattice, step, slices, resampling)
        return values, np.zeros(values.shape, np.bool_)
    except ERRORS:
        axis, halves = _halves(src, lattice, step, slices)
    if not halves:
        coarse = lattice.cut(*slices).coarser(step)
        shape = coarse.height, coarse.width
        return np.full(shape, np.nan), np.ones(shape, np.bool_)
    read = [readable_cells(src, lattice, step, half, resampling) for half in halves]
    values, unreadable = (np.concatenate(parts, axis) for parts in zip(*read, strict=True))
    return values, unreadable


def _halves(src: Any, lattice: RasterGrid, step: int, slices: Slices) -> tuple[int, list[Slices]]:
    """Return the axis along which a window is halved, and its halves; no halves within one block."""
    rows, cols = slices
    tall, wide = src.block_shapes[0]
    above, left = lattice.before(step)
    # Blocks are counted from the first row of the file, which may be the southern row.
    row = _border(rows, tall, lattice.height % tall if lattice.northward else 0, step, above)
    col = _border(cols, wide, 0, step, left)
    if row and (not col or (rows.stop - rows.start) * wide >= (cols.stop - cols.start) * tall):
        return 0, [(slice(rows.start, row), cols), (slice(row, rows.stop), cols)]
    if col:
        return 1, [(rows, slice(cols.start, col)), (rows, slice(col, cols.stop))]
    return 0, []


def _border(part: slice, block: int, first: int, step: int, before: int) -> int:
    """Return the border of blocks, in whole steps, that is nearest to the middle of a slice, or 0."""
    middle = (part.start + part.stop) / 2
    border = (first + round((middle - first) / block) * block + before) // step * step - before
    return border if part.start < border < part.stop else 0


def _cells(src: Any, lattice: RasterGrid, step: int, slices: Slices, resampling: Resampling) -> Floats:
    """Return the cells of a window, ``step`` x ``step`` cells as one; rows from the north."""
    first = lattice.before(step)
    tall, wide = (_steps(part, step, before) for part, before in zip(slices, first, strict=True))
    if len(tall) == len(wide) == 1:
        return _part(src, lattice, step, tall[0], wide[0], resampling)
    return np.block([[_part(src, lattice, step, rows, cols, resampling) for cols in wide] for rows in tall])


def _steps(part: slice, step: int, before: int) -> list[slice]:
    """Return the complete steps of a slice, and steps with fewer cells at the ends of the file."""
    start = min(part.stop, -(-(part.start + before) // step) * step - before)
    stop = max(start, (part.stop + before) // step * step - before)
    edges = part.start, start, stop, part.stop
    return [slice(a, b) for a, b in itertools.pairwise(edges) if a < b]


def _part(
    src: Any, lattice: RasterGrid, step: int, rows: slice, cols: slice, resampling: Resampling
) -> Floats:
    found = header(src)
    if step > 1 and found.alpha and resampling == Resampling.average:
        return _means(src, lattice, step, rows, cols)
    top = lattice.height - rows.stop if lattice.northward else rows.start
    tall, wide = rows.stop - rows.start, cols.stop - cols.start
    how: dict[str, Any] = {"window": Window(cols.start, top, wide, tall)}
    if step > 1:
        how |= {"out_shape": (-(-tall // step), -(-wide // step)), "resampling": resampling}
    values: Floats = src.read(1, **how).astype(np.float64)
    if (src.scales[0], src.offsets[0]) != (1.0, 0.0):
        values = values * src.scales[0] + src.offsets[0]
    # If the nodata value is NaN, these cells are NaN already.
    if not found.all_valid and not (found.nan_is_nodata and step == 1):
        how |= {"resampling": Resampling.mode} if step > 1 else {}
        values[src.read_masks(1, **how) == 0] = np.nan
        if found.alpha:
            values[transparent(src, found.alpha, **how)] = np.nan
    return values[::-1] if lattice.northward else values


def _means(src: Any, lattice: RasterGrid, step: int, rows: slice, cols: slice) -> Floats:
    """Return the means of ``step`` x ``step`` cells; NaN where fewer than half have a value.

    GDAL would also average the cells without a value by an alpha band of this type.
    """
    strips = []
    for top in range(rows.start, rows.stop, step * STRIP):
        strip = slice(top, min(top + step * STRIP, rows.stop))
        values = _part(src, lattice, 1, strip, cols, Resampling.average)
        tall, wide = values.shape
        # The last step of a file may have fewer cells.
        values = np.pad(values, ((0, -tall % step), (0, -wide % step)), constant_values=np.nan)
        blocks = values.reshape(len(values) // step, step, -1, step)
        known = (~np.isnan(blocks)).sum((1, 3))
        enough = known >= min(step, tall) * min(step, wide) / 2
        strips.append(np.where(enough, np.nansum(blocks, (1, 3)) / np.maximum(known, 1), np.nan))
    return np.concatenate(strips)
