"""Delaunay triangulation in plan, and the same with given edges.

A missing edge is inserted as follows (Anglada 1997): the faces that it crosses are removed, and the polygons
on both sides are triangulated again. No point is added.

The squares of a lattice need no search: their corners lie on one circle. If no other point lies in it, both
diagonals give two faces of a Delaunay triangulation. If one corner has no point, the other three are a face.
Where such faces are side by side, only the points on the outer edge of their area are needed for the other
faces: these edges are part of every Delaunay triangulation of the points outside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import startinpy
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.meshing.lines import middles
from flexroad.tasks.types import Bools, Floats

SNAP_TOLERANCE_M = 1e-9
"""Points closer to each other than this are one point (m); callers give points that are farther apart."""

Faces = NDArray[np.int32]
Edges = NDArray[np.intp]
Lattice = tuple[tuple[float, float], float]
"""South-western node (x, y) and step of a lattice (m); all points lie north-east of the node."""
ON_LATTICE = 1e-5
"""Points closer than this to a node (share of the step) are on it, because offsets are rounded to 1e-6 m."""
WITHOUT = ((1, 3, 2), (0, 3, 2), (0, 1, 3), (0, 1, 2))
"""The corners of a square without one of them, counter-clockwise; in the order of `_corners`."""


def delaunay(points: Floats, lattices: Sequence[Lattice] = ()) -> Faces:
    """Return the faces of a Delaunay triangulation in plan, ``(F, 3)``, counter-clockwise.

    Points of a lattice are cocircular. The triangulation is unique by the order of insertion (corners of the
    bounding box, then by northing and easting) and, in the squares of the lattices, by one diagonal.

    - `points` ``(n, 2 or more)``: no two points have the same place in plan.
    - `lattices`: lattices on which many of the points lie. Their full squares are triangulated without a
      search.
    """
    filled = [squares(points, *lattice) for lattice in lattices]
    needed = np.ones(len(points), np.bool_)
    for part in filled:
        needed[part.inner] = False
    rest = _searched(points[needed])
    rest = np.flatnonzero(needed).astype(np.int32)[rest]
    for part in filled:
        rest = rest[~part.contains(middles(points, rest))]
    return np.concatenate([*(part.faces for part in filled), rest])


def _searched(points: Floats) -> Faces:
    """Return the faces of the Delaunay triangulation of points in any place, ``(F, 3)``."""
    plan = np.zeros((len(points), 3))
    plan[:, :2] = points[:, :2]
    triangulation = startinpy.DT()
    triangulation.snap_tolerance = SNAP_TOLERANCE_M
    triangulation.insert(plan, insertionstrategy="BBox")
    # Vertex 0 of startinpy is at infinity; the points follow in the order of insertion.
    faces: Faces = triangulation.triangles.astype(np.int32) - 1
    # The object must be deleted in the thread that created it. A sampling profiler such as Dask's may keep
    # this frame and its locals alive in another thread.
    del triangulation
    return faces


def constrained(points: Floats, segments: Edges, lattices: Sequence[Lattice] = ()) -> Faces:
    """Return the faces of a triangulation in plan that has the segments as edges, ``(F, 3)``.

    - `points` ``(n, 2 or more)``: no two at the same place in plan.
    - `segments` ``(m, 2)``: numbers of the points at their ends. A segment through a point becomes two edges.
      A segment that crosses an earlier segment is left out.
    - `lattices`: lattices on which many of the points lie.
    - result ``(F, 3)``: counter-clockwise; except at the segments it is a Delaunay triangulation.
    """
    faces = delaunay(points, lattices)
    if not len(segments):
        return faces
    missing = segments[~_has_edges(faces, segments, len(points))]
    if not len(missing):
        return faces
    concerned = _beside(points, faces, missing)
    star = _Star(points, faces[concerned], segments)
    for a, b in missing.tolist():
        star.insert(a, b)
    return np.concatenate([faces[~concerned], star.faces])


def _has_edges(faces: Faces, segments: Edges, count: int) -> NDArray[np.bool_]:
    """Return which segments, ``(m, 2)``, are edges of the faces."""
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    wanted = np.sort(segments, axis=1)
    keys, wanted_keys = (np.asarray(p, np.int64) @ [count, 1] for p in (pairs, wanted))
    return np.isin(wanted_keys, keys)


def _beside(points: Floats, faces: Faces, segments: Edges) -> NDArray[np.bool_]:
    """Return the faces whose bounding box meets the box of a segment, ``(F,)``, such as crossed faces."""
    corners, ends = points[faces, :2], points[segments, :2]
    return _meeting(corners.min(axis=1), corners.max(axis=1), ends.min(axis=1), ends.max(axis=1))


@compiled()
def _meeting(low: Floats, high: Floats, segment_low: Floats, segment_high: Floats) -> Bools:
    """Return which rectangles, by two corners each, ``(F, 2)``, meet a rectangle of a segment, ``(m, 2)``."""
    result = np.zeros(len(low), np.bool_)
    for f in range(len(low)):
        west, south, east, north = low[f, 0], low[f, 1], high[f, 0], high[f, 1]
        for s in range(len(segment_low)):
            if (
                west <= segment_high[s, 0]
                and east >= segment_low[s, 0]
                and south <= segment_high[s, 1]
                and north >= segment_low[s, 1]
            ):
                result[f] = True
                break
    return result


class _Star:
    """A triangulation in which faces are looked up by their directed edges."""

    def __init__(self, points: Floats, faces: Faces, segments: Edges) -> None:
        self.x: list[float] = points[:, 0].tolist()
        self.y: list[float] = points[:, 1].tolist()
        self.apex: dict[tuple[int, int], int] = {}
        """The third vertex of the face on the left of an edge."""
        self.neighbour: dict[int, int] = {}
        """The other end of an edge of each vertex."""
        self.kept = {(min(a, b), max(a, b)) for a, b in segments.tolist()}
        """Edges that are not to be removed."""
        for face in faces.tolist():
            self._add(*face)

    @property
    def faces(self) -> Faces:
        """The faces, each beginning with its smallest vertex, in ascending order."""
        ordered = sorted((a, b, c) for (a, b), c in self.apex.items() if a < b and a < c)
        return np.array(ordered, np.int32).reshape(-1, 3)

    def insert(self, a: int, b: int) -> None:
        """Make the segment an edge, or several edges if it passes through points."""
        while a != b:
            crossed = self._crossed(a, b)
            if crossed is None:
                return
            end, removed, left, right = crossed
            if removed:
                added = [*self._fill(left, a, end), *self._fill(right[::-1], end, a)]
                # Rounding may leave no room for a face; the triangulation is then unchanged.
                if min(self._side(*face) for face in added) <= 0.0:
                    return
                for p, q, r in removed:
                    for edge in ((p, q), (q, r), (r, p)):
                        del self.apex[edge]
                for face in added:
                    self._add(*face)
            self.kept.add((min(a, end), max(a, end)))
            a = end

    def _add(self, a: int, b: int, c: int) -> None:
        for p, q, r in ((a, b, c), (b, c, a), (c, a, b)):
            self.apex[p, q] = r
            self.neighbour[p] = q

    def _side(self, a: int, b: int, c: int) -> float:
        """Return twice the area of the face a, b, c; negative if c is on the right of a to b."""
        x, y = self.x, self.y
        return (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])

    def _crossed(self, a: int, b: int) -> tuple[int, list[tuple[int, int, int]], list[int], list[int]] | None:
        """Return the first vertex on the segment after a, the faces crossed before it, the vertices beside.

        The vertices are listed on the left and on the right, each from a on. None if the segment crosses an
        edge that must stay.
        """
        start = self._first_face(a, b)
        if start is None:
            return None
        right, left = start
        if b in start:
            return b, [], [], []
        for vertex in start:
            if self._side(a, b, vertex) == 0.0:
                return vertex, [], [], []
        removed, on_left, on_right = [(a, right, left)], [left], [right]
        while True:
            if (min(left, right), max(left, right)) in self.kept or (left, right) not in self.apex:
                return None
            vertex = self.apex[left, right]
            removed.append((left, right, vertex))
            side = self._side(a, b, vertex)
            if vertex == b or side == 0.0:
                return vertex, removed, on_left, on_right
            if side > 0:
                left = vertex
                on_left.append(left)
            else:
                right = vertex
                on_right.append(right)

    def _first_face(self, a: int, b: int) -> tuple[int, int] | None:
        """Return the other two vertices of the face at a that the segment crosses first."""
        start = v = self.neighbour[a]
        while (v, a) in self.apex and self.apex[v, a] != start:
            v = self.apex[v, a]  # clockwise, up to the rim of the triangulation or once around
        start = v
        while (a, v) in self.apex:
            w = self.apex[a, v]
            if self._side(a, v, b) >= 0.0 >= self._side(a, w, b):
                return v, w
            v = w
            if v == start:
                break
        return None

    def _fill(self, chain: Sequence[int], a: int, b: int) -> list[tuple[int, int, int]]:
        """Return the faces between the edge from a to b and a chain of vertices on its left, from a to b."""
        faces, open_parts = [], [(list(chain), a, b)]
        while open_parts:
            part, a, b = open_parts.pop()
            if not part:
                continue
            best = 0
            for i in range(1, len(part)):
                if self._in_circle(a, b, part[best], part[i]):
                    best = i
            c = part[best]
            faces.append((a, b, c))
            open_parts += [(part[:best], a, c), (part[best + 1 :], c, b)]
        return faces

    def _in_circle(self, a: int, b: int, c: int, d: int) -> bool:
        """Return whether d lies inside the circle through a, b and c (counter-clockwise)."""
        x, y = self.x, self.y
        rows = [(x[p] - x[d], y[p] - y[d]) for p in (a, b, c)]
        (ax, ay), (bx, by), (cx, cy) = rows
        aa, bb, cc = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
        return ax * (by * cc - cy * bb) - ay * (bx * cc - cx * bb) + aa * (bx * cy - cx * by) > 0.0


@dataclass(frozen=True, eq=False)
class Squares:
    """The squares of a lattice with points at four or three of their corners, and no other point nearby."""

    corner: tuple[float, float]
    """X and y of the south-western node (m)."""
    step: float
    """Side of a square (m)."""
    numbers: NDArray[np.int32]
    """Number of the point at each node, -1 without a point, ``(n + 1, m + 1)``, row 0 in the south."""
    clear: Bools
    """The squares whose circle has no point except at their corners, ``(n, m)``."""

    @cached_property
    def full(self) -> Bools:
        """The squares with four points, ``(n, m)``."""
        return np.asarray(self.clear & (self._count == 4))

    @cached_property
    def halves(self) -> list[Bools]:
        """The squares that lack the point at one corner, ``(n, m)`` for each corner."""
        three = self.clear & (self._count == 3)
        return [three & (part < 0) for part in _corners(self.numbers)]

    @cached_property
    def _count(self) -> NDArray[np.int8]:
        """Number of points at the corners of each square."""
        occupied = (self.numbers >= 0).astype(np.int8)
        return np.asarray(sum(_corners(occupied)))

    @property
    def faces(self) -> NDArray[np.int32]:
        """Two faces per full square, cut from north-west to south-east, and halves, ``(F, 3)``.

        They are counter-clockwise.
        """
        corners = _corners(self.numbers)
        parts = [(self.full, WITHOUT[3]), (self.full, WITHOUT[0]), *zip(self.halves, WITHOUT, strict=True)]
        return np.concatenate(
            [np.stack([corners[k][where] for k in chosen], axis=-1) for where, chosen in parts]
        )

    @property
    def inner(self) -> NDArray[np.int32]:
        """Numbers of the points surrounded by faces of the squares; no other face needs them."""
        # A half square fills the angle at the corner opposite to the missing corner.
        filled = (_corners(self.full | half)[k] for k, half in enumerate(self.halves))
        return self.numbers[1:-1, 1:-1][np.logical_and.reduce(list(filled))]

    def contains(self, places: Floats) -> Bools:
        """Return which places, ``(n, 2)``, lie inside a face and not on its edge, ``(n,)``."""
        place = (places - self.corner) / self.step
        column, row = np.floor(place).astype(np.intp).T
        x, y = (place - np.floor(place)).T
        rows, columns = self.full.shape
        at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        beyond = (x + y > 1, y > x, x > y, x + y < 1)
        result = self.full[at]
        for half, in_face in zip(self.halves, beyond, strict=True):
            result |= half[at] & in_face
        return np.asarray(result & (row == at[0]) & (column == at[1]))


def squares(points: Floats, corner: tuple[float, float], step: float) -> Squares:
    """Return the squares of a lattice that have points only at their corners.

    - `points` ``(n, 2 or more)``: no two have the same place in plan; none lies west or south of the corner.
    - `corner`: X and y of the south-western node (m).
    - `step`: distance of the nodes (m).
    """
    place = (points[:, :2] - corner) / step
    nearest = np.rint(place)
    column, row = nearest.astype(np.intp).T
    on_node = np.flatnonzero((np.abs(place - nearest) < ON_LATTICE).all(axis=1))
    numbers = np.full((row.max() + 2, column.max() + 2), -1, np.int32)
    numbers[row[on_node], column[on_node]] = on_node
    # A second point at a node is not in `numbers`, and is treated as off the lattice.
    off_node = numbers[row, column] != np.arange(len(points))
    clear = np.ones((numbers.shape[0] - 1, numbers.shape[1] - 1), np.bool_)
    # The circle of a square lies within it and the eight squares around it.
    column, row = np.floor(place[off_node]).astype(np.intp).T
    for down in (-1, 0, 1):
        for left in (-1, 0, 1):
            rows, columns = row + down, column + left
            valid = (rows >= 0) & (rows < clear.shape[0]) & (columns >= 0) & (columns < clear.shape[1])
            clear[rows[valid], columns[valid]] = False
    return Squares(corner, step, numbers, clear)


def _corners(nodes: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return the south-western, south-eastern, north-western and north-eastern nodes of all squares."""
    return nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
