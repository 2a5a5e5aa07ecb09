"""Reference lines of roads: smooth curves with points at equal distances, for OpenCRG and OpenDRIVE.

A route is smoothed within a given lateral distance and becomes a curve of cubic pieces (OpenDRIVE's
paramPoly3). OpenCRG's reference line has points on the curve at equal straight distances, so both formats
have the same points. A last piece of a route that is shorter than this distance is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
import shapely

from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads.routes import Route
from flexroad.tasks.types import Bools, Floats

INCREMENT_M = 0.5
"""Distance of the points (m); OpenCRG's consistency check needs a multiple of 1 mm."""
MAX_OFFSET_M = 0.25
"""Largest distance from the centre lines (m)."""
SMOOTH_M = 30.0
"""Waves of a line that are shorter than this are removed (m)."""
PIECE_M = 4.0
"""Length of a cubic piece (m)."""
MIN_LENGTH_M = 10.0
"""Shortest road (m)."""
SAMPLE_M = 0.25
"""Distance between the points that are smoothed (m)."""
DIAGONAL = np.array([[0.0], [0.0], [1.0]])
PINNED = 1e9
"""Weight of a route's first and last point: routes that meet still meet after smoothing."""
ATTEMPTS = ((0.8, 1.0), (0.6, 0.5), (0.4, 0.25))
"""Share of the allowed offset that smoothing uses, and length of the pieces as a share of `PIECE_M`.
Long pieces cut the corners of the smoothed line, so narrow bends need shorter pieces."""
ROUNDS = 40
WIDENING_M = 10.0
"""Length over which a step of the width is spread (m)."""
FOLD = 0.9
"""Largest distance on the inside of a bend as a share of its radius, where cross-sections meet."""
TINY_M = 1e-6
"""Pieces shorter than this are joined to their neighbours (m)."""
EVEN_M, QUARTERS = 0.0005, np.arange(4) / 4
"""Largest difference of length and parameter within a piece (m), and the places where it is measured."""
CLOSED = 1e-10
"""Relative error of the distances between points."""


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """A smooth line with points at equal distances."""

    x: Floats
    """``(n,)``, m."""
    y: Floats
    heading: Floats
    """Direction of the curve at each point, ``(n,)``, radians counter-clockwise from x, not wrapped."""
    s: Floats
    """Length of the curve from the first point to each point, ``(n,)``, m."""
    increment: float
    """Straight distance between neighbouring points (m)."""
    width: Floats
    """Width of the carriageway at each point, ``(n,)``, m; the line is in its middle."""
    parameter: Floats
    """Parameter of the curve at each point, ``(n,)``."""
    curve: scipy.interpolate.PPoly
    """The plan: cubic pieces in x and y, twice continuously differentiable."""
    offset_m: float
    """Largest distance of a point from the centre lines (m)."""
    lanes: int | None = None
    oneway: bool = False
    name: str = ""

    @property
    def chord_headings(self) -> Floats:
        """Directions from point to point, ``(n - 1,)``, radians from -pi to pi."""
        return np.arctan2(np.diff(self.y), np.diff(self.x))

    @property
    def curvature(self) -> Floats:
        """Curvature at each point, ``(n,)``, 1/m; positive to the left."""
        (x1, y1), (x2, y2) = (self.curve(self.parameter, order).T for order in (1, 2))
        return np.asarray((x1 * y2 - y1 * x2) / np.hypot(x1, y1) ** 3)

    def reach(self, distance: float) -> tuple[float, float]:
        """Return the length of the line's cross-sections to the right and left (m) before they meet.

        At most ``distance``. A bend to the left limits the left side.
        """
        bends = self.curvature
        right, left = (FOLD / max(float((side * bends).max()), FOLD / distance) for side in (-1, 1))
        return right, left

    def beside(self, v: Floats) -> tuple[Floats, Floats]:
        """Return x and y, ``(n, len(v))``, of points at distances ``v`` from the line, positive to the left.

        As in readers of OpenCRG, they are on the bisectors of the angles between chords, ``v`` from both
        chords.
        """
        normal = np.stack([-np.diff(self.y), np.diff(self.x)], axis=1) / self.increment
        before, after = np.vstack([normal[:1], normal]), np.vstack([normal, normal[-1:]])
        mitre = (before + after) / (1 + (before * after).sum(axis=1))[:, None]
        return self.x[:, None] + v * mitre[:, :1], self.y[:, None] + v * mitre[:, 1:]

    @property
    def pieces(self) -> tuple[Floats, Floats]:
        """Parameters at the ends of the cubic pieces from the first to the last point, and the length there.

        Both ``(k + 1,)`` for ``k`` pieces. Readers of OpenDRIVE assume that the parameter grows like the
        length. Pieces of the curve where it differs by more than half a millimetre are divided.
        """
        first, last = self.parameter[0], self.parameter[-1]
        inner = self.curve.x[(self.curve.x > first + TINY_M) & (self.curve.x < last - TINY_M)]
        ends = np.concatenate([[first], inner, [last]])
        for _ in range(ROUNDS):
            fine = np.concatenate([(ends[:-1, None] + np.diff(ends)[:, None] * QUARTERS).ravel(), ends[-1:]])
            lengths = _lengths(self.curve, fine)
            whole = np.diff(lengths[::4])[:, None] * QUARTERS
            uneven = np.abs(lengths[:-1].reshape(-1, 4) - lengths[:-1:4, None] - whole).max(axis=1) > EVEN_M
            if not uneven.any():
                break
            ends = np.union1d(ends, fine[2::4][uneven])
        return ends, _lengths(self.curve, ends)

    def part(self, first: int, last: int) -> ReferenceLine:
        """Return the line from one point to another point, both included."""
        here = slice(first, last + 1)
        cut = {name: getattr(self, name)[here] for name in ("x", "y", "heading", "width", "parameter")}
        return replace(self, s=self.s[here] - self.s[first], **cut)


