"""Grids: the position and size of a tile's cells; every raster array in FlexRoad lies on one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from affine import Affine
from numpy.typing import NDArray

from flexroad.catalog.errors import CatalogError

Bounds = tuple[float, float, float, float]
"""West, south, east, north in metres."""

FARTHEST = 1e9
"""Largest coordinate, in any unit; larger numbers are damaged, not places on Earth."""
MOST_CELLS = 2**31 - 1
"""Largest width and height of a raster in GDAL."""
LATTICE_TOLERANCE = 0.01
"""Two lattices coincide when they are off by less than this part of a cell."""


def overlap(a: Bounds, b: Bounds, tolerance: float = 0.0) -> bool:
    """Return whether two areas overlap by more than a tolerance (m) from west to east and south to north."""
    # Most areas lie beside each other, so that the first comparison already decides.
    return (
        a[2] - b[0] > tolerance
        and b[2] - a[0] > tolerance
        and a[3] - b[1] > tolerance
        and b[3] - a[1] > tolerance
        and min(a[2] - a[0], b[2] - b[0], a[3] - a[1], b[3] - b[1]) > tolerance
    )


def is_whole(number: float) -> bool:
    """Return whether a number is an integer, at least 1, except for rounding."""
    return round(number) >= 1 and math.isclose(round(number), number, rel_tol=1e-9)


def union(areas: Iterable[Bounds]) -> Bounds:
    """Return the bounds of one or more areas together."""
    wests, souths, easts, norths = zip(*areas, strict=True)
    return min(wests), min(souths), max(easts), max(norths)


@dataclass(frozen=True, slots=True)
class Grid:
    """A north-up lattice of square cells.

    Arrays on a grid are ``(row, col)`` with row 0 in the north; values sit at cell centres.
    """

    crs: str
    """Coordinate reference system in metres: ``EPSG:25832``, or WKT where there is no code."""
    west: float
    """Easting of the left edge (m)."""
    north: float
    """Northing of the upper edge (m)."""
    cell: float
    """Cell size (m)."""
    width: int
    """Number of columns."""
    height: int
    """Number of rows."""

    def __post_init__(self) -> None:
        if not (self.cell > 0 and math.isfinite(self.cell)):
            raise CatalogError(f"a grid needs a positive cell size, not {self.cell} m")
        if self.width < 1 or self.height < 1:
            raise CatalogError(f"a grid needs at least one cell, not {self.width} x {self.height}")

    @classmethod
    def covering(cls, crs: str, bounds: Bounds, cell: float) -> Grid:
        """Return the smallest grid anchored at the bounds' north-west corner that covers them."""
        west, south, east, north = bounds
        width = math.ceil(round((east - west) / cell, 6))
        height = math.ceil(round((north - south) / cell, 6))
        return cls(crs, west, north, cell, width, height)

    @classmethod
    def holding(cls, grids: Sequence[Grid]) -> Grid | None:
        """Return the smallest grid that has the cells of all grids.

        The result is None without grids, if lattices or CRSs differ, or beyond `MOST_CELLS` a side.
        """
        if not grids:
            return None
        crs, cell = grids[0].crs, grids[0].cell
        west, north = min(grid.west for grid in grids), max(grid.north for grid in grids)
        east, south = max(grid.east for grid in grids), min(grid.south for grid in grids)
        for grid in grids:
            columns, rows = (grid.west - west) / cell, (north - grid.north) / cell
            off = max(abs(columns - round(columns)), abs(rows - round(rows)))
            if (grid.crs, grid.cell) != (crs, cell) or off > LATTICE_TOLERANCE:
                return None
        width, height = round((east - west) / cell), round((north - south) / cell)
        return cls(crs, west, north, cell, width, height) if max(width, height) <= MOST_CELLS else None

    @property
    def has_code(self) -> bool:
        """Whether the CRS is given by its code, not by WKT."""
        return self.crs.upper().startswith("EPSG:")

    @property
    def east(self) -> float:
        """Easting of the right edge (m)."""
        return self.west + self.width * self.cell

    @property
    def south(self) -> float:
        """Northing of the lower edge (m)."""
        return self.north - self.height * self.cell

    @property
    def bounds(self) -> Bounds:
        """West, south, east and north of the outer edges (m)."""
        return self.west, self.south, self.east, self.north

    @property
    def exact_bounds(self) -> Bounds:
        """The bounds rounded to a micrometre (m), so that an edge of two tiles is the same number in both."""
        west, south, east, north = (float(round(edge, 6)) for edge in self.bounds)
        return west, south, east, north

    @property
    def hull(self) -> Bounds:
        """West, south, east and north of the outermost cell centres (m)."""
        half = self.cell / 2
        return self.west + half, self.south + half, self.east - half, self.north - half

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    @property
    def transform(self) -> Affine:
        """Affine map from (col, row) of a cell's upper left corner to (easting, northing)."""
        return Affine(self.cell, 0.0, self.west, 0.0, -self.cell, self.north)

    @property
    def origin(self) -> tuple[float, float]:
        """Whole-metre (easting, northing) that is subtracted before computing, near the south-west."""
        return math.floor(self.west), math.floor(self.south)

    @property
    def eastings(self) -> NDArray[np.float64]:
        """Eastings of the cell centres, ``(width,)``, ascending (m)."""
        return self.west + (np.arange(self.width, dtype=np.float64) + 0.5) * self.cell

    @property
    def northings(self) -> NDArray[np.float64]:
        """Northings of the cell centres, ``(height,)``, descending (m)."""
        return self.north - (np.arange(self.height, dtype=np.float64) + 0.5) * self.cell

    def buffered(self, halo_m: float) -> Grid:
        """Return this grid grown on all sides by at least ``halo_m``, in whole cells."""
        n = math.ceil(round(halo_m / self.cell, 6))
        west, north = self.west - n * self.cell, self.north + n * self.cell
        return Grid(self.crs, west, north, self.cell, self.width + 2 * n, self.height + 2 * n)

    def part(self, rows: slice, cols: slice) -> Grid:
        """Return the grid of a part of the cells; the slices have a start and a stop."""
        west, north = self.west + cols.start * self.cell, self.north - rows.start * self.cell
        return Grid(self.crs, west, north, self.cell, cols.stop - cols.start, rows.stop - rows.start)

    def window(self, inner: Grid) -> tuple[slice, slice]:
        """Return the (row, col) slices of the cells of ``inner`` in this grid.

        Raises
        ------
        CatalogError
            If ``inner`` is not on this grid's lattice or reaches beyond it.
        """
        col, row = (inner.west - self.west) / self.cell, (self.north - inner.north) / self.cell
        c, r = round(col), round(row)
        on_lattice = max(abs(col - c), abs(row - r)) < LATTICE_TOLERANCE and inner.cell == self.cell
        inside = c >= 0 and r >= 0 and c + inner.width <= self.width and r + inner.height <= self.height
        if not (on_lattice and inside):
            raise CatalogError(f"grid {inner.bounds} does not lie in the cells of grid {self.bounds}")
        return slice(r, r + inner.height), slice(c, c + inner.width)

    def cells(
        self, easting: NDArray[np.float64], northing: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return (row, col) of the cell under each point; points outside get the nearest cell."""
        col = np.floor((np.asarray(easting) - self.west) / self.cell).astype(np.intp)
        row = np.floor((self.north - np.asarray(northing)) / self.cell).astype(np.intp)
        return np.clip(row, 0, self.height - 1), np.clip(col, 0, self.width - 1)

    def tiles(self, size_m: float) -> Iterator[tuple[str, Grid]]:
        """Cut this grid's bounds on the absolute grid of multiples of ``size_m``.

        Yields
        ------
        tile_id : str
            ``EASTING_NORTHING`` of the south-west corner in whole metres, as in the paper's
            ``295500_5629250``.
        grid : Grid
            The full tile, also where this grid covers it only in part.

        Raises
        ------
        CatalogError
            If ``size_m`` is not a whole number of metres and of cells, at least one.
        """
        if not 0 < size_m < math.inf:
            raise CatalogError(f"a tile needs a size above 0 m, not {size_m:g} m")
        n = round(size_m / self.cell)
        if size_m != int(size_m) or not is_whole(size_m / self.cell):
            raise CatalogError(
                f"a tile of {size_m} m is not a whole number of metres and of {self.cell} m cells"
            )
        slack = LATTICE_TOLERANCE * self.cell
        columns = range(math.floor((self.west + slack) / size_m), math.ceil((self.east - slack) / size_m))
        rows = range(math.floor((self.south + slack) / size_m), math.ceil((self.north - slack) / size_m))
        for j in rows:
            for i in columns:
                west, south = float(i * size_m), float(j * size_m)
                yield f"{west:.0f}_{south:.0f}", Grid(self.crs, west, south + size_m, self.cell, n, n)
