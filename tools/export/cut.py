"""A surface cut to a part of its domain by knot insertion, and its form for CAD programs.

Inserting a knot leaves a spline as it is (Boehm 1980, "Inserting new knots into B-spline curves"). With
``degree`` equal knots at both ends of the part, the control points between them define the part alone.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexroad.catalog.grid import Bounds, overlap
from flexroad.catalog.text import edges
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.surface import ExactNurbs, NurbsSurface, domain, exact
from flexroad.tasks.types import Floats

SAME_KNOT = 4e-12
"""Parameters closer than this part of the domain are one knot: 1 nm over 250 m, as northings are rounded."""


def cut(surface: NurbsSurface, bounds: Bounds) -> NurbsSurface:
    """Return the part of a surface within bounds, with clamped knots from 0 to 1; the cut is exact.

    The part ends with the surface's domain: beyond it the surface is extrapolated, which no spline on the
    same knots can express.
    """
    if not overlap(surface.bounds, bounds):
        raise TaskError(
            f"bounds {edges(bounds)} lie beyond the surface's domain {edges(surface.bounds)}; choose others"
        )
    west, south = np.maximum(surface.bounds[:2], bounds[:2]).tolist()
    east, north = np.minimum(surface.bounds[2:], bounds[2:]).tolist()
    (p, q), whole = surface.degree, surface.bounds
    knots_u, along_u = _part(surface.knots_u, p, (west - whole[0], east - whole[0]), whole[2] - whole[0])
    knots_v, along_v = _part(surface.knots_v, q, (south - whole[1], north - whole[1]), whole[3] - whole[1])
    return replace(
        surface,
        bounds=(west, south, east, north),
        knots_u=knots_u,
        knots_v=knots_v,
        A=along_v @ surface.A @ along_u.T,
        W=along_v @ surface.W @ along_u.T,
    )


def patch(surface: NurbsSurface, bounds: Bounds, origin: tuple[float, float]) -> tuple[ExactNurbs, bool]:
    """Return the part of a surface within bounds as a NURBS with control points in space; exact.

    - `bounds`: west, south, east and north of the part (m).
    - `origin`: easting and northing that the control points are relative to (m).
    - `patch`: with the degree of the surface if all weights are equal, which are 1 then; else as by `exact`.
    - `rational`: whether the weights differ.
    """
    part = replace(cut(surface, bounds), origin=origin)
    if np.ptp(surface.W):
        return exact(part), True
    points = part.control_points - np.array([*part.origin, 0, 0])
    points[..., 3] = 1
    return ExactNurbs(part.degree, part.knots_u, part.knots_v, points, part.origin), False


def _part(knots: Floats, degree: int, ends: tuple[float, float], length: float) -> tuple[Floats, Floats]:
    """Return clamped knots on [0, 1] of a part, and the map of the whole's control points to its own.

    The ends are distances from the start of the domain, whose length is given in the same unit.
    """
    low, high = domain(knots, degree)
    first, last = (_knot(knots, low + end * (high - low) / length, high - low) for end in ends)
    points = np.eye(len(knots) - degree - 1)
    for end in (first, last):
        for _ in range(degree - np.count_nonzero(knots == end)):
            knots, points = _inserted(knots, points, degree, end)
    inner = knots[(knots > first) & (knots < last)]
    start = int(np.searchsorted(knots, first, side="right")) - 1 - degree
    clamped = np.concatenate([np.full(degree + 1, first), inner, np.full(degree + 1, last)])
    return (clamped - first) / (last - first), points[start : start + len(inner) + degree + 1]


def _knot(knots: Floats, parameter: float, length: float) -> float:
    """Return the knot at a parameter if there is one, else the parameter."""
    nearest = float(knots[np.argmin(np.abs(knots - parameter))])
    return nearest if abs(nearest - parameter) <= SAME_KNOT * length else parameter


def _inserted(knots: Floats, points: Floats, degree: int, new: float) -> tuple[Floats, Floats]:
    """Return knots with one more, and the control points that leave the spline as it is (Boehm)."""
    span = int(np.searchsorted(knots, new, side="right")) - 1
    i = np.arange(span - degree + 1, span - np.count_nonzero(knots == new) + 1)
    share = ((new - knots[i]) / (knots[i + degree] - knots[i]))[:, None]
    between = share * points[i] + (1 - share) * points[i - 1]
    return np.insert(knots, span + 1, new), np.concatenate([points[: i[0]], between, points[i[-1] :]])