def reference_line(route: Route) -> ReferenceLine | None:
    """Return the reference line of a route, or None if the route is shorter than `MIN_LENGTH_M`."""
    points = route.points
    if _along(points)[-1] < MIN_LENGTH_M:
        return None
    for share, shorter in ATTEMPTS:
        curve = _curve(_smoothed(points, share * MAX_OFFSET_M), shorter * PIECE_M)
        parameter = _equally_spaced(curve, INCREMENT_M)
        x, y = curve(parameter).T
        offset_m = float(shapely.distance(shapely.LineString(points), shapely.points(x, y)).max())
        if offset_m <= MAX_OFFSET_M:
            break
    if len(parameter) - 1 < MIN_LENGTH_M / INCREMENT_M:
        return None
    by_x, by_y = curve(parameter, 1).T
    first = route.parts[0]
    return ReferenceLine(
        x=x,
        y=y,
        heading=np.unwrap(np.arctan2(by_y, by_x)),
        s=_lengths(curve, parameter),
        increment=INCREMENT_M,
        width=_widths(route, x, y),
        parameter=parameter,
        curve=curve,
        offset_m=offset_m,
        lanes=first.lanes,
        oneway=first.oneway,
        name=next((part.name for part in route.parts if part.name), ""),
    )


def usable(line: ReferenceLine, known: Floats) -> list[ReferenceLine]:
    """Return the parts of a line that can be a road, without those shorter than `MIN_LENGTH_M`.

    A road ends where the surface ends. It also ends before a bend with a radius of less than half its width,
    where its cross-sections would meet.

    - `known` ``(n,)``: heights at its points, NaN beyond the surface.
    """
    return parts(line, np.isfinite(known) & (np.abs(line.curvature) * line.width / 2 < FOLD))


def parts(line: ReferenceLine, inside: Bools) -> list[ReferenceLine]:
    """Return the parts of a line whose points are all ``inside``, without parts that are too short."""
    least = MIN_LENGTH_M / line.increment
    return [line.part(start, end - 1) for start, end in stretches(inside) if end - 1 - start >= least]


