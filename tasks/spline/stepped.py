"""A spline with steps beside roads: kerbs, walls and banks, which a smooth surface cannot follow.

The spline is the road's surface, continued beside it. A cell beside the road has a step: the height of the
ground there above the spline, by DSM or DTM. So both sides of a kerb have their own height, and the road
stays smooth. On an edge between two tiles, both tiles use the steps of the same `Edge`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.borders import Border
from flexroad.catalog.grid import Grid
from flexroad.tasks.roads.distances import distances, within
from flexroad.tasks.roads.road_height import ground_heights
from flexroad.tasks.spline.frame import Frame, rounded
from flexroad.tasks.spline.space import Lattice, Range, surface_on
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, Surface, TileData

SAME_M = 0.25
"""A DSM within this of the spline (m) shows the ground: it is the road, or as low as a kerb."""
OPEN_M = 0.2
"""A DSM within this of the DTM (m) shows the ground, too."""
ROUNDED = 0.1
"""Share of the rise of the DTM across three cells that is added to this tolerance, for walls."""
ALIKE_M = 0.1
"""Standard deviation of the weights of neighbouring cells by the difference of their steps (m)."""
WALL_M = 0.5
"""Least rise of the DTM from cell to cell (m) at which the DSM is preferred, too. Where objects hide the
ground, the DTM is preferred to smaller steps."""
KERB_M = 2.0
"""Distance from the road up to which the DSM is preferred (m): the DTM is smoothed there, across a kerb or a
wall. Farther away the DTM is more accurate than a DSM with grass and shrubs."""
ROUNDING_M = 1e-6
"""Points within this distance of the border of a tile are on it (m)."""
HELD = 1e-9
"""Weight of the value 0 in each cell without a value, so that parts that touch no known value become 0."""


@dataclass(frozen=True, eq=False)
class SteppedSurface(NurbsSurface):
    """A spline, and the steps of cells above it; the slope and the normal are the spline's.

    The border of a tile has its own steps, which its neighbours have, too. At its corners the steps are 0. A
    surface over several tiles of one size also has the steps of the borders between them.
    """

    steps: NDArray[np.float32]
    """Height of the ground above the spline, ``(H, W)``, m; 0 on the road."""
    cells: Grid
    """The cells of the steps."""
    south_north: NDArray[np.float32]
    """Steps on the borders of tiles from the southern to the northern border, ``(rows of tiles + 1, W)``, m,
    from west to east."""
    west_east: NDArray[np.float32]
    """Steps on the borders from the western to the eastern border, ``(columns of tiles + 1, H)``, m, from
    north to south."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in their broadcast shape."""
        return np.asarray(self.smooth(easting, northing) + self.step(easting, northing))

    def smooth(self, easting: Floats, northing: Floats) -> Floats:
        """Return the heights of the spline (m) at scattered points, in their broadcast shape."""
        return super().height(easting, northing)

    def without_steps_near(
        self, road: Bools, distance_m: float, frame: Frame | None = None
    ) -> SteppedSurface:
        """Return the surface without the steps within a distance of the given road cells, ``(H, W)``."""
        near = within(road, self.cells.cell, distance_m)
        rim = (
            frame.steps(self.cells.shape, distance_m) if frame else (0 * self.south_north, 0 * self.west_east)
        )
        south_north, west_east = (steps.astype(np.float32) for steps in rim)
        steps = np.where(near, np.float32(0), self.steps)
        return replace(self, steps=steps, south_north=south_north, west_east=west_east)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""
        steps = self.step(np.asarray(eastings), np.asarray(northings)[:, None])
        return np.asarray(super().lattice(eastings, northings) + steps)

    def step(self, easting: Floats, northing: Floats) -> Floats:
        """Return the steps (m) at points, in their broadcast shape; 0 in corners and beyond the tile."""
        (west, south, east, north), cells = self.cells.exact_bounds, self.cells
        # Edges of two tiles may differ by rounding, but both must find the same cell along their border.
        nudge = ROUNDING_M
        row, col = cells.cells(np.asarray(easting) + nudge, np.asarray(northing) - nudge)
        row_of, on_row, across_rows = _borders(northing, np.linspace(south, north, len(self.south_north)))
        column_of, on_column, across = _borders(easting, np.linspace(west, east, len(self.west_east)))
        steps = np.where(across & across_rows, self.steps[row, col], 0.0)
        if on_row.any():
            steps = np.where(across & on_row, self.south_north[row_of, col], steps)
        if on_column.any():
            steps = np.where(across_rows & on_column, self.west_east[column_of, row], steps)
        return steps


