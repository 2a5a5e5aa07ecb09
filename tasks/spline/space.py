"""The splines of a tile, the lattice of knots that tiles share, and the start heights of a fit.

Tiles of one size T have n intervals of T / n along each axis. So every edge of a tile is a line of
knots. A basis function of degree p has a support of p + 1 intervals. At a line exactly p functions are not
zero. Other functions on its two sides have disjoint supports.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.distances import filled
from flexroad.tasks.spline.surface import NurbsSurface, clamped_knots, greville, uniform_knots
from flexroad.tasks.types import Bools, Floats

Range = tuple[int, int]
"""First and last line of a part of the lattice, counted from a given line."""


@dataclass(frozen=True, eq=False)
class Space:
    """Tensor-product splines over a raster: their knots, and the parameters of the cell centres."""

    knots_u: Floats
    """Knots along easting, ``(n + p + 1,)``."""
    knots_v: Floats
    """Knots along northing, ``(m + q + 1,)``."""
    degree: tuple[int, int]
    """Degree along easting (the paper's p) and along northing (q)."""
    u: Floats
    """Parameters of the columns, ``(W,)``, ascending."""
    v: Floats
    """Parameters of the rows, ``(H,)``, descending: row 0 is in the north."""
    unit_m: tuple[float, float]
    """Length of one unit of u and of v (m)."""

    @property
    def points(self) -> tuple[int, int]:
        """Number of control points along easting and along northing."""
        p, q = self.degree
        return len(self.knots_u) - p - 1, len(self.knots_v) - q - 1


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
        """Return the smallest number of intervals that are at least as long as a distance; at least 1."""
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
        # The product is computed before the division, so that equal positions have equal parameters.
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


def points_at_spacing(grid: Grid, degree: int, spacing_m: float) -> tuple[int, int]:
    """Return the number of control points along easting and northing at about this distance (m)."""
    west, south, east, north = grid.hull
    n, m = (max(degree + 1, round(span / spacing_m) + 1) for span in (east - west, north - south))
    return n, m


def clamped_space(grid: Grid, degree: int, points: tuple[int, int]) -> Space:
    """Return the splines over a grid's hull, with clamped uniform knots and parameters from 0 to 1."""
    if min(grid.shape) < 2:
        raise TaskError(f"a surface needs at least 2 x 2 cells, not {grid.width} x {grid.height}")
    # This is checked before arrays are allocated: a spacing in the wrong unit would need too much memory.
    _check_enough(grid.width * grid.height, f"{grid.width} x {grid.height} cells", points)
    n, m = points
    west, south, east, north = grid.hull
    return Space(
        clamped_knots(n, degree),
        clamped_knots(m, degree),
        (degree, degree),
        u=np.linspace(0, 1, grid.width),
        v=np.linspace(1, 0, grid.height),
        unit_m=(east - west, north - south),
    )


def surface_on(space: Space, grid: Grid, bounds: Bounds, A: Floats, W: Floats, datum: float) -> NurbsSurface:
    """Return the surface with these coefficients whose domain has the given bounds on a grid (m)."""
    east, north = grid.origin
    return NurbsSurface(
        crs=grid.crs,
        bounds=bounds,
        degree=space.degree,
        knots_u=space.knots_u,
        knots_v=space.knots_v,
        A=A,
        W=W,
        datum=datum,
        origin=(float(east), float(north)),
    )


def check_cells(heights: Floats, points: tuple[int, int]) -> None:
    """Raise an error if fewer cells have a height than there are control points."""
    cells = int(np.count_nonzero(np.isfinite(heights)))
    _check_enough(cells, f"{cells} cells with a height", points)


def _check_enough(cells: int, name: str, points: tuple[int, int]) -> None:
    n, m = points
    if cells < n * m:
        raise TaskError(
            f"{name} are fewer than {n} x {m} control points; lower fit.control_points or raise fit.spacing_m"
        )


def start_heights(
    dsm: Floats, dtm: Floats, road: Bools, space: Space, terrain: bool = True
) -> tuple[Floats, float]:
    """Return the start heights of control points, ``(m, n)`` with row 0 in the south, and their mean (m).

    With DTM support they are the DTM at the Greville abscissae. Otherwise they must not depend on the DTM,
    and are the least-squares plane through the road. Without a road, only the plane through the DTM is left.
    """
    u, v = greville(space.knots_u, space.degree[0]), greville(space.knots_v, space.degree[1])
    cols = (u - space.u[0]) * ((len(space.u) - 1) / (space.u[-1] - space.u[0]))
    rows = (space.v[0] - v) * ((len(space.v) - 1) / (space.v[0] - space.v[-1]))
    if terrain and np.isfinite(dtm).any():
        heights = scipy.ndimage.map_coordinates(
            filled(dtm), np.meshgrid(rows, cols, indexing="ij"), order=1, mode="nearest"
        )
    else:
        ground = np.where(road, dsm, np.nan)
        if not np.isfinite(ground).any():
            ground = dtm
        r, c = np.nonzero(np.isfinite(ground))
        if not len(r):
            raise TaskError("no filtered road cell has a DSM height to start from, and the DTM is empty too")
        level, by_col, by_row = least_squares_plane(c.astype(float), r.astype(float), ground[r, c])
        heights = level + by_col * cols[None, :] + by_row * rows[:, None]
    return heights, float(heights.mean())


def least_squares_plane(easting: Floats, northing: Floats, height: Floats) -> tuple[float, float, float]:
    """Return (c, a, b) of ``z = c + a * easting + b * northing`` with the least squared vertical error.

    If the points do not span a plane (one point, points on a line), the plane is level in the undetermined
    direction. Coordinates should be local, so that c keeps its digits.
    """
    e, n, z = easting.mean(), northing.mean(), height.mean()
    (a, b), *_ = np.linalg.lstsq(np.column_stack([easting - e, northing - n]), height - z, rcond=1e-9)
    return float(z - a * e - b * n), float(a), float(b)
