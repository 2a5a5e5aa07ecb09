"""The border of a tile in parts that belong to no tile: four corners and four edges.

Up to four tiles meet at a corner and two share an edge. A part is described by its position and by the size
of the tiles alone. So all tiles around it describe it in the same way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid

DECIMALS = 6
"""Decimals (of a metre) to which positions are rounded: neighbours compute them from different edges."""

Kind = Literal["corner", "east", "north"]


@dataclass(frozen=True, slots=True)
class Border:
    """A corner of tiles, or an edge between two tiles, with the cells around it."""

    kind: Kind
    """``corner``, or the direction in which the edge runs: ``east`` or ``north``."""
    start: tuple[float, float]
    """Easting and northing of the corner, or of the edge's western or southern end (m)."""
    tile: tuple[int, int]
    """Width and height of the tiles (cells)."""
    grid: Grid
    """The cells around it."""

    @property
    def cell(self) -> tuple[int, int]:
        """Rows of `grid` to the north of the start, and columns to the west of it."""
        east, north = self.start
        return round((self.grid.north - north) / self.grid.cell), round(
            (east - self.grid.west) / self.grid.cell
        )

    def within(self, distance_m: float) -> Bounds:
        """Return west, south, east and north of the ground within a distance of the corner or edge (m)."""
        (east, north), cell = self.start, self.grid.cell
        width = self.tile[0] * cell if self.kind == "east" else 0.0
        height = self.tile[1] * cell if self.kind == "north" else 0.0
        return east - distance_m, north - distance_m, east + width + distance_m, north + height + distance_m

    @property
    def sides(self) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """(row, col) slices of the cells along the edge: in its north and south, or in its west and east.

        Of a corner, these are the two cells in the north and the two in the south.
        """
        (row, col), (width, height) = self.cell, self.tile
        if self.kind == "north":
            rows = slice(row - height, row)
            return (rows, slice(col - 1, col)), (rows, slice(col, col + 1))
        cols = slice(col, col + width) if self.kind == "east" else slice(col - 1, col + 1)
        return (slice(row - 1, row), cols), (slice(row, row + 1), cols)

    def strip(self, reach: int) -> tuple[tuple[slice, slice], Border]:
        """Return the (row, col) slices of `sides` and cells up to ``reach`` away, and the border there."""
        (rows, cols), (last_rows, last_cols) = self.sides
        window = (
            slice(max(rows.start - reach, 0), min(last_rows.stop + reach, self.grid.height)),
            slice(max(cols.start - reach, 0), min(last_cols.stop + reach, self.grid.width)),
        )
        return window, replace(self, grid=self.grid.part(*window))

    def along(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values of the cells on both sides of an edge, ``(2, n)``, ordered from its start.

        - `values` ``(H, W)``: the values of all cells of `grid`.
        """
        order = slice(None, None, 1 if self.kind == "east" else -1)
        return np.stack([values[side].ravel()[order] for side in self.sides])


def border_of(tile: Grid, reach_m: float) -> tuple[Border, ...]:
    """Return the border of a tile, in the order of `places_of`.

    - `reach_m`: distance from the corner or edge up to which its grid reaches (m).
    """
    size = tile.width, tile.height
    return tuple(
        border_at(kind, start, size, tile.crs, tile.cell, reach_m) for kind, start in places_of(tile)
    )


def places_of(tile: Grid) -> list[tuple[Kind, tuple[float, float]]]:
    """Return `Border.kind` and `Border.start` of each part of the border of a tile.

    First come the corners in the south-west, south-east, north-west and north-east, then the edges in the
    south, north, west and east.
    """
    west, south, east, north = tile.exact_bounds
    return [
        ("corner", (west, south)),
        ("corner", (east, south)),
        ("corner", (west, north)),
        ("corner", (east, north)),
        ("east", (west, south)),
        ("east", (west, north)),
        ("north", (west, south)),
        ("north", (east, south)),
    ]


def border_at(
    kind: Kind, start: tuple[float, float], tile: tuple[int, int], crs: str, cell: float, reach_m: float
) -> Border:
    """Return a part of the border of tiles; the arguments are as in `Border`, `Grid` and `border_of`."""
    reach = math.ceil(round(reach_m / cell, 6))
    width = tile[0] if kind == "east" else 0
    height = tile[1] if kind == "north" else 0
    west = round(start[0] - reach * cell, DECIMALS)
    north = round(start[1] + (height + reach) * cell, DECIMALS)
    grid = Grid(crs, west, north, cell, width + 2 * reach, height + 2 * reach)
    return Border(kind, start, tile, grid)
