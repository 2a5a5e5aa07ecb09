"""Routes: centre lines of roads, chained where a road continues and cut where export formats need it.

At a node, where ends of lines meet, the two ends that form the straightest continuation belong to one route.
No route turns sharply, crosses itself, changes its number of lanes or is longer than a limit. Lines join only
at their ends. So a route ends where its line ends on the middle of another line. Lines that cross without
a common end, such as on bridges, stay apart.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
import shapely.ops

from flexroad.tasks.types import Floats

SAME_M = 0.05
"""Ends of lines within the same cell of this size are one node (m)."""
DIRECTION_M = 8.0
"""Length at the end of a line over which its direction is measured (m); digitised ends have hooks."""

End = tuple[int, bool]
"""An end of a line: its index, and whether it is the line's last point."""


@dataclass(frozen=True, eq=False)
class CentreLine:
    """The centre line of a carriageway, with its width, lanes, direction and level."""

    points: Floats
    """``(n, 2)``: x and y (m)."""
    width_m: float
    """From kerb to kerb."""
    lanes: int | None = None
    """Number of lanes, None if it is unknown."""
    oneway: bool = False
    """Whether traffic goes only from the first point to the last."""
    name: str = ""
    level: int = 0
    """0 on the ground, above 0 on a deck, below 0 in a tunnel."""

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    @property
    def reverse(self) -> CentreLine:
        """The same line from its last point to its first."""
        return replace(self, points=self.points[::-1])


@dataclass(frozen=True, eq=False)
class Route:
    """A chain of centre lines; each begins at the end of the line before."""

    parts: tuple[CentreLine, ...]

    @property
    def points(self) -> Floats:
        """The points of all parts, ``(n, 2)``, without repeated points."""
        points = np.concatenate([part.points for part in self.parts])
        apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > SAME_M
        apart[-1:] = True  # the last point stays: another route may begin there
        return np.asarray(points[np.concatenate([[True], apart])])


def routes(
    lines: Sequence[CentreLine], max_turn_deg: float = 45.0, max_length_m: float = 5000.0
) -> list[Route]:
    """Return the routes of lines; each line, or each piece of a line with sharp turns, is in one route.

    A route has the direction of its first line. Apart from that, the result does not depend on the direction
    in which lines of two-way roads were drawn.

    - `max_turn_deg`: largest turn within a route (degrees), below 90.
    - `max_length_m`: longest route (m); longer routes are divided.
    """
    pieces = [
        part
        for line in lines
        for piece in _pieces(line, max_turn_deg)
        for part in _divided(piece, max_length_m)
    ]
    follows = _continuations(pieces, max_turn_deg)
    free = set(range(len(pieces)))
    found: list[Route] = []
    for first in range(len(pieces)):
        if first in free:
            chain = list(_chain(first, follows))
            free.difference_update(index for index, _ in chain)
            directed = [pieces[index] if onward else pieces[index].reverse for index, onward in chain]
            found += _simple(directed, max_length_m)
    return found


def _pieces(line: CentreLine, max_turn_deg: float) -> Iterator[CentreLine]:
    """Cut a line at its sharp turns and where it crosses itself."""
    keep = np.linalg.norm(np.diff(line.points, axis=0), axis=1) > 0
    points = line.points[np.concatenate([[True], keep])]
    if len(points) < 2:
        return
    step = np.diff(points, axis=0)
    turn = _turn(step[:-1], step[1:])
    for part in np.split(np.arange(len(points)), np.flatnonzero(turn > max_turn_deg) + 2):
        # The point of a turn ends one piece and begins the next.
        part = part if part[0] == 0 else np.concatenate([[part[0] - 1], part])
        path = shapely.LineString(points[part])
        for simple in (path,) if path.is_simple else shapely.node(path).geoms:
            yield replace(line, points=shapely.get_coordinates(simple))


def _divided(line: CentreLine, max_length_m: float) -> Iterator[CentreLine]:
    """Divide a line into the least number of equal lengths that are short enough."""
    parts = math.ceil(line.length_m / max_length_m * (1 - 1e-9))
    if parts < 2:
        yield line
        return
    whole, ends = shapely.LineString(line.points), np.linspace(0, 1, parts + 1)
    for begin, end in itertools.pairwise(ends):
        yield replace(
            line, points=shapely.get_coordinates(shapely.ops.substring(whole, begin, end, normalized=True))
        )


def _turn(a: Floats, b: Floats) -> Floats:
    """Return the angles between vectors, ``(n, 2)`` each, in degrees."""
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.asarray(np.degrees(np.abs(np.arctan2(cross, (a * b).sum(axis=-1)))))


def _continuations(lines: Sequence[CentreLine], max_turn_deg: float) -> dict[End, End]:
    """Return the end that continues each end of a line, both ways; the straightest pairs first."""
    nodes: dict[tuple[int, int], list[End]] = defaultdict(list)
    for index, line in enumerate(lines):
        for last in (False, True):
            x, y = np.round(line.points[-1 if last else 0] / SAME_M)
            nodes[int(x), int(y)].append((index, last))
    follows: dict[End, End] = {}
    for ends in nodes.values():
        out = {end: _outward(lines[end[0]], end[1]) for end in ends}
        pairs = [(a, b) for i, a in enumerate(ends) for b in ends[i + 1 :] if _joins(lines, a, b)]
        for turn, a, b in sorted((float(_turn(-out[a], out[b])), a, b) for a, b in pairs):
            if turn <= max_turn_deg and a not in follows and b not in follows:
                follows[a], follows[b] = b, a
    return follows


def _outward(line: CentreLine, last: bool) -> Floats:
    """Return the direction in which a line leaves one of its ends."""
    points = line.points[::-1] if last else line.points
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    reach = min(DIRECTION_M, along[-1])
    place = np.array([np.interp(reach, along, points[:, axis]) for axis in (0, 1)])
    return np.asarray(place - points[0])


def _joins(lines: Sequence[CentreLine], a: End, b: End) -> bool:
    """Whether two ends may follow each other: other lines, the same lanes, one direction of traffic."""
    one, other = lines[a[0]], lines[b[0]]
    directed = not one.oneway or a[1] != b[1]
    return a[0] != b[0] and one.lanes == other.lanes and one.oneway == other.oneway and directed


def _chain(first: int, follows: dict[End, End]) -> Iterator[tuple[int, bool]]:
    """Return the lines of a chain in order, each with whether the route has the line's own direction."""
    start, seen = (first, False), {first}
    while start in follows and follows[start][0] not in seen:
        index, last = follows[start]
        seen.add(index)
        start = (index, not last)
    index, last = start
    seen = set()
    while index not in seen:
        seen.add(index)
        yield index, not last
        following = follows.get((index, not last))
        if following is None:
            return
        index, last = following


def _simple(chain: Sequence[CentreLine], max_length_m: float) -> Iterator[Route]:
    """Cut a chain before each line that would cross or touch the route up to there, or make it too long."""
    parts: list[CentreLine] = []
    length_m = 0.0
    for part in chain:
        length_m += part.length_m
        crosses = parts and not shapely.LineString(Route((*parts, part)).points).is_simple
        if parts and (crosses or length_m > max_length_m * (1 + 1e-9)):
            yield Route(tuple(parts))
            parts, length_m = [], part.length_m
        parts.append(part)
    yield Route(tuple(parts))
