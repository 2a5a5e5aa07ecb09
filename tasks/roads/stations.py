"""Height, grade, crossfall and curvature along a road, metre by metre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexroad.tasks.roads.height_grid import HeightAt
from flexroad.tasks.roads.reference_line import ReferenceLine
from flexroad.tasks.types import Floats

STEP_M = 1.0
"""Length of a segment (m)."""
ACROSS = np.linspace(-0.5, 0.5, 9)
"""Places across the carriageway at which the crossfall is measured, as shares of its width."""


@dataclass(frozen=True, eq=False)
class Stations:
    """``n`` segments of equal length, one after the other."""

    x: Floats
    """Ends of the segments, ``(n + 1,)``, m."""
    y: Floats
    z: Floats
    s: Floats
    """Distance of each end from the start of the road, along the road (m)."""
    middle_x: Floats
    """Middle of each segment, ``(n,)``, m."""
    middle_y: Floats
    height: Floats
    """At the middle, ``(n,)``, m."""
    grade: Floats
    """Rise of the segment per metre along it, ``(n,)``; positive uphill."""
    crossfall: Floats
    """Slope of the straight line that fits the cross-section, ``(n,)``; positive where the left is higher."""
    left: Floats
    """Slope from the middle of the carriageway to its left edge, ``(n,)``; negative where it falls."""
    right: Floats
    """Slope from the middle of the carriageway to its right edge, ``(n,)``."""
    curvature: Floats
    """In plan, ``(n,)``, 1/m; positive to the left."""
    width: Floats
    """Of the carriageway, ``(n,)``, m."""


def stations(line: ReferenceLine, height: HeightAt) -> Stations:
    """Return the segments of a line; what is left of a metre at its end is not one.

    Parameters
    ----------
    line : ReferenceLine
        With points at an even fraction of a metre.
    height : callable
        The surface in the line's coordinates; values are NaN where it has none.
    """
    each = round(STEP_M / line.increment / 2)
    middle = np.arange(each, len(line.x) - each, 2 * each)
    ends = np.append(middle - each, middle[-1] + each)
    z = height(line.x[ends], line.y[ends])
    x, y, heading, width = (values[middle] for values in (line.x, line.y, line.heading, line.width))
    away = width[:, None] * ACROSS
    across = height(
        x[:, None] - away * np.sin(heading)[:, None], y[:, None] + away * np.cos(heading)[:, None]
    )
    at_middle = across[:, len(ACROSS) // 2]
    return Stations(
        x=line.x[ends],
        y=line.y[ends],
        z=z,
        s=line.s[ends],
        middle_x=x,
        middle_y=y,
        height=at_middle,
        grade=np.diff(z) / np.diff(line.s[ends]),
        # The places are symmetric, so that the slope of the line that fits does not depend on its height.
        crossfall=(away * across).sum(axis=1) / (away**2).sum(axis=1),
        left=(across[:, -1] - at_middle) / (width / 2),
        right=(across[:, 0] - at_middle) / (width / 2),
        curvature=line.curvature[middle],
        width=width,
    )
