"""A mesh of few faces within a tolerance of the surface: fine where it bends, with roads as edges.

The border and the lines are divided by the heights along them, to a share of the tolerance. A border so
depends on nothing but itself, and neighbouring tiles that share it have the same vertices. The ground between
is divided by greedy insertion (`tasks.meshing.insertion`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.meshing.insertion import Probes, refined
from flexroad.tasks.meshing.lines import apart_from, points_and_segments
from flexroad.tasks.meshing.parts import middles
from flexroad.tasks.meshing.positions import axis, without_duplicates
from flexroad.tasks.meshing.road_outline import RoadOutline
from flexroad.tasks.meshing.survey_limit import SurveyLimit
from flexroad.tasks.meshing.triangulate import Edges, Faces
from flexroad.tasks.types import Bools, Floats, Surface

LINE_SHARE = 0.5
"""Share of the tolerance on lines and on the border: faces beside them have the rest."""
APART = 5
"""Vertices between lines are farther from them than a step divided by this; closer probes do not count."""
PROBE_SHARE = 0.8
"""Share of the tolerance at probes: between them the error can be larger."""
SAMPLES = 8
"""Parts of a segment between which its height is compared with the surface."""


@dataclass(frozen=True)
class Area:
    """What is meshed, and how exactly."""

    origin: tuple[float, float]
    """Easting and northing that coordinates are relative to (m)."""
    local: Bounds
    """West, south, east and north of the domain (m)."""
    outline: RoadOutline
    limit: SurveyLimit | None
    """Limit of the survey, None if the survey covers the domain."""
    lines: Sequence[NDArray[np.object_]]
    """Lines of the outline and of the limit."""
    step: float
    """Distance of the places where the mesh is compared with the surface (m)."""
    tolerance_m: float
    """Largest distance of the mesh from the surface on roads (m)."""
    terrain_tolerance_m: float
    """The same elsewhere (m)."""

    def tolerance(self, places: Floats) -> Floats:
        """Return the tolerance (m) of faces by their centroids, ``(n, 2)``; infinite beyond the survey."""
        on_road = self.outline.contains(places)
        allowed = PROBE_SHARE * np.where(on_road, self.tolerance_m, self.terrain_tolerance_m)
        return allowed if self.limit is None else np.where(self.limit.covers(places), allowed, np.inf)


def adaptive(surface: Surface, area: Area, border: Floats, same_m: float) -> tuple[Floats, Faces]:
    """Return points, ``(N, 3)``, and faces, ``(F, 3)``, within the tolerances of the surface.

    Parameters
    ----------
    surface : Surface
    area : Area
    border : ndarray, (b, 3)
        All vertices on the border of the domain.
    same_m : float
        Lines end in vertices on the border that are this close (m).
    """

    def height(places: Floats) -> Floats:
        return np.asarray(surface.height(*(places + area.origin).T))

    plan, pairs = points_and_segments(area.lines, border[:, :2], area.local, same_m)
    plan, pairs = _divided(plan, pairs, height, area)
    points, number = without_duplicates(np.concatenate([border, np.column_stack([plan, height(plan)])]))
    points, faces = refined(
        points,
        number[len(border) :][pairs],
        _probes(surface, area),
        area.tolerance,
        lambda places: apart_from(places, area.lines, area.step / APART),
    )
    return points, faces if area.limit is None else faces[area.limit.covers(middles(points, faces))]


def thinned(along: Floats, heights: Floats, tolerances: Floats, needed: Bools) -> Bools:
    """Return which vertices of a line give straight pieces within a share of the tolerance of its heights.

    Parameters
    ----------
    along : ndarray, (n,)
        Ascending positions on the line (m).
    heights, tolerances : ndarray, (n,)
        Height of the surface (m), and the tolerance there (m).
    needed : ndarray of bool, (n,)
        Vertices that are kept anyway, among them the first and the last.

    Returns
    -------
    ndarray of bool, (n,)
        The method of Douglas and Peucker (1973), with vertical distances.
    """
    result = needed.copy()
    nodes = np.flatnonzero(result)
    pieces = list(zip(nodes[:-1].tolist(), nodes[1:].tolist(), strict=True))
    while pieces:
        first, last = pieces.pop()
        inner = slice(first + 1, last)
        chord = np.interp(along[inner], along[[first, last]], heights[[first, last]])
        ratio = np.nan_to_num(np.abs(heights[inner] - chord)) / (LINE_SHARE * tolerances[inner])
        if ratio.max(initial=0.0) <= 1.0:
            continue
        middle = first + 1 + int(ratio.argmax())
        result[middle] = True
        pieces += [(first, middle), (middle, last)]
    return result


def free_sides(area: Area, marks: Floats) -> Iterator[tuple[Floats, Bools, Bools]]:
    """Yield for each side of a domain without neighbours possible vertices, ``(n, 2)``, the needed, the road.

    Parameters
    ----------
    area : Area
    marks : ndarray, (m, 2)
        Further points on the border, which are needed.
    """
    for across in (1, 0):
        start, stop = area.local[1 - across], area.local[3 - across]
        regular = axis(start, stop, area.step, to_end=True)
        for at in (area.local[across], area.local[across + 2]):
            here = marks[marks[:, across] == at, 1 - across]
            away = np.abs(regular[:, None] - here).min(axis=1, initial=np.inf)
            here = np.concatenate([here, [start, stop]])
            along = np.unique(np.concatenate([regular[away >= area.step / 2], here]))
            plan = np.full((len(along), 2), at)
            plan[:, 1 - across] = along
            yield plan, np.isin(along, here), area.outline.touches(plan)


def _divided(
    plan: Floats, pairs: Edges, height: Callable[[Floats], Floats], area: Area
) -> tuple[Floats, Edges]:
    """Return points, ``(n, 2)``, and segments, ``(m, 2)``, halved until they follow the surface."""
    done = [pairs[:0]]
    shares = np.linspace(0.0, 1.0, SAMPLES + 1)[:, None]
    while len(pairs):
        starts, ends = plan[pairs[:, 0]], plan[pairs[:, 1]]
        places = starts + shares[:, None] * (ends - starts)
        z = height(places.reshape(-1, 2)).reshape(len(shares), -1)
        error = np.nan_to_num(np.abs(z - z[0] - shares * (z[-1] - z[0])).max(axis=0))
        at_road = area.outline.touches(places[SAMPLES // 2])
        tolerance = LINE_SHARE * np.where(at_road, area.tolerance_m, area.terrain_tolerance_m)
        long = (error > tolerance) & (np.linalg.norm(ends - starts, axis=1) > area.step / APART)
        done.append(pairs[~long])
        middle = len(plan) + np.arange(long.sum())
        plan = np.concatenate([plan, places[SAMPLES // 2][long]])
        first, last = pairs[long].T
        pairs = np.concatenate([np.stack([first, middle], axis=1), np.stack([middle, last], axis=1)])
    return plan, np.concatenate(done)


def _probes(surface: Surface, area: Area) -> Probes:
    """Return the lattice of probes inside the domain."""
    west, south, east, north = area.local
    x, y = axis(west, east, area.step, to_end=False), axis(south, north, area.step, to_end=False)
    x, y = x[(x > west) & (x < east)], y[(y > south) & (y < north)]
    heights = surface.lattice(x + area.origin[0], y + area.origin[1])
    return Probes((west + area.step, south + area.step), area.step, heights)
