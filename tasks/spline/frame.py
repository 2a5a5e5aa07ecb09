"""What tiles share along their borders: control points, and where the border is road.

Every part is computed from the ground around it alone, so that neighbouring tiles hold equal parts. Together
the parts of one tile are its frame: it fixes the surface and the mesh along the tile's edges.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Bools, Floats

GRAIN_M = 2.0**-20
"""Control heights of a frame are multiples of this (m), so that rounding errors of a CPU do not remain."""


@dataclass(frozen=True, eq=False)
class Corner:
    """The control points that act on a corner of tiles."""

    control: Floats
    """Control heights, ``(q, p)``, m; row 0 in the south. NaN if there is no ground to fit."""
    outside: Bools
    """Whether the four cells around it lie beyond the survey, ``(2, 2)``; row 0 in the north."""
    levels: tuple[tuple[int, Corner], ...] = ()
    """Number and corner of each other level near it; its own control points are those of level 0."""

    def at(self, number: int) -> Corner:
        """Return the corner of a level, that of level 0 if it has none."""
        return dict(self.levels).get(number, self)


@dataclass(frozen=True, eq=False)
class Edge:
    """The control points that act on an edge but on none of its corners, and the classes along it."""

    control: Floats
    """Control heights, ``(q, n - p)`` of an edge to the east and ``(m - q, p)`` of one to the north, m; row 0
    in the south. NaN if there is no ground to fit."""
    road: Bools
    """Whether the cells along the edge are road by the raw mask, from west to east or south to north: the
    cells to the south or east of it."""
    kept: Bools
    """The same by the filtered mask."""
    outside: Bools
    """Whether the cells along the edge lie beyond the survey, ``(2, cells)``: those in the north or west of
    it, and those in the south or east. The cells at its ends are as its corners say, for both edges there."""

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
    """Number and edge of each other level near it; its own control points, classes and steps are those of
    level 0. Crossings of a level are those of the outline of its decks; those on abutments are also among the
    crossings of level 0."""

    def at(self, number: int) -> Edge:
        """Return the edge of a level, that of level 0 if it has none."""
        return dict(self.levels).get(number, self)

    def steps_beyond(self, distance_m: float, cells: int) -> Floats:
        """Return the steps, ``(cells,)``, m: 0 within a distance of road cells, and if there are none."""
        if self.steps is None or self.road_m is None:
            return np.zeros(cells)
        return np.where(self.road_m <= distance_m, 0.0, self.steps)

    @property
    def inside(self) -> Bools:
        """Whether the cells on both sides lie within the survey."""
        return np.asarray(~self.outside.any(axis=0))

    @property
    def limits(self) -> NDArray[np.intp]:
        """Numbers of cells from the start of the edge at which the mesh of one of its tiles ends."""
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
        """Return the frame of a level: its corners and edges, or those of level 0 where it has none."""
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
        """Return the cells of the tile beyond the survey, ``(H, W)``; those along the edges are as these say.

        A void can be closed in the ground around the tile, and open in that around an edge.
        """
        result = cells.copy()
        result[0], result[-1] = self.north.outside[1], self.south.outside[0]
        result[:, 0], result[:, -1] = self.west.outside[1, ::-1], self.east.outside[0, ::-1]
        return result

    def road(self, cells: Bools, raw: bool) -> Bools:
        """Return the road cells of the tile, ``(H, W)``; those along the edges are as these say.

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
