"""The knots that all tiles share: a uniform lattice on whose lines the edges of the tiles lie.

Tiles of one size T have n intervals of T / n along each axis, so that every edge of a tile is a line of
knots. A basis function of degree p has a support of p + 1 intervals. At a line exactly p functions are not
zero, and what lies on either side of them has disjoint supports.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.space import Space
from flexroad.tasks.spline.surface import uniform_knots

Range = tuple[int, int]
"""First and last line of a part of the lattice, counted from a given line."""


@dataclass(frozen=True)
class Lattice:
    """The lattice of tiles of one size."""

    cells: tuple[int, int]
    """Width and height of a tile (cells)."""
    cell: float
    """Cell size (m)."""
    intervals: tuple[int, int]
    """Number of intervals of a tile along easting and northing."""
    degree: int

    @classmethod
    def of(cls, cells: tuple[int, int], cell: float, degree: int, spacing_m: float) -> Lattice:
        """Return the lattice whose lines are at most the given distance apart (m).

        A tile has at least ``degree`` intervals, so that no control point acts on two parallel edges.
        """
        check_spacing(spacing_m, cell)
        n, m = (max(degree, math.ceil(round(count * cell / spacing_m, 6))) for count in cells)
        return cls(cells, cell, (n, m), degree)

    @property
    def unit_m(self) -> tuple[float, float]:
        """Distance of the lines along easting and northing (m)."""
        (width, height), (n, m) = self.cells, self.intervals
        return width * self.cell / n, height * self.cell / m

    def lines_within(self, distance_m: float) -> tuple[int, int]:
        """Return the number of intervals within a distance, along easting and northing; at least 1."""
        u_m, v_m = self.unit_m
        return max(1, int(distance_m / u_m + 1e-9)), max(1, int(distance_m / v_m + 1e-9))

    def lines_over(self, distance_m: float) -> tuple[int, int]:
        """Return the number of intervals that reach up to a distance or beyond it; at least 1."""
        u_m, v_m = self.unit_m
        return max(1, math.ceil(distance_m / u_m - 1e-9)), max(1, math.ceil(distance_m / v_m - 1e-9))

    def part(
        self, shape: tuple[int, int], start: tuple[int, int], u: Range, v: Range
    ) -> tuple[Space, tuple[slice, slice]]:
        """Return the splines over a part of the lattice, and the cells whose centres lie in it.

        - `shape`: rows and columns of the raster.
        - `start`: rows of the raster to the north and columns to the west of the point from which lines are
          counted.
        - `u`, `v`: first and last line along easting and along northing.
        - `space`: its parameters are counted in lines.
        - `window`: (row, col) slices of the raster.
        """
        (width, height), (n, m) = self.cells, self.intervals
        # Multiplied before the division, so that equal positions have equal parameters.
        along_u = (np.arange(shape[1]) - start[1] + 0.5) * n / width
        along_v = (start[0] - np.arange(shape[0]) - 0.5) * m / height
        cols, rows = _between(along_u, u), _between(along_v, v)
        space = Space(
            uniform_knots(*u, self.degree),
            uniform_knots(*v, self.degree),
            (self.degree, self.degree),
            along_u[cols],
            along_v[rows],
            self.unit_m,
        )
        return space, (rows, cols)


def check_spacing(spacing_m: float, cell: float) -> None:
    """Check the distance of control points."""
    if spacing_m < cell * (1 - 1e-9):
        raise TaskError(f"fit.spacing_m is {spacing_m:g} m, less than a cell of {cell:g} m; raise it")


def _between(values: np.ndarray, ends: Range) -> slice:
    inside = np.flatnonzero((values >= ends[0]) & (values <= ends[1]))
    return slice(int(inside[0]), int(inside[-1]) + 1)
