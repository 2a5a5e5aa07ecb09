"""Check of a mesh: a height field triangulated once, with at most one face over any place.

The number w(p) of faces over a place p (not on an edge) is shown to be 0 or 1 as follows. All faces are
counter-clockwise, so w(p) is the sum of the winding numbers of their outlines around p. An edge of two faces
is passed once in each direction and cancels out. The rim, which is the edges of one face, remains: w is the
winding number of the rim. It is constant in every part of the plan without rim. It is smaller by one on the
right of a rim edge than on its left. Rim edges meet only at common ends, so each side of an edge belongs to
one part. The middle of every edge has 0 faces on its right, hence 1 on its left. Every part borders on an
edge, so w is 0 or 1 everywhere.

So no two faces overlap. A vertex of a face is not inside another face or edge: its own face would overlap the
other, or it is the end of a rim edge that touches another. For the same reason only vertices of the rim can
share a place, and only these are compared. The sum of the areas and the area in the rim are not compared,
because they are equal with overlaps, too.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import MeshFault
from flexroad.tasks.metrics.dihedral import edges
from flexroad.tasks.types import Bools, Floats, Mesh

ROUNDING = 3.3306690738754716e-16
"""Bound of the rounding error of a doubled area, relative to the sum of its two products (Shewchuk 1997)."""
ONLY_ENDS_MEET = "FF*F*****"
"""DE-9IM pattern of two lines whose only common points are ends of both."""

RIM, REPEATED = 1, 2
"""Kinds of edges: an edge of one face; an edge of two faces on the same side."""

Indices = NDArray[np.int64]


Fault = tuple[str, int, str]
"""Kind, number of faults, and index or place (easting and northing, m) of the first fault."""


def check(mesh: Mesh) -> None:
    """Check a mesh."""
    if found := faults(mesh):
        listed = ", ".join(f"{number} {kind} (the first at {place})" for kind, number, place in found)
        raise MeshFault(
            f"the mesh has {listed}; this is an error of FlexRoad, report it; "
            "other spacings (sample.road_m, sample.terrain_m) may avoid it"
        )


def faults(mesh: Mesh) -> tuple[Fault, ...]:
    """Return the faults of a mesh, one entry per kind; empty if it is a height field triangulated once.

    Each group of checks requires that the group before has no faults: numbers and indices, faces and
    vertices, overlaps. So only the faults of the first group with faults are returned.
    """
    for group in (_invalid_numbers, _invalid_parts, _overlaps):
        if found := tuple(group(mesh)):
            return found
    return ()


def _invalid_numbers(mesh: Mesh) -> Iterator[Fault]:
    vertices, faces = mesh.vertices, mesh.faces
    infinite = ~np.isfinite(vertices).all(axis=1)
    if infinite.any():
        yield "vertices that are not finite", int(infinite.sum()), f"vertex {infinite.argmax()}"
    if faces.min(initial=0) < 0 or faces.max(initial=-1) >= len(vertices):
        beyond = ((faces < 0) | (faces >= len(vertices))).any(axis=1)
        yield "faces with unknown vertices", int(beyond.sum()), f"face {beyond.argmax()}"


def _invalid_parts(mesh: Mesh) -> Iterator[Fault]:
    sides = _sides(mesh.vertices, mesh.faces)
    yield from _found("degenerate faces", sides == 0, mesh.faces, mesh)
    yield from _found("inverted faces", sides == -1, mesh.faces, mesh)
    unused = np.ones(len(mesh.vertices), np.bool_)
    unused[mesh.faces] = False
    yield from _found("unused vertices", unused, np.arange(len(unused))[:, None], mesh)


def _overlaps(mesh: Mesh) -> Iterator[Fault]:
    vertices, faces = mesh.vertices, mesh.faces
    ends, kinds = _directed(faces, *edges(faces, len(vertices)))
    rim = ends[kinds == RIM]
    once, lines = np.unique(rim)[:, None], vertices[rim, :2]
    findings = (
        ("edges with overlapping faces", lambda: kinds == REPEATED, ends),
        ("duplicate vertices", lambda: _repeated(vertices[once[:, 0], :2]), once),
        ("outline edges that cross or touch others", lambda: _crossing(lines), rim),
        ("outline edges under or over other faces", lambda: _covered(lines), rim),
    )
    for kind, find, parts in findings:
        if found := tuple(_found(kind, find(), parts, mesh)):
            yield from found
            return


def _found(kind: str, at: Bools, parts: NDArray[np.integer], mesh: Mesh) -> Iterator[Fault]:
    """Yield the faults of one kind; ``parts`` are vertices, edges or faces, ``(n, 1 to 3)``."""
    if at.any():
        east, north = mesh.vertices[parts[at.argmax()], :2].mean(axis=0) + mesh.origin[:2]
        yield kind, int(at.sum()), f"{east:.3f}, {north:.3f}"


@compiled()
def _sides(vertices: Floats, faces: NDArray[np.int32]) -> NDArray[np.int8]:
    """Return 1 for faces that face up, -1 for inverted faces, 0 for faces without an area, ``(F,)``."""
    sides = np.zeros(faces.shape[0], np.int8)
    for f in range(faces.shape[0]):
        ax, ay, _ = vertices[faces[f, 0]]
        bx, by, _ = vertices[faces[f, 1]]
        cx, cy, _ = vertices[faces[f, 2]]
        left, right = (bx - ax) * (cy - ay), (by - ay) * (cx - ax)
        bound = ROUNDING * (abs(left) + abs(right))
        if left - right > bound:
            sides[f] = 1
        elif left - right < -bound:
            sides[f] = -1
    return sides


@compiled()
def _directed(
    faces: NDArray[np.int32], start: NDArray[np.int32], far: NDArray[np.int32], owner: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Return for each edge of each face its ends, ``(n, 2)``, and `RIM`, `REPEATED` or 0, ``(n,)``.

    The face is on the left. If several faces pass an edge in the same direction, all but the first are
    `REPEATED`.
    """
    ends, kinds = np.empty((far.size, 2), np.int32), np.zeros(far.size, np.int8)
    for v in range(start.size - 1):
        for i in range(start[v], start[v + 1]):
            backward = False
            for k in range(3):
                backward |= faces[owner[i], k] == v and faces[owner[i], k - 1] == far[i]
            ends[i, int(backward)], ends[i, 1 - int(backward)] = v, far[i]
            kinds[i] = RIM
            for j in range(start[v], start[v + 1]):
                if j != i and far[j] == far[i]:
                    kinds[i] = 0
            for j in range(start[v], i):
                if far[j] == far[i] and ends[j, 0] == ends[i, 0]:
                    kinds[i] = REPEATED
    return ends, kinds


