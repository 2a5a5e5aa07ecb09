"""Points of meshes: lattices, unique points, centroids of faces, and lines that become edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Bools, Floats

GRID_M = 2.0**-8
"""Where lines cross, points are moved to multiples of this (m), so that no two points are too close."""
AT_BORDER_M = 0.005
"""Points of lines within this distance of the border lie on it (m); larger than the moves at crossings."""
DECIMALS = 6
"""Decimals (of a metre) to which lattice offsets are rounded, so that 3 * 0.1 m equals 1 * 0.3 m."""
SNAP_M = 1e-3
"""The last line of a lattice is moved onto the border if it is closer to it than this (m)."""


def axis(start: float, stop: float, step: float, to_end: bool) -> Floats:
    """Return ``start``, ``start + step``, ... up to ``stop``; ``to_end`` adds ``stop`` if it is missing."""
    count = int(np.floor((stop - start + SNAP_M) / step))
    positions = start + np.round(np.arange(1, count + 1) * step, DECIMALS)
    positions = np.concatenate([[start], positions])
    if stop - positions[-1] <= SNAP_M:
        positions[-1] = stop
    elif to_end:
        positions = np.append(positions, stop)
    return positions


def without_duplicates(points: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return points by northing, then easting, each place once, and the new numbers of the given points."""
    order = _by_northing(points)
    ordered = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (ordered[1:, :2] != ordered[:-1, :2]).any(axis=1)
    number = np.empty(len(points), np.intp)
    number[order] = np.cumsum(first) - 1
    return ordered[first], number


def _by_northing(points: Floats) -> NDArray[np.intp]:
    """Return the order of points by northing, then easting."""
    x, y = np.ascontiguousarray(points[:, :2].T)
    # A stable sort of one number is fast, because the points come in a few ordered parts. Rounding makes the
    # order wrong if two points with nearly the same northing are nearly at the same place.
    order = np.argsort(y * 2.0 ** np.ceil(np.log2(np.abs(x).max() + 1.0) + 1.0) + x, kind="stable")
    x, y = x[order], y[order]
    ordered = (y[:-1] < y[1:]) | ((y[:-1] == y[1:]) & (x[:-1] <= x[1:]))
    return order if ordered.all() else np.lexsort((points[:, 0], points[:, 1]))


def middles(points: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the centroids of faces in plan, ``(F, 2)``."""
    a, b, c = faces.T
    # Three short sums are several times faster than numpy's sum over an axis of length three.
    axes = np.ascontiguousarray(points[:, :2].T)
    return np.stack([(axis[a] + axis[b] + axis[c]) / 3.0 for axis in axes], axis=1)


def parts_of(lines: shapely.MultiLineString) -> NDArray[np.object_]:
    """Return lines as an array."""
    return np.asarray(shapely.get_parts(lines))


def divided(
    lines: shapely.MultiLineString, fine_m: float, coarse_m: float, is_fine: Callable[[Floats], Bools]
) -> NDArray[np.object_]:
    """Return lines with additional points, as an array of lines.

    - `fine_m`, `coarse_m`: largest distance of points where ``is_fine``, and elsewhere (m).
    - `is_fine`: returns for points, ``(n, 2)``, whether lines are fine there, ``(n,)``.
    """
    pieces = shapely.linestrings(_segments(shapely.segmentize(lines, coarse_m)))
    dense = shapely.segmentize(pieces, fine_m)
    places, piece = shapely.get_coordinates(dense, return_index=True)
    chosen = np.bincount(piece, is_fine(places), len(pieces)) > 0
    return np.asarray(np.where(chosen, dense, pieces))


def ends_at_border(lines: Sequence[NDArray[np.object_]], local: Bounds) -> Floats:
    """Return the points of lines on the border of a tile, moved exactly onto it, ``(n, 2)``."""
    points = np.unique(_segments(_noded(lines)).reshape(-1, 2), axis=0)
    moved, at_border = _moved(points, local)
    return moved[at_border]


def apart_from(points: Floats, lines: Sequence[NDArray[np.object_]], distance_m: float) -> Bools:
    """Return which points, ``(n, 2 or more)``, are not within a distance (m) of the lines, ``(n,)``."""
    if not lines:
        return np.ones(len(points), np.bool_)
    every = shapely.multilinestrings(np.concatenate(lines))
    shapely.prepare(every)
    return np.asarray(~shapely.dwithin(every, shapely.points(points[:, :2]), distance_m))


def points_and_segments(
    lines: Sequence[NDArray[np.object_]], border: Floats, local: Bounds, same_m: float
) -> tuple[Floats, NDArray[np.intp]]:
    """Return the points of lines, ``(n, 2)``, and the segments between them, ``(m, 2)``.

    - `lines`: lines within the tile.
    - `border` ``(b, 2)``: the vertices on the border of the tile. Lines that reach the border end in the
      nearest vertex, or before the border if no vertex is near.
    - `local`: west, south, east and north of the tile (m). Segments along this border are left out.
    - `same_m`: largest distance of such a vertex (m).
    """
    if not lines:
        return np.empty((0, 2)), np.empty((0, 2), np.intp)
    segments = _segments(_noded(lines))
    points, number = np.unique(segments.reshape(-1, 2), axis=0, return_inverse=True)
    _, at_border = _moved(points, local)
    reached = np.flatnonzero(at_border)
    lost = np.zeros(len(points), np.bool_)
    lost[reached] = True
    if len(border):
        away = np.linalg.norm(points[reached, None] - border, axis=2)
        points[reached] = border[away.argmin(axis=1)]
        lost[reached] = away.min(axis=1) > same_m
    pairs = number.reshape(-1, 2)
    pairs = pairs[~lost[pairs].any(axis=1)]
    points, number = np.unique(points, axis=0, return_inverse=True)
    pairs = np.unique(np.sort(number.reshape(-1)[pairs], axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    # Along the border only its own vertices are used: the neighbour has the same vertices.
    along = (points[pairs][..., [0, 1, 0, 1]] == np.array(local)).all(axis=1).any(axis=1)
    return points, pairs[~along]


def _noded(lines: Sequence[NDArray[np.object_]]) -> shapely.Geometry:
    """Return lines whose only common points are ends."""
    every = shapely.multilinestrings(np.concatenate(lines))
    return every if len(lines) == 1 else shapely.union_all(every, grid_size=GRID_M)


def _segments(lines: shapely.Geometry) -> Floats:
    """Return the segments of lines, ``(n, 2, 2)``."""
    points, line = shapely.get_coordinates(shapely.get_parts(lines), return_index=True)
    joined = line[1:] == line[:-1]
    return np.stack([points[:-1][joined], points[1:][joined]], axis=1)


def _moved(points: Floats, local: Bounds) -> tuple[Floats, Bools]:
    """Return points, moved onto the border if they are close to it, and which points lie on it."""
    moved = points.copy()
    at_border = np.zeros(len(points), np.bool_)
    for axis, at in zip((0, 1, 0, 1), local, strict=True):
        near = np.abs(points[:, axis] - at) <= AT_BORDER_M
        moved[near, axis] = at
        at_border |= near
    return moved, at_border