def without_steps(surface: Surface) -> Surface:
    """Return the spline of a surface with steps; other surfaces are returned unchanged."""
    if not isinstance(surface, SteppedSurface):
        return surface
    return NurbsSurface(**{field.name: getattr(surface, field.name) for field in fields(NurbsSurface)})


def _borders(values: Floats, borders: Floats) -> tuple[NDArray[np.intp], Bools, Bools]:
    """Return the nearest border of each value, and whether the value is on a border, or between two."""
    nearest = np.searchsorted((borders[:-1] + borders[1:]) / 2, values)
    on = np.abs(values - borders[nearest]) <= ROUNDING_M
    return nearest, on, ~on & (values > borders[0]) & (values < borders[-1])


def with_steps(
    data: TileData, clusters: RoadClusters, surface: NurbsSurface, frame: Frame | None
) -> NurbsSurface:
    """Return a tile's surface with steps in the cells beside streets that the filter gives.

    Without a frame there are no steps on the border. The given surface must not have steps yet.
    """
    if clusters.beside is None:
        return surface
    core = data.core
    border = frame.steps(core.shape) if frame else (np.zeros((2, core.width)), np.zeros((2, core.height)))
    south_north, west_east = (steps.astype(np.float32) for steps in border)
    parts: dict[str, Any] = {
        "steps": _cell_steps(data, clusters, clusters.beside, surface),
        "south_north": south_north,
        "west_east": west_east,
        "cells": core,
    }
    if isinstance(surface, SteppedSurface):
        return replace(surface, **parts)
    return SteppedSurface(**vars(surface), **parts)


def _cell_steps(
    data: TileData, clusters: RoadClusters, beside: Bools, surface: NurbsSurface
) -> NDArray[np.float32]:
    """Return the steps of the cells beside streets, ``(H, W)``, m, on the tile's core.

    If the DSM of a cell shows the ground, its height is averaged with neighbours whose steps are alike, so
    that edges remain. Behind an object a cell has the height of the wall around, if there is a wall, else of
    its DTM. Without a DTM its step lies between the steps around.
    """
    core, window = data.core, data.grid.window(data.core)
    cells, dtm, dsm = beside[window], data.dtm[window], ground_heights(data, clusters).dsm[window]
    low, high = _around_dtm(dtm)
    near_road = within(clusters.mask[window], core.cell, KERB_M)
    preferred = near_road | (high - low >= WALL_M) | (np.abs(dsm - dtm) >= WALL_M)
    dsm, dtm = np.where(cells & preferred, dsm, np.nan), np.where(cells, dtm, np.nan)
    spline = surface.lattice(core.eastings, core.northings)
    rise, smoothed = dsm - spline, dtm - spline
    # The DTM is smoothed: beside a wall it does not reach the full height of the ground above or below.
    low, high = _around_dtm(dtm)
    reach = OPEN_M + ROUNDED * np.maximum(high - low, 0.0)
    away = np.minimum(np.abs(dsm - low), np.abs(dsm - high))
    is_open = (np.abs(dsm - dtm) <= OPEN_M) | (away <= reach)
    shown = cells & ((np.abs(rise) <= SAME_M) | is_open)
    steps = np.where(cells, smoothed, 0.0)
    near = np.isfinite(dsm)
    around = _around(np.where(shown, rise, np.nan), near)
    walls = _walls(around, smoothed[near])
    steps[near] = np.where(np.abs(walls) >= WALL_M, walls, smoothed[near])
    steps[shown] = _alike(around[shown[near]], rise[shown])
    return between(steps, cells).astype(np.float32)


def _alike(around: Floats, own: Floats) -> Floats:
    """Return the means of steps with similar steps around, ``(n,)``, m.

    - `around` ``(n, 9)``: steps of the cell and its neighbours; NaN where the DSM does not show them.
    - `own` ``(n,)``: the step of the cell.
    """
    weights = np.where(np.isfinite(around), np.exp(-0.5 * ((around - own[:, None]) / ALIKE_M) ** 2), 0.0)
    return np.asarray((weights * np.nan_to_num(around)).sum(axis=1) / weights.sum(axis=1))


def _around_dtm(dtm: Floats) -> tuple[Floats, Floats]:
    """Return the lowest and the highest DTM of each cell and its eight neighbours, ``(H, W)``, m."""
    low = scipy.ndimage.minimum_filter(np.nan_to_num(dtm, nan=np.inf), 3)
    return low, scipy.ndimage.maximum_filter(np.nan_to_num(dtm, nan=-np.inf), 3)


