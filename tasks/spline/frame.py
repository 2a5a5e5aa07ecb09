"""Shared parts of tiles along their borders: control points, classes of cells, and vertices of meshes.

Every part is computed only from the ground around it, so that neighbouring tiles have equal parts. Together
the parts of one tile are its frame: it fixes the surface and the mesh along the tile's edges.

Vertices lie at whole multiples of the spacing from the western or southern end of an edge, and are fine where
the edge is road. Both tiles read the same `Edge`, evaluate the same control points, and round the heights to
the same multiple of `VERTEX_GRAIN_M`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.borders import DECIMALS
from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Bools, Floats, HeightAt

GRAIN_M = 2.0**-20
"""Control heights of a frame are multiples of this (m), so that rounding errors of a CPU do not remain."""
VERTEX_GRAIN_M = 2.0**-12
"""Heights on the border are multiples of this (m). Relative to a whole-metre datum they are exact in the
float32 of GLB files."""
SAME_M = 0.02
"""Ends of lines within this distance of a vertex on the border end in it (m)."""
NUDGE = 1e-6
"""Share of a cell, larger than the rounding error of its edge's coordinates."""


@dataclass(frozen=True, eq=False)
class Corner:
    """The control points that act on a corner of tiles."""

    control: Floats
    """Control heights, ``(q, p)``, m; row 0 in the south. NaN if there is no ground to fit."""
    outside: Bools
    """Whether the four cells around it lie beyond the survey, ``(2, 2)``; row 0 in the north."""
    levels: tuple[tuple[int, Corner], ...] = ()
    """Number and corner of each other level near it; the corner itself belongs to level 0."""

    def at(self, number: int) -> Corner:
        """Return the corner of a level, or of level 0 if the level has none."""
        return dict(self.levels).get(number, self)


@dataclass(frozen=True, eq=False)
class Edge:
    """The control points that act on an edge but on none of its corners, and the classes along it."""

    control: Floats
    """Control heights, m: ``(q, n - p)`` for an edge to the east, ``(m - q, p)`` for an edge to the north;
    row 0 in the south. NaN if there is no ground to fit."""
    road: Bools
    """Whether the cells along the edge are road by the raw mask, from west to east or south to north: the
    cells to the south or east of it."""
    kept: Bools
    """Whether these cells are road by the filtered mask."""
    outside: Bools
    """Whether the cells along the edge lie beyond the survey, ``(2, cells)``: cells in the north or west of
    it, and cells in the south or east. The corners decide on the cells at its ends, for both edges there."""

    crossings: Floats
    """Where the outline of roads from vectors crosses the edge, ``(n,)``: ascending, m from the start. Empty
    if the roads are cells."""
    steps: Floats | None = None
    """Step of the surface on the edge at each pair of cells, ``(cells,)``, m, from west to east or south to
    north; None if the surface has no steps (`tasks.spline.stepped`)."""
    road_m: Floats | None = None
    """Distance of the nearer of the two cells to the nearest road cell of the raw mask, ``(cells,)``, m; with
    ``steps``."""
    levels: tuple[tuple[int, Edge], ...] = ()
    """Number and edge of each other level near it; the edge itself belongs to level 0. Crossings of a level
    are crossings of the outline of its decks; crossings on abutments are also crossings of level 0."""

    def at(self, number: int) -> Edge:
        """Return the edge of a level, or of level 0 if the level has none."""
        return dict(self.levels).get(number, self)

    def steps_beyond(self, distance_m: float, cells: int) -> Floats:
        """Return the steps, ``(cells,)``, m: 0 within a distance of road cells, and without steps."""
        if self.steps is None or self.road_m is None:
            return np.zeros(cells)
        return np.where(self.road_m <= distance_m, 0.0, self.steps)

    @property
    def inside(self) -> Bools:
        """Whether the cells on both sides lie within the survey."""
        return np.asarray(~self.outside.any(axis=0))

    @property
    def limits(self) -> NDArray[np.intp]:
        """Positions (in cells from the start of the edge) at which the mesh of one of its tiles ends."""
        changes = (self.outside[:, 1:] != self.outside[:, :-1]).any(axis=0)
        return np.flatnonzero(changes) + 1


