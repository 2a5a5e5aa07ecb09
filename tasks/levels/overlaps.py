"""Roads of one level that cross in plan, although a level has one height at each place."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.catalog.text import count

SAME_M = 0.01
"""Vertices within this distance are the same (m)."""
PART_M2 = 1.0
"""Smaller parts of a road beside another one are slivers (m2)."""
MOST_SHARED = 0.5
"""A road with more than this share of its area in common with another one lies on it: it is on its deck."""

Shapes = NDArray[np.object_]


def crossing_notes(areas: Shapes, shapes: Shapes, numbers: NDArray[np.int64], core: Grid) -> tuple[str, ...]:
    """Return a note for each level but 0 on the pairs of its roads that cross on the core by mistake.

    Two roads that cross have a common vertex, as a junction on a deck has. Without one, one of them lies on
    another level in truth, and the surface of both is a compromise.

    - `areas`, `shapes`, `numbers` ``(n,)``: valid polygons of roads, the polygons or lines that they were
      made of, and their levels. Areas that only close wedges between roads have the shape None.
    """
    on_core, notes = shapely.box(*core.bounds), list[str]()
    for number in np.unique(numbers[numbers != 0]).tolist():
        own = np.flatnonzero((numbers == number) & ~shapely.is_missing(shapes))
        pairs = shapely.STRtree(areas[own]).query(areas[own], predicate="overlaps").T
        found = []
        for pair in own[pairs[pairs[:, 0] < pairs[:, 1]]]:
            common = shapely.intersection(*areas[pair])
            if shapely.intersects(common, on_core) and _cross(areas[pair], shapes[pair], common):
                found.append((*areas[pair], common))
        if found:
            first = " and ".join(map(place, found[0][:2]))
            which, beyond = ("upper", number + 1) if number > 0 else ("lower", number - 1)
            notes.append(
                f"segment: {count(len(found), 'pair')} of roads of level {number} cross without a common "
                f"vertex, such as those around {first}, at {place(found[0][2])}; give the {which} one "
                f"level {beyond}, or both a vertex there if it is a junction"
            )
    return tuple(notes)


def _cross(pair: Shapes, shapes: Shapes, common: shapely.Geometry) -> bool:
    """Return whether two roads have parts on both sides of each other, and no junction."""
    if common.area > MOST_SHARED * shapely.area(pair).min():
        return False
    for road in pair:
        parts = shapely.get_parts(shapely.difference(road, common))
        if np.count_nonzero(shapely.area(parts) >= PART_M2) < 2:
            return False
    one, other = (shapely.MultiPoint(shapely.get_coordinates(shape)) for shape in shapes)
    shared = shapely.intersection(one, shapely.buffer(other, SAME_M))
    return not shapely.dwithin(shared, common, SAME_M)


def place(area: shapely.Geometry) -> str:
    """Return the centre of an area for a message."""
    x, y = shapely.get_coordinates(shapely.centroid(area))[0]
    return f"E {x:.0f} N {y:.0f}"