def stretches(places: Bools) -> list[tuple[int, int]]:
    """Return start and end of each stretch of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], places, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _along(points: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def _curve(smooth: Floats, piece_m: float) -> scipy.interpolate.PPoly:
    """Return a curve through points of a smooth polyline; its parameter is nearly its length."""
    along = _along(smooth)
    pieces = max(2, round(along[-1] / piece_m))
    chosen = np.round(np.linspace(0, len(smooth) - 1, pieces + 1)).astype(int)
    return scipy.interpolate.CubicSpline(along[chosen], smooth[chosen], bc_type="natural")


def _smoothed(points: Floats, within_m: float) -> Floats:
    """Return the polyline smoothed within a distance, with several points per metre.

    The sum of squared distances and of squared second differences is minimal. Waves much longer than
    `SMOOTH_M` stay, shorter waves are removed. Where the result leaves the allowed distance, the weights of
    the points are increased.
    """
    along = _along(points)
    at = np.linspace(0.0, along[-1], round(along[-1] / SAMPLE_M) + 1)
    place = np.stack([np.interp(at, along, points[:, axis]) for axis in (0, 1)], axis=1)
    penalty = (SMOOTH_M / (2 * math.pi * at[1])) ** 4 * _second_differences(len(at))
    weights = np.ones(len(at))
    weights[[0, -1]] = PINNED
    for _ in range(ROUNDS):
        smooth = scipy.linalg.solveh_banded(penalty + weights * DIAGONAL, weights[:, None] * place)
        over = np.linalg.norm(smooth - place, axis=1) > within_m
        if not over.any():
            break
        weights[over] = np.minimum(2 * weights[over], PINNED)
    return np.asarray(smooth)


def _second_differences(count: int) -> Floats:
    """Return the upper bands of the matrix of the sum of squared second differences."""
    bands = np.ones((3, count)) * [[1.0], [-4.0], [6.0]]
    bands[1, [1, -1]] = -2
    bands[2, [0, -1]], bands[2, [1, -2]] = 1, 5
    return bands


def _equally_spaced(curve: scipy.interpolate.PPoly, increment: float) -> Floats:
    """Return the parameters of points at equal distances from the start of a curve on."""
    end = float(curve.x[-1])
    t = np.arange(0.0, end + increment / 2, increment)
    for _ in range(ROUNDS):
        distance = np.linalg.norm(np.diff(curve(t), axis=0), axis=1)
        if np.abs(distance - increment).max() < CLOSED * increment:
            break
        t[1:] += np.cumsum(increment - distance)
    else:
        x, y = curve(0.0)
        raise TaskError(f"the road at x {x:.1f}, y {y:.1f} bends too much for points every {increment:g} m")
    return np.asarray(t[t <= end])


def _lengths(curve: scipy.interpolate.PPoly, parameter: Floats) -> Floats:
    """Return the length of a curve from the first parameter to each parameter."""
    ends = np.union1d(parameter, curve.x[(curve.x > parameter[0]) & (curve.x < parameter[-1])])
    node, weight = np.polynomial.legendre.leggauss(6)
    half, middle = np.diff(ends) / 2, (ends[:-1] + ends[1:]) / 2
    speed = np.linalg.norm(curve(middle[:, None] + half[:, None] * node, 1), axis=-1)
    total = np.concatenate([[0.0], np.cumsum(half * (speed * weight).sum(axis=1))])
    return np.asarray(total[np.searchsorted(ends, parameter)])


def _widths(route: Route, x: Floats, y: Floats) -> Floats:
    """Return the width at points of a route; steps between its parts are spread over some metres."""
    tree = shapely.STRtree([shapely.LineString(part.points) for part in route.parts])
    width = np.array([part.width_m for part in route.parts])[tree.nearest(shapely.points(x, y))]
    return np.asarray(scipy.ndimage.uniform_filter1d(width, round(WIDENING_M / INCREMENT_M), mode="nearest"))
