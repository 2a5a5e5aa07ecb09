"""Figures and flags of the decks and tunnels of a tile: area, abutments, clearance, wrong order of levels."""

from __future__ import annotations

import numpy as np
import shapely

from flexroad.tasks.levels.abutments import lack_abutment
from flexroad.tasks.levels.seen import level_road
from flexroad.tasks.types import RoadMask, Structures, Surface

BELOW, NO_RISE, NO_ABUTMENT = "below", "no-rise", "no-abutment"
STRUCTURE_FLAGS = (BELOW, NO_RISE, NO_ABUTMENT)
"""Flags of decks and tunnels, which their tile has as well."""
MOST_CROSSED = 0.01
"""Largest share of a deck below level 0 without a flag."""
LEAST_RISE_M = 0.3
"""Least median clearance without a flag (m)."""
FROM_ABUTMENTS_M = 2.0
"""Nearer to an abutment both levels have nearly the same height (m)."""


def structures(road: RoadMask, surface: Surface, number: int) -> tuple[Structures | None, tuple[str, ...]]:
    """Return the figures and flags of the decks or tunnels of a level; None without any on the core."""
    level = next(level for level in road.levels if level.number == number)
    west, south, east, north = road.core.bounds
    core = shapely.box(west, south, east, north)
    area = shapely.intersection(level.areas, core).area
    if area == 0.0:
        return None, ()
    lines = shapely.get_parts(level.abutments)
    x, y = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True)).T
    # Of two tiles that share a border, one has the abutments on it.
    abutments = int(np.count_nonzero((west <= x) & (x < east) & (south <= y) & (y < north)))
    window = road.grid.window(road.core)
    rows, cols = np.nonzero(level_road(road, number).mask[window] & ~road.outside[window])
    x, y = road.core.eastings[cols], road.core.northings[rows]
    rise = np.sign(number) * (surface.at(number).height(x, y) - surface.height(x, y))
    # Without abutments the distance is NaN.
    inner = rise[~(shapely.distance(level.abutments, shapely.points(x, y)) < FROM_ABUTMENTS_M)]
    found = Structures(
        float(area),
        abutments,
        float(np.median(rise)) if rise.size else float("nan"),
        float(np.mean(inner < 0)) if inner.size else 0.0,
    )
    alone = lack_abutment(shapely.get_parts(level.areas), level.abutments, road.grid, road.core).any()
    raised = (found.crossed > MOST_CROSSED, found.clearance_m < LEAST_RISE_M, alone)
    return found, tuple(flag for flag, is_raised in zip(STRUCTURE_FLAGS, raised, strict=True) if is_raised)