@dataclass(frozen=True, eq=False)
class Frame:
    """The corners and edges of one tile."""

    south_west: Corner
    south_east: Corner
    north_west: Corner
    north_east: Corner
    south: Edge
    north: Edge
    west: Edge
    east: Edge

    def at(self, number: int) -> Frame:
        """Return the frame of a level: its corners and edges, or level 0 where the level has none."""
        return Frame(*(getattr(self, field.name).at(number) for field in fields(self)))

    def control(self, shape: tuple[int, int]) -> Floats:
        """Return the control heights of a tile's surface, ``shape``; NaN where the frame leaves them free."""
        q, p = self.south_west.control.shape
        heights = np.full(shape, np.nan)
        heights[:q, :p], heights[:q, -p:] = self.south_west.control, self.south_east.control
        heights[-q:, :p], heights[-q:, -p:] = self.north_west.control, self.north_east.control
        heights[:q, p:-p], heights[-q:, p:-p] = self.south.control, self.north.control
        heights[q:-q, :p], heights[q:-q, -p:] = self.west.control, self.east.control
        return heights

    def steps(self, shape: tuple[int, int], beyond_m: float = 0.0) -> tuple[Floats, Floats]:
        """Return the steps of a tile's surface on its border, 0 up to a distance from road cells, m.

        - `south_north` ``(2, W)``: on the southern and the northern edge, from west to east.
        - `west_east` ``(2, H)``: on the western and the eastern edge, from north to south.
        """
        rows, cols = shape
        south_north = [edge.steps_beyond(beyond_m, cols) for edge in (self.south, self.north)]
        west_east = [edge.steps_beyond(beyond_m, rows)[::-1] for edge in (self.west, self.east)]
        return np.stack(south_north), np.stack(west_east)

    def outside(self, cells: Bools) -> Bools:
        """Return the cells of the tile beyond the survey, ``(H, W)``; edges decide on the cells along them.

        A void can be closed in the ground around the tile, but open in the ground around an edge.
        """
        result = cells.copy()
        result[0], result[-1] = self.north.outside[1], self.south.outside[0]
        result[:, 0], result[:, -1] = self.west.outside[1, ::-1], self.east.outside[0, ::-1]
        return result

    def road(self, cells: Bools, raw: bool) -> Bools:
        """Return the road cells of the tile, ``(H, W)``; edges decide on the cells along them.

        The outline of the road then crosses an edge at the same places in both of its tiles.
        """
        south, north, west, east = (
            edge.road if raw else edge.kept for edge in (self.south, self.north, self.west, self.east)
        )
        result = cells.copy()
        result[:, 0], result[:, -1] = west[::-1], east[::-1]
        result[0], result[-1] = north, south
        return result


def rounded(heights: np.ndarray) -> Floats:
    """Return control heights as multiples of `GRAIN_M`."""
    return np.asarray(np.round(heights / GRAIN_M) * GRAIN_M)


def border_heights(height: HeightAt, easting: Floats, northing: Floats) -> Floats:
    """Return the heights of vertices on the border (m).

    Heights are evaluated point by point, because last digits of a matrix product depend on the other points.
    """
    return np.asarray(np.round(height(easting, northing) / VERTEX_GRAIN_M) * VERTEX_GRAIN_M)