def _repeated(places: Floats) -> Bools:
    """Return which places, ``(n, 2)``, equal an earlier place; one of equal places is False."""
    order = np.lexsort((places[:, 0], places[:, 1]))
    result = np.zeros(len(places), np.bool_)
    result[order[1:]] = (places[order[1:]] == places[order[:-1]]).all(axis=1)
    return result


def _crossing(rim: Floats) -> Bools:
    """Return which edges, ``(n, 2, 2)``, share points with other edges that are not ends of both."""
    lines = shapely.linestrings(rim)
    result = np.zeros(len(rim), np.bool_)
    if not shapely.is_simple(shapely.multilinestrings(lines)):
        one, other = shapely.STRtree(lines).query(lines, predicate="intersects")
        one, other = one[one != other], other[one != other]
        result[one[~shapely.relate_pattern(lines[one], lines[other], ONLY_ENDS_MEET)]] = True
    return result


def _covered(rim: Floats) -> Bools:
    """Return which edges, ``(n, 2, 2)``, have faces on the right of their middles."""
    south = rim[..., 1].min(axis=1)
    order = np.argsort(south)
    ordered, south = np.ascontiguousarray(rim[order]), south[order]
    # A ray from a middle to the east crosses only edges that begin south of it, at most their length away.
    north, length = ordered[..., 1].mean(axis=1), np.ptp(ordered[..., 1], axis=1).max(initial=0.0)
    first, last = np.searchsorted(south, north - 1.001 * length), np.searchsorted(south, north, "right")
    result = np.zeros(len(rim), np.bool_)
    result[order] = _windings(ordered, first, last) != 0
    return result


@compiled()
def _windings(rim: Floats, first: Indices, last: Indices) -> Indices:
    """Return the winding number of the rim on the right of each edge's middle, ``(n,)``.

    Edges that a ray to the east crosses upward add 1, downward -1; a ray along an edge is taken as just
    north of it. The edges that can be crossed are ``first`` to ``last`` (exclusive).
    """
    result = np.zeros(rim.shape[0], np.int64)
    for i in range(rim.shape[0]):
        (ax, ay), (bx, by) = rim[i, 0], rim[i, 1]
        x, y = (ax + bx) / 2, (ay + by) / 2
        # The ray begins on the right: it crosses the edge downward, or runs north of it, on its left.
        if by < ay or (by == ay and bx > ax):
            result[i] = -1
        for j in range(first[i], last[i]):
            (ax, ay), (bx, by) = rim[j, 0], rim[j, 1]
            if j == i or (ay <= y) == (by <= y):
                continue
            on_left = (bx - ax) * (y - ay) > (by - ay) * (x - ax)
            if ay <= y and on_left:
                result[i] += 1
            elif by <= y and not on_left:
                result[i] -= 1
    return result
