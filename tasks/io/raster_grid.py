"""The lattice of a raster file's cells, its part that covers a grid, and the file's header."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import MaskFlags

from flexroad.catalog.crs import bounds_in, in_plan, same, scales, short, transformer
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.grid import LATTICE_TOLERANCE, Bounds, Grid
from flexroad.catalog.scan.rasters import alpha_band, georeference_fault
from flexroad.catalog.storage.paths import Location
from flexroad.tasks.errors import Unusable
from flexroad.tasks.types import Bools, Floats

SHIFT = 0.28713
"""Added to positions in cells before they are rounded down. Without it, a usual offset such as half a cell
would be rounded differently from file to file."""


@dataclass(frozen=True)
class RasterGrid:
    """The lattice of a file's cells; unlike in a `Grid`, cells need not be square (m, or units of `crs`)."""

    west: float
    north: float
    dx: float
    dy: float
    width: int
    height: int
    northward: bool = False
    """True if the file's rows run northward, as in XYZ files sorted by northing."""
    crs: str = ""
    """CRS of the coordinates if it differs from the CRS of the grids to read; else empty."""

    @classmethod
    def of(cls, transform: Affine, width: int, height: int, crs: str = "") -> RasterGrid:
        """Return the lattice of an unrotated file."""
        north = max(transform.f, transform.f + height * transform.e)
        dx, dy = abs(transform.a), abs(transform.e)
        return cls(transform.c, north, dx, dy, width, height, northward=transform.e > 0, crs=crs)

    @property
    def bounds(self) -> Bounds:
        """West, south, east and north of the outer edges."""
        return self.west, self.north - self.height * self.dy, self.west + self.width * self.dx, self.north

    @property
    def transform(self) -> Affine:
        """Affine map from (col, row), rows from the north, to coordinates."""
        return Affine(self.dx, 0, self.west, 0, -self.dy, self.north)

    def offset(self, grid: Grid) -> tuple[float, float]:
        """Return the offset (m, east and north) of this lattice from the grid's, modulo its cell size."""
        east = math.remainder(self.west - grid.west, self.dx)
        north = math.remainder(self.north - grid.north, self.dy)
        return east, north

    def fits(self, grid: Grid) -> bool:
        """Return whether cells coincide to within `LATTICE_TOLERANCE` over the complete grid."""
        if self.crs:
            return False
        west, north, east, south = self._in_cells(grid)
        off = max(abs(edge - round(edge)) for edge in (west, north, east, south))
        same_count = (round(east) - round(west), round(south) - round(north)) == (grid.width, grid.height)
        return off < LATTICE_TOLERANCE and same_count

    def window_for(self, grid: Grid) -> tuple[slice, slice] | None:
        """Return the (row, col) slices of this lattice under the grid, rows from the north, or None."""
        west, north, east, south = self._in_cells(grid)
        cell_x, cell_y = self.cell_of(grid)
        if self.fits(grid):
            west, north, east, south = round(west), round(north), round(east), round(south)
        else:
            # The margin that interpolation at the grid's border cells needs.
            pad_x, pad_y = 1 + cell_x / self.dx, 1 + cell_y / self.dy
            west, east, north, south = west - pad_x, east + pad_x, north - pad_y, south + pad_y
        rows = slice(max(0, math.floor(north)), min(self.height, math.ceil(south)))
        cols = slice(max(0, math.floor(west)), min(self.width, math.ceil(east)))
        return (rows, cols) if rows.start < rows.stop and cols.start < cols.stop else None

    def step_for(self, grid: Grid) -> int:
        """Return the number of cells along an axis to read as one, so that 2 to 4 lie in a grid's cell."""
        cell_x, cell_y = self.cell_of(grid)
        return max(1, math.floor(min(cell_x / self.dx, cell_y / self.dy) / 2 + 1e-9))

    def cell_of(self, grid: Grid) -> tuple[float, float]:
        """Return the size of a grid's cell along the axes of this lattice, in its units."""
        if not self.crs:
            return grid.cell, grid.cell
        west, south, east, north = grid.bounds
        across, along = scales(grid.crs, self.crs, (west + east) / 2, (south + north) / 2)
        return across * grid.cell, along * grid.cell

    def reached(self, grid: Grid) -> Bools:
        """Return the cells of a grid whose centres lie within the bounds, ``(H, W)``."""
        west, south, east, north = self.bounds
        x, y = self._centres(grid)
        inside: Bools = (south < y) & (y < north) & (west < x) & (x < east)
        return inside

    def cells_at(self, grid: Grid, chosen: Bools) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return rows, from the north, and columns of the cells under chosen centres of a grid, ``(n,)``."""
        x, y = (values[chosen] for values in np.broadcast_arrays(*self._centres(grid)))
        row, col = np.floor((self.north - y) / self.dy), np.floor((x - self.west) / self.dx)
        return row.astype(np.intp), col.astype(np.intp)

    def _centres(self, grid: Grid) -> tuple[Floats, Floats]:
        """Return the centres of a grid's cells on this lattice, ``(H, W)``, or ``(1, W)`` and ``(H, 1)``."""
        x, y = grid.eastings[None, :], grid.northings[:, None]
        if self.crs:
            x, y = np.broadcast_arrays(x, y)
            x, y = transformer(grid.crs, self.crs).transform(x, y)
        return x, y

    def before(self, step: int) -> tuple[int, int]:
        """Return the numbers of rows and columns between the start of the first step and this lattice.

        Steps are counted from the origin of the coordinates. So cells are joined in the same way in
        every window and in all files of one lattice.
        """
        row, col = SHIFT - self.north / self.dy, SHIFT + self.west / self.dx
        return math.floor(row) % step, math.floor(col) % step

    def whole_steps(self, step: int, rows: slice, cols: slice) -> tuple[slice, slice]:
        """Return the slices grown to complete steps, as far as the lattice has cells."""
        grown = (
            slice(
                max(0, (part.start + first) // step * step - first),
                min(count, -(-(part.stop + first) // step) * step - first),
            )
            for part, first, count in zip(
                (rows, cols), self.before(step), (self.height, self.width), strict=True
            )
        )
        tall, wide = grown
        return tall, wide

    def coarser(self, step: int) -> RasterGrid:
        """Return the lattice of joined cells; steps with fewer cells are taken as complete."""
        above, left = self.before(step)
        return replace(
            self,
            west=self.west - left * self.dx,
            north=self.north + above * self.dy,
            dx=self.dx * step,
            dy=self.dy * step,
            width=-(-(self.width + left) // step),
            height=-(-(self.height + above) // step),
            northward=False,
        )

    def continues(self, other: RasterGrid) -> bool:
        """Return whether two lattices are parts of one lattice: corners of the other are corners of cells."""
        if (self.crs, self.northward) != (other.crs, other.northward):
            return False
        west, south, east, north = other.bounds
        left, right = (west - self.west) / self.dx, (east - self.west) / self.dx
        top, bottom = (self.north - north) / self.dy, (self.north - south) / self.dy
        off = max(abs(edge - round(edge)) for edge in (left, right, top, bottom))
        count = round(right) - round(left), round(bottom) - round(top)
        return off < LATTICE_TOLERANCE and count == (other.width, other.height)

    def cells_in(self, other: RasterGrid) -> tuple[slice, slice]:
        """Return the (row, col) slices of this lattice in a lattice that it continues; may be negative."""
        col, row = round((self.west - other.west) / self.dx), round((other.north - self.north) / self.dy)
        return slice(row, row + self.height), slice(col, col + self.width)

    def cut(self, rows: slice, cols: slice) -> RasterGrid:
        """Return the lattice of a part; rows from the north."""
        west, north = self.west + cols.start * self.dx, self.north - rows.start * self.dy
        width, height = cols.stop - cols.start, rows.stop - rows.start
        return replace(self, west=west, north=north, width=width, height=height, northward=False)

    def _in_cells(self, grid: Grid) -> tuple[float, float, float, float]:
        west, south, east, north = bounds_in(self.crs, grid.crs, grid.bounds) if self.crs else grid.bounds
        return (
            (west - self.west) / self.dx,
            (self.north - north) / self.dy,
            (east - self.west) / self.dx,
            (self.north - south) / self.dy,
        )


@dataclass(frozen=True)
class Header:
    """The header of a file."""

    lattice: RasterGrid | None
    """None if the file has no georeference."""
    fault: str | None
    """Why the position cannot be used, to follow the file's name; None if it can."""
    crs: str | None
    """As WKT."""
    all_valid: bool
    """Whether the first band has no cells without a value."""
    nan_is_nodata: bool
    """Whether exactly its cells without a value are NaN."""
    alpha: int | None
    """Number of the alpha band that GDAL does not use as a mask, or None."""


_headers = WeakKeyDictionary[Any, Header]()


def header(src: Any) -> Header:
    """Return the header of an open raster; kept, because rasterio makes parts of it at each access."""
    if src in _headers:
        return _headers[src]
    transform, masks = src.transform, src.mask_flag_enums[0]
    fault = georeference_fault(src)
    if fault is None and (transform.b or transform.d):
        fault = "is rotated; turn it north up with gdalwarp"
    known = fault is None and not transform.is_identity
    alpha = alpha_band(src)
    _headers[src] = found = Header(
        lattice=RasterGrid.of(transform, src.width, src.height) if known else None,
        fault=None if transform.is_identity else fault,
        crs=src.crs.to_wkt() if src.crs else None,
        all_valid=MaskFlags.all_valid in masks and alpha is None,
        nan_is_nodata=masks == [MaskFlags.nodata] and math.isnan(src.nodata) and alpha is None,
        alpha=alpha,
    )
    return found


def file_crs(src: Any, given: str | None) -> str | None:
    """Return the CRS of an open raster; if it has none or a wrong one, the given CRS (`crs_of`)."""
    found = header(src)
    return crs_of(found.crs, given, found.lattice.bounds) if found.lattice else found.crs or given


def place(
    src: Any,
    path: Location,
    name: str,
    grid: Grid,
    core: Grid,
    crs: str | None,
    reproject: bool = False,
) -> RasterGrid | None:
    """Return a file's lattice, or None if it is in another CRS and outside the grid; see `read_window`."""
    found = header(src)
    if found.fault:
        raise Unusable(f"{name} {found.fault}", str(path))
    lattice, own_crs = found.lattice, file_crs(src, crs)
    if lattice is None:
        if src.shape == core.shape:
            return RasterGrid(core.west, core.north, core.cell, core.cell, core.width, core.height)
        raise Unusable(
            f"{name} has no georeference and has {src.width} x {src.height} cells, "
            f"the tile {core.width} x {core.height}; give it a world file",
            str(path),
        )
    if own_crs is None:
        raise Unusable(f"{name} has no CRS; build the catalog again with --crs", str(path))
    if same(own_crs, grid.crs):
        return lattice
    west, south, east, north = bounds_in(grid.crs, own_crs, lattice.bounds)
    # This is False for bounds that cannot be transformed (inf, NaN): they are an error.
    if east <= grid.bounds[0] or grid.bounds[2] <= west or north <= grid.bounds[1] or grid.bounds[3] <= south:
        return None
    if reproject:
        return replace(lattice, crs=in_plan(own_crs))
    raise Unusable(
        f"{name} is in {short(own_crs)}, the tile in {short(grid.crs)}; "
        f"reproject it, e.g. gdalwarp -t_srs {short(grid.crs)}, or make the catalog with --reproject",
        str(path),
    )