def border_points(
    frame: Frame,
    local: Bounds,
    cell: float,
    fine: Sequence[Floats],
    coarse: Sequence[Floats],
    raw: bool,
    apart_m: float,
) -> Floats:
    """Return the vertices on the border of a tile, ``(n, 2)``; corners are included twice.

    They include the places where the mesh of the tile or its neighbour ends with the survey, and crossings
    of road outlines with the border.

    - `frame`: has the road cells along the border.
    - `local`: west, south, east and north of the tile (m).
    - `cell`: cell size (m).
    - `fine`, `coarse`: distances of possible vertices from the start of an edge, along easting and along
      northing (m): on the road and elsewhere. Both have the edge's two ends.
    - `raw`: whether the raw road mask is used, with its outlines, instead of the filtered mask.
    - `apart_m`: other vertices are left out within this distance of such a place (m).
    """
    sides = []
    for edge, axis, at in _edges(frame, local):
        # As everywhere, a vertex between two cells belongs to the eastern or southern cell.
        nudge = NUDGE * cell * (1 if axis == 0 else -1)
        road = edge.road if raw else edge.kept
        on_road, elsewhere = (_at(road, (t[axis] + nudge) / cell) for t in (fine, coarse))
        regular = np.concatenate([fine[axis][on_road], coarse[axis][~elsewhere]])
        ends = coarse[axis][[0, -1]]
        marks = np.round(edge.limits * cell, DECIMALS)
        if raw:
            marks = np.concatenate([marks, edge.crossings[apart(edge.crossings, marks, SAME_M)]])
        marks = np.sort(marks[apart(marks, ends, SAME_M)])
        marks = marks[np.diff(marks, prepend=-np.inf) >= SAME_M]
        along = np.unique(np.concatenate([regular[apart(regular, marks, apart_m)], marks, ends]))
        sides.append(_placed(along, ends, axis, at, local))
    return np.concatenate(sides)


def _placed(along: Floats, ends: Floats, axis: int, at: float, local: Bounds) -> Floats:
    """Return positions on an edge as points of the tile, ``(n, 2)``."""
    along = np.where(along == ends[1], local[axis + 2], local[axis] + along)
    across = np.full_like(along, at)
    return np.stack([along, across] if axis == 0 else [across, along], axis=1)


def apart(positions: Floats, others: Floats, distance_m: float) -> Bools:
    """Return which positions on a line, ``(n,)``, have a distance (m) from all others, ``(m,)``."""
    away = np.abs(positions[:, None] - others).min(axis=1, initial=np.inf)
    return np.asarray(away >= distance_m)


def on_border(points: Floats, local: Bounds) -> Bools:
    """Return which points, ``(n, 2 or more)``, lie on the border of a tile."""
    west, south, east, north = local
    x, y = points[:, 0], points[:, 1]
    border: Bools = (x == west) | (x == east) | (y == south) | (y == north)
    return border


def joined(points: Floats, faces: NDArray[np.int32], frame: Frame, local: Bounds, cell: float) -> Bools:
    """Return the faces along the parts of the border that lie within the survey, ``(F,)``.

    They are part of the mesh, because the neighbour has a face on the other side. The tile alone might take
    the ground there as outside.
    """
    result = np.zeros(len(faces), np.bool_)
    for edge, axis, at in _edges(frame, local):
        on_edge = (points[:, 1 - axis] == at)[faces]
        middle = np.where(on_edge, points[:, axis][faces] - local[axis], 0.0).sum(axis=1) / 2
        result |= (on_edge.sum(axis=1) == 2) & _at(edge.inside, middle / cell)
    return result


def _edges(frame: Frame, local: Bounds) -> Iterator[tuple[Edge, int, float]]:
    """Yield each edge, the axis along which it runs (0 is easting), and its position on the other axis."""
    west, south, east, north = local
    yield from (
        (frame.south, 0, south),
        (frame.north, 0, north),
        (frame.west, 1, west),
        (frame.east, 1, east),
    )


def _at(cells: Bools, position: Floats) -> Bools:
    """Return the values of the cells along an edge at positions counted in cells."""
    return np.asarray(cells[np.clip(np.floor(position).astype(np.intp), 0, len(cells) - 1)])
