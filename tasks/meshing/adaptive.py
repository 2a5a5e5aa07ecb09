"""A mesh of few faces within a tolerance of the surface: fine where it bends, with roads as edges.

The border and the lines are divided by the heights along them, to a share of the tolerance. A border so
depends on nothing but itself, and neighbouring tiles that share it have the same vertices.

The ground between has the fewest faces by greedy insertion (Garland and Heckbert 1995): probes on a lattice
have the heights of the surface. Each round triangulates, and inserts the worst probe of each face that is too
far from the surface, largest errors first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import startinpy
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import TaskError
from flexroad.tasks.meshing.lines import apart_from, points_and_segments
from flexroad.tasks.meshing.parts import middles
from flexroad.tasks.meshing.positions import axis, without_duplicates
from flexroad.tasks.meshing.road_outline import RoadOutline
from flexroad.tasks.meshing.survey_limit import SurveyLimit
from flexroad.tasks.meshing.triangulate import SNAP_TOLERANCE_M, Edges, Faces, with_edges
from flexroad.tasks.types import Bools, Floats, Surface

LINE_SHARE = 0.5
"""Share of the tolerance on lines and on the border: faces beside them have the rest."""
APART = 5
"""Vertices between lines are farther from them than a step divided by this; closer probes do not count."""
PROBE_SHARE = 0.8
"""Share of the tolerance at probes: between them the error can be larger."""
SAMPLES = 8
"""Parts of a segment between which its height is compared with the surface."""
BITS = 21
"""Bits of a vertex number: a mesh has fewer than 2 million vertices."""
SHARE = 0.4
"""A round inserts probes with at least this share of the largest error: large errors end many small ones."""
FEW = 10
"""Faces of less than this number of squares of the lattice have few probes."""
BETWEEN = 1.6
"""In faces with few probes the largest error between probes is up to this multiple of that at probes."""
WITHOUT_HEIGHT = 1e3
"""Error (m) of a face of which a vertex has no height: it is divided until it has no probe with a height."""
EDGE_M = 1e-9
"""Probes this close to a face are within it (m)."""


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


@dataclass(frozen=True, eq=False)
class Probes:
    """Places of a lattice at which a mesh is compared with the surface."""

    corner: tuple[float, float]
    """X and y of the south-western probe (m)."""
    step: float
    """Distance of the probes (m)."""
    heights: Floats
    """Heights of the surface, ``(n, m)``, m; row 0 in the south. NaN where it is not compared."""

    def points(self, chosen: NDArray[np.intp]) -> Floats:
        """Return the probes with these numbers, ``(k, 3)``; numbers count along x first."""
        row, col = np.divmod(chosen, self.heights.shape[1])
        x, y = (start + np.round(i * self.step, 6) for start, i in zip(self.corner, (col, row), strict=True))
        return np.column_stack([x, y, self.heights[row, col]])


def refined(
    fixed: Floats,
    segments: Edges,
    probes: Probes,
    tolerance: Callable[[Floats], Floats],
    may_be_vertex: Callable[[Floats], Bools],
) -> tuple[Floats, Faces]:
    """Return points and faces that are within the tolerance of the surface at all probes.

    Parameters
    ----------
    fixed : ndarray, (n, 3)
        Vertices on the border and on lines, by northing and easting; no two at the same place.
    segments : ndarray of int, (s, 2)
        Edges of the mesh between them.
    probes : Probes
        Where the error is measured, and possible further vertices.
    tolerance : callable
        Gives the tolerance (m) of faces by their centroids, ``(F, 2)``.
    may_be_vertex : callable
        Tells for probes, ``(k, 3)``, whether they may be vertices, ``(k,)``; others are not compared.

    Returns
    -------
    points : ndarray, (N, 3)
        First the fixed points.
    faces : ndarray of int32, (F, 3)

    Raises
    ------
    TaskError
        If the mesh would have 2 million vertices or more.
    """
    triangulation = startinpy.DT()
    triangulation.snap_tolerance = SNAP_TOLERANCE_M
    triangulation.insert(_in_plan(fixed), insertionstrategy="BBox")
    points, errors = fixed, _Errors(probes, tolerance)
    # Edges cost more than a round without them, so the first rounds do without.
    for edges in (segments[:0], segments):
        while True:
            faces = with_edges(points, triangulation.triangles.astype(np.int32) - 1, edges)
            chosen = errors.worst(points, faces)
            if not len(chosen):
                break
            added = probes.points(chosen)
            added = added[may_be_vertex(added)]
            if len(added):
                triangulation.insert(_in_plan(added), insertionstrategy="AsIs")
                points = np.concatenate([points, added])
    del triangulation  # In the thread that created it, as `triangulate` explains.
    return points, faces


class _Errors:
    """The largest error of each face, computed once per face."""

    def __init__(self, probes: Probes, tolerance: Callable[[Floats], Floats]) -> None:
        self.probes = probes
        self.tolerance = tolerance
        self.heights = probes.heights.copy()
        """Heights of the probes that are still compared, NaN elsewhere."""
        self.keys = np.empty(0, np.int64)
        """Faces of the last round, ascending."""
        self.ratios, self.probe = np.empty(0), np.empty(0, np.intp)
        """Their largest errors (shares of the tolerance), and the number of its probe."""

    def worst(self, points: Floats, faces: Faces) -> NDArray[np.intp]:
        """Return the worst probes of faces that exceed the tolerance, ascending; each is returned once."""
        if len(points) >= 1 << BITS:
            raise TaskError(f"the mesh would have {1 << BITS:,} vertices or more; raise sample.tolerance_m")
        first, second, third = np.sort(faces, axis=1).T.astype(np.int64)
        keys = (first << 2 * BITS) | (second << BITS) | third
        at = np.minimum(np.searchsorted(self.keys, keys), max(len(self.keys) - 1, 0))
        known = self.keys[at] == keys if len(self.keys) else np.zeros(len(keys), np.bool_)
        ratios, probe = np.zeros(len(keys)), np.zeros(len(keys), np.intp)
        ratios[known], probe[known] = self.ratios[at[known]], self.probe[at[known]]
        new = faces[~known]
        weights = 1.0 / self.tolerance(middles(points, new))
        corner, step = self.probes.corner, self.probes.step
        ratios[~known], probe[~known] = _worst(points, new, weights, *corner, step, self.heights)
        chosen = np.unique(probe[ratios > max(1.0, SHARE * ratios.max())])
        self.heights.flat[chosen] = np.nan
        order = np.argsort(keys)
        order = order[~np.isin(probe[order], chosen)]
        self.keys, self.ratios, self.probe = keys[order], ratios[order], probe[order]
        return chosen


def _in_plan(points: Floats) -> Floats:
    return np.column_stack([points[:, :2], np.zeros(len(points))])


@compiled(error_model="numpy")
def _worst(
    points: Floats, faces: Faces, weight: Floats, west: float, south: float, step: float, heights: Floats
) -> tuple[Floats, NDArray[np.intp]]:
    """Return the largest error times weight in each face, 0 without a probe, and the number of its probe."""
    ratio, worst = np.zeros(len(faces)), np.zeros(len(faces), np.intp)
    rows, columns = heights.shape
    for f in range(len(faces)):
        i, j, k = faces[f]
        ax, ay, az = points[i, 0], points[i, 1], points[i, 2]
        bx, by, bz = points[j, 0], points[j, 1], points[j, 2]
        cx, cy, cz = points[k, 0], points[k, 1], points[k, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area <= 0.0:
            continue
        no_height = not np.isfinite(az + bz + cz)
        by_x = ((bz - az) * (cy - ay) - (by - ay) * (cz - az)) / area
        by_y = ((bx - ax) * (cz - az) - (bz - az) * (cx - ax)) / area
        first = max(0, int(np.ceil((min(ay, by, cy) - EDGE_M - south) / step)))
        last = min(rows - 1, int(np.floor((max(ay, by, cy) + EDGE_M - south) / step)))
        largest, at = 0.0, 0
        for row in range(first, last + 1):
            y = south + row * step
            left, right = _cut(ax, ay, bx, by, y, np.inf, -np.inf)
            left, right = _cut(bx, by, cx, cy, y, left, right)
            left, right = _cut(cx, cy, ax, ay, y, left, right)
            if left > right:
                continue
            start = max(0, int(np.ceil((left - EDGE_M - west) / step)))
            stop = min(columns - 1, int(np.floor((right + EDGE_M - west) / step)))
            base = az + by_y * (y - ay) + by_x * (west - ax)
            for col in range(start, stop + 1):
                height = heights[row, col]
                error = abs(base + by_x * step * col - height)
                if no_height and np.isfinite(height):
                    error = WITHOUT_HEIGHT
                if error > largest:
                    largest, at = error, row * columns + col
        few = area < 2.0 * FEW * step * step
        ratio[f], worst[f] = largest * weight[f] * (BETWEEN if few else 1.0), at
    return ratio, worst


@compiled(error_model="numpy")
def _cut(
    ax: float, ay: float, bx: float, by: float, y: float, left: float, right: float
) -> tuple[float, float]:
    """Return the range of x widened to where the edge from a to b meets the line at y."""
    if y < min(ay, by) - EDGE_M or y > max(ay, by) + EDGE_M:
        return left, right
    if abs(by - ay) <= EDGE_M:
        return min(left, ax, bx), max(right, ax, bx)
    x = ax + min(max((y - ay) / (by - ay), 0.0), 1.0) * (bx - ax)
    return min(left, x), max(right, x)
