"""The outlines of decks and tunnels as lines of meshes, and their abutments with the ground.

An abutment is an edge of two meshes: of level 0, and of the level that begins. Both have the same vertices
on it, with the heights of the other level. Below a deck, level 0 has a second line beside it, at the foot of
the abutment, with its own heights. So the wall there is steep, and level 0 stays below the deck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.meshing.lines import AT_BORDER_M, GRID_M, parts_of
from flexroad.tasks.meshing.road_outline import encoded, lines_of
from flexroad.tasks.spline.frame import SAME_M, on_border
from flexroad.tasks.types import Bools, Floats, Level, Surface

WALL_M = 0.25
"""Distance of the foot of an abutment from the abutment (m)."""
CLEAR_M = 0.3
"""Other lines of level 0 are left out within this distance of an abutment (m): the other level
would lack the vertices of crossings."""
LEAST_M2 = 1e-3
"""Smaller parts of a level on a tile have no mesh (m2)."""


@dataclass(frozen=True, eq=False)
class LevelOutline:
    """The areas of a level on a tile, and their outline; metres from the whole-metre origin of the tile."""

    number: int
    area: shapely.Geometry
    """The decks or tunnels on the tile."""
    abutments: NDArray[np.object_]
    """The lines of the outline that are abutments."""
    rim: NDArray[np.object_]
    """The other lines."""
    feet: NDArray[np.object_]
    """Lines at the feet of the abutments."""
    on_abutments: shapely.MultiLineString
    """The abutments as in the level, on and around the tile."""

    @property
    def lines(self) -> NDArray[np.object_]:
        """All lines of the outline."""
        return np.concatenate([self.abutments, self.rim])

    def has_abutment_at(self, points: Floats) -> Bools:
        """Return which points, ``(n, 2 or more)``, lie on abutments, ``(n,)``."""
        return np.asarray(shapely.dwithin(self.on_abutments, shapely.points(points[:, :2]), SAME_M))

    def with_shared(self, border: Floats, ground: Floats, local: Bounds) -> Floats:
        """Return the vertices of the level on the border of a tile; on abutments the vertices of level 0.

        - `border` ``(n, 3)``: vertices along the complete border.
        - `ground` ``(m, 3)``: the vertices of level 0.
        """
        shared = ground[on_border(ground, local) & self.has_abutment_at(ground)]
        every = np.concatenate([border[~self.has_abutment_at(border)], shared])
        near = shapely.dwithin(self.area, shapely.points(every[:, :2]), GRID_M)
        return np.asarray(every[near])

    def covered(self, area: shapely.Geometry, segments: Floats, local: Bounds) -> shapely.Geometry:
        """Return an area whose outline is replaced by the segments, ``(n, 2, 2)``, which differ by rounding.

        Faces between vertices of the outline can be slivers. This area decides which of them lie inside.
        """
        lines = shapely.union_all([*shapely.linestrings(segments), shapely.box(*local).exterior])
        parts = shapely.get_parts(shapely.polygonize(shapely.get_parts(lines)))
        inside = shapely.union_all(parts[shapely.intersects(area, shapely.point_on_surface(parts))])
        return shapely.intersection(inside, shapely.buffer(area, SAME_M))


def level_outline(level: Level, core: Grid, local: Bounds, spacing_m: float) -> LevelOutline | None:
    """Return the outline of a level on a tile, None if it does not lie there.

    - `core`: the tile.
    - `local`: west, south, east and north of the tile, from its origin (m).
    - `spacing_m`: largest distance of points (m).
    """
    areas = encoded(np.array([level.areas], object), core)
    if areas is None:
        return None
    tile, united = shapely.box(*local), shapely.from_wkb(areas.tobytes())
    abutments = shapely.transform(level.abutments, lambda points: points - core.origin)
    area = shapely.intersection(united, tile)
    reaches = area.area >= LEAST_M2
    if not reaches and not shapely.dwithin(abutments, tile, SAME_M):
        return None
    merged = shapely.line_merge(lines_of(shapely.intersection(shapely.boundary(united), tile)))
    pieces = [piece for part in shapely.get_parts(merged) for piece in _pieces(part, abutments)]
    on_abutment = np.array([is_abutment for _, is_abutment in pieces], np.bool_)
    lines = np.array([_divided(line, spacing_m, local) for line, _ in pieces], object)
    feet = _feet(united, lines[on_abutment], tile)
    return LevelOutline(
        number=level.number,
        area=area if reaches else shapely.Polygon(),
        abutments=lines[on_abutment],
        rim=lines[~on_abutment],
        feet=np.array([_divided(line, spacing_m, local) for line in feet], object),
        on_abutments=abutments,
    )


def _pieces(line: shapely.LineString, abutments: shapely.Geometry) -> list[tuple[shapely.LineString, bool]]:
    """Return a line in pieces, each with whether it is an abutment."""
    corners = shapely.get_coordinates(line)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    ends = shapely.get_parts(shapely.boundary(abutments))
    ends = shapely.line_locate_point(line, ends[shapely.dwithin(ends, line, SAME_M)])
    ends = ends[np.abs(ends[:, None] - along).min(axis=1, initial=np.inf) >= SAME_M]
    added = shapely.get_coordinates(shapely.line_interpolate_point(line, ends))
    points = np.concatenate([corners, added])[np.argsort(np.concatenate([along, ends]), kind="stable")]
    middles = shapely.points((points[1:] + points[:-1]) / 2)
    is_abutment = np.asarray(shapely.dwithin(abutments, middles, SAME_M))
    bounds = [0, *(np.flatnonzero(is_abutment[1:] != is_abutment[:-1]) + 1), len(is_abutment)]
    return [
        (shapely.LineString(points[first : last + 1]), bool(is_abutment[first]))
        for first, last in pairwise(bounds)
    ]


def _divided(line: shapely.LineString, spacing_m: float, local: Bounds) -> shapely.LineString:
    """Return a line with points at most a distance (m) apart, on the grid of lines.

    Ends on the border of the tile are not moved. No other point is so near to the border that it would be
    moved there.
    """
    points = shapely.get_coordinates(shapely.segmentize(line, spacing_m))
    at_border = (np.abs(points[:, [0, 1, 0, 1]] - np.array(local)) <= AT_BORDER_M).any(axis=1)
    points[~at_border] = np.round(points[~at_border] / GRID_M) * GRID_M
    kept = ~at_border
    kept[[0, -1]] = True
    return shapely.LineString(points[kept])


def _feet(
    areas: shapely.Geometry, abutments: NDArray[np.object_], tile: shapely.Polygon
) -> NDArray[np.object_]:
    """Return the lines within areas that run beside abutments."""
    if not len(abutments):
        return abutments
    inner = shapely.boundary(shapely.buffer(areas, -WALL_M, join_style="mitre"))
    beside = shapely.buffer(shapely.multilinestrings(abutments), WALL_M + SAME_M, cap_style="flat")
    inside = shapely.intersection(inner, shapely.intersection(beside, tile))
    return parts_of(shapely.line_merge(lines_of(inside)))


def without_abutments(lines: NDArray[np.object_], outlines: Sequence[LevelOutline]) -> NDArray[np.object_]:
    """Return the parts of lines that are not beside abutments."""
    abutments = [outline.abutments for outline in outlines if len(outline.abutments)]
    if not abutments or not len(lines):
        return lines
    beside = shapely.buffer(shapely.multilinestrings(np.concatenate(abutments)), CLEAR_M)
    return parts_of(lines_of(shapely.difference(shapely.multilinestrings(lines), beside)))


def with_abutments(
    heights: Floats, easting: Floats, northing: Floats, surface: Surface, outlines: Sequence[LevelOutline],
    origin: tuple[float, float],
) -> Floats:  # fmt: skip
    """Return heights of points, ``(n,)``, m; on abutments the heights of the other level.

    - `surface`: the surface of level 0, with the other levels.
    - `origin`: easting and northing of the origin of the outlines (m).
    """
    points, result = np.column_stack([easting, northing]), heights.copy()
    for outline in outlines:
        at = outline.has_abutment_at(points - origin)
        result[at] = surface.at(outline.number).height(*points[at].T)
    return result