def _around(values: Floats, cells: Bools) -> Floats:
    """Return the values of each cell and its eight neighbours, ``(n, 9)``; NaN beyond the tile."""
    row, col = np.nonzero(cells)
    wide = np.pad(values, 1, constant_values=np.nan)
    return np.stack([wide[row + i, col + j] for i in (0, 1, 2) for j in (0, 1, 2)], axis=1)


def _walls(around: Floats, smoothed: Floats) -> Floats:
    """Return the steps of hidden cells, ``(n,)``, m: the median of the known steps around, or 0.

    A smoothed step is half as high at the wall as behind it, so that the DTM shows the side of the wall.

    - `around` ``(n, 9)``: steps of the cell and its neighbours; NaN where hidden.
    - `smoothed` ``(n,)``: the DTM above the spline.
    """
    ordered, count = np.sort(around, axis=1), np.isfinite(around).sum(axis=1)
    rows = np.arange(len(around))
    medians = (ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, 8)]) / 2
    return np.where(smoothed * np.sign(medians) >= np.abs(medians) / 2, medians, 0.0)


def between(values: Floats, cells: Bools) -> Floats:
    """Return values with NaN filled: each filled value is the mean of its neighbours among the cells.

    - `values` ``(H, W)``: NaN only in the given cells.
    - `cells` ``(H, W)``: values of other cells have no effect.
    """
    unknown = cells & np.isnan(values)
    if not unknown.any():
        return values
    # With a rim around the array, every cell has four neighbours.
    given, cells, unknown = np.pad(values, 1), np.pad(cells, 1), np.pad(unknown, 1)
    row, col = np.nonzero(unknown)
    number = np.full(given.shape, -1)
    number[row, col] = own = np.arange(row.size)
    degree, right, joints = np.full(row.size, HELD), np.zeros(row.size), []
    for down, east in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        place = row + down, col + east
        known = cells[place] & ~unknown[place]
        joined = np.flatnonzero(unknown[place])
        degree[known] += 1
        degree[joined] += 1
        right[known] += given[place][known]
        joints.append((joined, number[place][joined], np.full(joined.size, -1.0)))
    rows, cols, weights = (np.concatenate(part) for part in zip((own, own, degree), *joints, strict=True))
    matrix = scipy.sparse.csc_matrix((weights, (rows, cols)), 2 * (row.size,))
    given[row, col] = scipy.sparse.linalg.spsolve(matrix, right)
    return given[1:-1, 1:-1]


def spline_around(lattice: Lattice, border: Border, u: Range, v: Range, control: Floats) -> NurbsSurface:
    """Return the spline with some control heights (m) over a part of the lattice around a corner or edge."""
    (east, north), (along_u, along_v) = border.start, lattice.unit_m
    space, _ = lattice.part(border.grid.shape, border.cell, u, v)
    bounds = east + u[0] * along_u, north + v[0] * along_v, east + u[1] * along_u, north + v[1] * along_v
    return surface_on(space, border.grid, bounds, control, np.ones_like(control), datum=0.0)


def border_steps(
    data: TileData, road: RoadMask, clusters: RoadClusters, border: Border, spline: NurbsSurface
) -> dict[str, Floats]:
    """Return ``steps`` and ``road_m`` of an `Edge`; empty if the filter gives no cells beside streets.

    A step is the mean step of the two cells beside the edge, so that the ground continues across it. It is 0
    where one of the two cells has no step: the edge of a road is not moved.

    - `data`, `road`, `clusters`: the cells around the edge, their road mask and the filtered road.
    - `spline`: the spline around the edge; NaN if there is no ground.
    """
    if clusters.beside is None or np.isnan(spline.A).any():
        return {}
    # This is the ground on which the steps of the cells beside the edge depend.
    window, strip = border.strip(math.ceil(KERB_M / data.grid.cell) + 1)
    grid, heights = strip.grid, ground_heights(data, clusters)
    part = TileData(data.tile_id, grid, grid, heights.dsm[window], heights.dtm[window])
    own = RoadClusters(grid, clusters.labels[window])
    both, steps = border.along(clusters.beside).all(axis=0), np.zeros(grid.shape)
    if both.any():
        steps = _cell_steps(part, own, clusters.beside[window], spline).astype(np.float64)
    mean = np.where(both, strip.along(steps).sum(axis=0) / 2, 0.0)
    return {"steps": rounded(mean), "road_m": border.along(_to_road(road, border)).min(axis=0)}


def _to_road(road: RoadMask, border: Border) -> Floats:
    """Return the distance of the cells beside an edge to the nearest road cell, ``(H, W)``, m; else inf."""
    beside = np.zeros_like(road.mask)
    for side in border.sides:
        beside[side] = True
    away = np.full(beside.shape, np.inf)
    away[beside] = distances(beside, road.mask) * road.grid.cell
    return away
