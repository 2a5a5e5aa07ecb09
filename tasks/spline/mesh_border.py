"""The border of a tile's mesh: vertices and faces that fit those of the neighbouring tiles exactly.

Vertices lie at whole multiples of the spacing from the western or southern end of an edge, and are fine where
the edge is road. Both tiles read that from the same `Edge`, evaluate the same control points, and round the
heights to the same multiple of `GRAIN_M`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.borders import DECIMALS
from flexroad.catalog.grid import Bounds
from flexroad.tasks.spline.frame import Edge, Frame
from flexroad.tasks.types import Bools, Floats, HeightAt

GRAIN_M = 2.0**-12
"""Heights on the border are multiples of this (m): relative to a whole-metre datum they are exact in the
float32 of GLB files."""
SAME_M = 0.02
"""Ends of lines within this distance of a vertex on the border end in it (m)."""
NUDGE = 1e-6
"""Share of a cell, larger than the rounding error of its edge's coordinates."""


def border_heights(height: HeightAt, easting: Floats, northing: Floats) -> Floats:
    """Return the heights of vertices on the border (m).

    They are evaluated point by point: the last digits of a matrix product depend on the other points.
    """
    return np.asarray(np.round(height(easting, northing) / GRAIN_M) * GRAIN_M)


def border_points(
    frame: Frame,
    local: Bounds,
    cell: float,
    fine: Sequence[Floats],
    coarse: Sequence[Floats],
    raw: bool,
    apart_m: float,
) -> Floats:
    """Return the vertices on the border of a tile, ``(n, 2)``; corners are in it twice.

    Among them are the places where the meshes of the tile or its neighbour end with the survey, and where the
    outline of a road crosses the border.

    - `frame`: tells where the border is road.
    - `local`: west, south, east and north of the tile (m).
    - `cell`: cell size (m).
    - `fine`, `coarse`: distances of possible vertices from the start of an edge, along easting and along
      northing (m): on the road and elsewhere. Both have the edge's two ends.
    - `raw`: whether the raw road mask counts, with its outlines, instead of the filtered one.
    - `apart_m`: other vertices are left out within this distance of such a place (m).
    """
    sides = []
    for edge, axis, at in _edges(frame, local):
        # As everywhere, a vertex between two cells belongs to the eastern or southern one.
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
    """Return the faces along those parts of the border that lie within the survey, ``(F,)``.

    They are part of the mesh although the tile alone may count the ground there as outside: the neighbour's
    face on the other side is there as well.
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
