"""Lanes of OpenDRIVE: how far a road reaches to its right and left, and where it is superelevated."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree as ET

import numpy as np

from flexroad.tasks.types import Floats
from flexroad.tools.export.profiles import value_at
from flexroad.tools.lift.plan_view import numbers

SIDES = ("right", "left")
HALF_WIDEST_M = 200.0
"""Lanes further from the reference line are not looked at (m)."""


@dataclass(frozen=True, eq=False)
class Extent:
    """The lanes of a road at n distances along it."""

    right: Floats
    """Outer border on the right, ``(n,)``, m from the reference line, positive to the left."""
    left: Floats
    middle: Floats
    """Where the lane 0 is, ``(n,)``."""
    level: bool
    """Whether all lanes are ``level``; else the extent is that of the lanes that are not."""


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
    # A section of a single side leaves the other one as it is.
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
