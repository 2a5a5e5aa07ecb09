"""The level of each place along a route, from its centre lines; decks continue beyond their ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
import shapely
import shapely.ops
from numpy.typing import NDArray

from flexroad.tasks.levels.abutments import APPROACH_M
from flexroad.tasks.roads.routes import Route
from flexroad.tasks.types import Bools, Floats


@dataclass(frozen=True, eq=False)
class PlaceLevels:
    """The level of each place, in the shape of the places."""

    number: NDArray[np.int8]
    own: Bools
    """Whether the centre line there has this level; else it has level 0, near a deck or tunnel."""

    def __getitem__(self, places: Bools | NDArray[np.intp]) -> PlaceLevels:
        return PlaceLevels(self.number[places], self.own[places])

    @property
    def of_line(self) -> NDArray[np.int8]:
        """The levels of the centre line at the places."""
        return np.where(self.own, self.number, 0).astype(np.int8)


@dataclass(frozen=True)
class Structure:
    """A piece of a road on a deck or in a tunnel, by distances along the road (m)."""

    level: int
    start: float
    end: float


def structures(levels: NDArray[np.int8], s: Floats) -> tuple[Structure, ...]:
    """Return the decks and tunnels of a road from its levels at points, and their distances along it (m)."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(levels)) + 1, [len(levels)]])
    return tuple(
        Structure(int(levels[a]), float(s[a]), float(s[b - 1]))
        for a, b in pairwise(starts.tolist())
        if levels[a] and b - a > 1
    )


def route_levels(route: Route) -> Callable[[Floats, Floats], PlaceLevels] | None:
    """Return a function from x and y of places on and beside a route to their levels.

    None if the complete route is on level 0.
    """
    if not any(part.level for part in route.parts):
        return None
    lines, numbers, own = zip(*_spans(route), strict=True)
    tree, levels = shapely.STRtree(lines), PlaceLevels(np.array(numbers, np.int8), np.array(own))

    def at(x: Floats, y: Floats) -> PlaceLevels:
        x, y = np.broadcast_arrays(x, y)
        nearest = tree.nearest(shapely.points(x.ravel(), y.ravel()))
        return levels[np.asarray(nearest).reshape(x.shape)]

    return at


def _spans(route: Route) -> Iterator[tuple[shapely.LineString, int, bool]]:
    """Yield lines with their level, and whether it is their own; an approach continues a deck.

    Between two decks whose approaches would overlap, each deck continues to the middle.
    """
    groups = [(level, list(parts)) for level, parts in groupby(route.parts, lambda part: part.level)]
    for k, (level, parts) in enumerate(groups):
        line = shapely.LineString(Route(tuple(parts)).points)
        before = groups[k - 1][0] if k else 0
        after = groups[k + 1][0] if k + 1 < len(groups) else 0
        if level or not (before or after):
            yield line, level, True
            continue
        reach = min(APPROACH_M, line.length / 2 if before and after else line.length)
        first, last = reach if before else 0.0, line.length - (reach if after else 0.0)
        if before:
            yield shapely.ops.substring(line, 0.0, first), before, False
        if last > first:
            yield shapely.ops.substring(line, first, last), 0, True
        if after:
            yield shapely.ops.substring(line, last, line.length), after, False
