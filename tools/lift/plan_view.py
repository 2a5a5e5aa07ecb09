"""Roads of OpenDRIVE in plan: places on their reference lines, and the extent of their lanes.

Reference lines are lines, arcs, spirals, cubics and parametric cubics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.export.profiles import value_at

CURVED, SPIRAL, CUBIC = range(3)
"""Kinds of geometry; a line is an arc with curvature 0, poly3 and paramPoly3 are cubics."""
SAME_TURN = 1e-9
"""A spiral is treated as an arc if the change of curvature times its length is less (radians)."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
ROUNDS = 12
"""Largest number of steps of Newton's method for the place on a cubic."""
CLOSE_M = 1e-10
SIDES = ("right", "left")
HALF_WIDEST_M = 200.0
"""Lanes farther from the reference line are ignored (m)."""


@dataclass(frozen=True, eq=False)
class PlanView:
    """The ``k`` consecutive geometries of a road."""

    start: Floats
    """``(k, 4)``: s, x, y and heading at the start of each."""
    length: Floats
    """``(k,)``, m."""
    kind: NDArray[np.int8]
    values: Floats
    """``(k, 9)``: curvature and its change per metre; of cubics the coefficients of u and v by rising power,
    and the length of the curve for a metre of s."""

    @property
    def end(self) -> float:
        """Distance along the road at its end (m)."""
        return float(self.start[-1, 0] + self.length[-1])

    def at(self, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Return x, y and heading at distances along the road, ``(n,)`` each.

        Before the start and beyond the end, the first and last geometry are continued.
        """
        number = np.maximum(np.searchsorted(self.start[:, 0], s, side="right") - 1, 0)
        along = np.asarray(s) - self.start[number, 0]
        u, v, turn = (np.zeros(len(along)) for _ in range(3))
        for kind, place in enumerate((_curved, _spiral, _cubic)):
            here = self.kind[number] == kind
            if here.any():
                u[here], v[here], turn[here] = place(along[here], self.values[number[here]])
        _, x, y, heading = self.start[number].T
        ahead, left = np.cos(heading), np.sin(heading)
        return x + u * ahead - v * left, y + u * left + v * ahead, heading + turn


def read(road: ET.Element) -> PlanView:
    """Return the plan of a road."""
    geometries = road.findall("planView/geometry")
    if not geometries:
        raise TaskError("has no planView with a geometry")
    rows = [numbers(each, "s", "x", "y", "hdg", "length") for each in geometries]
    kinds, values = zip(*map(_kind, geometries), strict=True)
    table = np.array(rows)
    plan = PlanView(table[:, :4], table[:, 4], np.array(kinds, np.int8), np.array(values))
    if (plan.length < 0).any() or (np.diff(plan.start[:, 0]) < 0).any():
        raise TaskError("has geometries with s that does not ascend")
    return plan


def numbers(element: ET.Element, *names: str, missing: float | None = None) -> list[float]:
    """Return attributes as numbers."""
    found = []
    for name in names:
        text = element.get(name)
        try:
            value = missing if text is None else float(text)
        except ValueError:
            value = math.nan
        if value is None:
            raise TaskError(f"has {element.tag} without {name}")
        if not math.isfinite(value):
            raise TaskError(f"has {element.tag} with {name} {str(text)[:40]!r}, which is not a number")
        found.append(value)
    return found


def _kind(geometry: ET.Element) -> tuple[int, list[float]]:
    """Return the kind of a geometry and its values."""
    for shape in geometry:
        if shape.tag == "line":
            return CURVED, [0.0] * 9
        if shape.tag == "arc":
            return CURVED, [*numbers(shape, "curvature"), *[0.0] * 8]
        if shape.tag == "spiral":
            first, last = numbers(shape, "curvStart", "curvEnd")
            (length,) = numbers(geometry, "length")
            if abs(last - first) * length < SAME_TURN:
                return CURVED, [(first + last) / 2, *[0.0] * 8]
            return SPIRAL, [first, (last - first) / length, *[0.0] * 7]
        if shape.tag == "poly3":
            return CUBIC, [0.0, 1.0, 0.0, 0.0, *numbers(shape, "a", "b", "c", "d"), 1.0]
        if shape.tag == "paramPoly3":
            values = np.array(numbers(shape, "aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV"))
            (length,) = numbers(geometry, "length")
            if shape.get("pRange", "normalized") != "arcLength":
                # The parameter is 1 at the end.
                values = values / np.tile(float(length or 1.0) ** np.arange(4.0), 2)
            # The curve ends where its parameter ends, even if its length differs a little from the file's.
            curve = float(_length(np.array([length]), values[None])[0])
            return CUBIC, [*values.tolist(), curve / length if length > 0 and curve > 0 else 1.0]
    raise TaskError("has a geometry that is not a line, arc, spiral, poly3 or paramPoly3")


def _curved(along: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return u, v and heading on arcs; the chord has the mean of the headings at its ends."""
    turn = values[:, 0] * along
    chord = along * np.sinc(turn / (2 * np.pi))
    return chord * np.cos(turn / 2), chord * np.sin(turn / 2), turn


def _spiral(along: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return u, v and heading on clothoids, as parts of clothoids that begin with curvature 0."""
    curvature, change = values[:, 0], values[:, 1]
    scale = np.sqrt(np.pi / np.abs(change))
    # The whole clothoid has curvature 0 at its start, and turns to the left.
    before = curvature / change
    sine, cosine = scipy.special.fresnel(np.stack([before, before + along]) / scale)
    side = np.sign(change)
    across, ahead = scale * side * np.diff(sine, axis=0)[0], scale * np.diff(cosine, axis=0)[0]
    first = -change * before**2 / 2
    u = ahead * np.cos(first) - across * np.sin(first)
    v = ahead * np.sin(first) + across * np.cos(first)
    return u, v, along * (curvature + change * along / 2)


def _cubic(along: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return u, v and heading on parametric cubics, at a length from their start."""
    target = along * values[:, 8]
    p = along.copy()
    for _ in range(ROUNDS):
        by_u, by_v = _derivatives(p, values)
        step = (_length(p, values) - target) / np.hypot(by_u, by_v)
        p = p - step
        if not (np.abs(step) > CLOSE_M).any():
            break
    powers = p[:, None] ** np.arange(4)
    u, v = ((powers * part).sum(axis=1) for part in (values[:, :4], values[:, 4:8]))
    by_u, by_v = _derivatives(p, values)
    return u, v, np.arctan2(by_v, by_u)


def _length(p: Floats, values: Floats) -> Floats:
    """Return the length of cubics from parameter 0 to p."""
    nodes = p[:, None] * (NODES + 1) / 2
    by_u, by_v = _derivatives(nodes, values[:, None])
    return np.asarray((np.hypot(by_u, by_v) * WEIGHTS).sum(axis=1) * p / 2)


def _derivatives(p: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return the derivatives of u and v by p."""
    by_u, by_v = (values[..., k] + p * (2 * values[..., k + 1] + p * 3 * values[..., k + 2]) for k in (1, 5))
    return by_u, by_v


@dataclass(frozen=True, eq=False)
class Extent:
    """The lanes of a road at n distances along it."""

    right: Floats
    """Outer border on the right, ``(n,)``, m from the reference line, positive to the left."""
    left: Floats
    middle: Floats
    """Position of lane 0, ``(n,)``."""
    level: bool
    """Whether all lanes are ``level``; else the extent is only of lanes that are not."""


def extent(road: ET.Element, s: Floats) -> Extent:
    """Return the extent of the lanes of a road."""
    middle = np.zeros(len(s))
    if len(offsets := records(road.findall("lanes/laneOffset"))):
        middle = np.where(s < offsets[0, 0], 0.0, value_at(offsets, s))
    sections = road.findall("lanes/laneSection")
    right, left = (_side(sections, side, s, middle, False) for side in SIDES)
    level = not (left > right).any()
    if level:
        right, left = (_side(sections, side, s, middle, True) for side in SIDES)
        level = bool((left > right).any())
    right, left = (np.clip(side, -HALF_WIDEST_M, HALF_WIDEST_M) for side in (right, left))
    return Extent(right, left, middle, level)


def records(elements: list[ET.Element], at: str = "s") -> Floats:
    """Return the cubic pieces of elements, ``(k, 5)``: s, a, b, c, d."""
    return np.array([numbers(each, at, "a", "b", "c", "d", missing=0.0) for each in elements]).reshape(-1, 5)


def _side(sections: list[ET.Element], side: str, s: Floats, middle: Floats, with_level: bool) -> Floats:
    """Return the outer border of the lanes of one side."""
    border = middle.copy()
    # A section of a single side does not change the other side.
    own = [each for each in sections if each.get("singleSide") != "true" or each.find(side) is not None]
    starts = np.array([*(numbers(each, "s")[0] for each in own), np.inf])
    sign = 1.0 if side == "left" else -1.0
    for number, section in enumerate(own):
        here = (s >= starts[number]) & (s < starts[number + 1])
        if number == 0:
            here |= s < starts[0]
        if not here.any():
            continue
        along = s[here] - starts[number]
        lanes = sorted(section.findall(f"{side}/lane"), key=lambda lane: abs(numbers(lane, "id")[0]))
        for lane in lanes:
            if lane.get("level") in ("true", "1") and not with_level:
                break
            if len(widths := records(lane.findall("width"), "sOffset")):
                border[here] += sign * np.maximum(value_at(widths, along), 0.0)
            elif len(borders := records(lane.findall("border"), "sOffset")):
                border[here] = value_at(borders, along)
    return border
