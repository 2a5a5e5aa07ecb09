"""Where the roads of other levels begin: the abutments of decks and tunnels, and their approaches.

A note is made on roads of one level that cross in plan, because a level has one height at each place.

All decisions depend only on the vectors and on cells near each abutment. So a tile, its neighbour and
their edge find the same levels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.catalog.text import count
from flexroad.tasks.io.vectors import has_place
from flexroad.tasks.meshing.road_outline import polygons_of
from flexroad.tasks.roads.flat_patches import flat_cells
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.types import BLEND_M, Bools, Floats, Level, TileData

APPROACH_M = 16.0
"""Length of an approach (m): a control point of 3.6 m distance acts up to 10.8 m away."""
REACH_M = APPROACH_M + BLEND_M + 1.0
"""A level farther from a tile than this (m) has no effect on its surface."""
GAP_M = 1.5
"""Widest gap between a deck and its approach (m)."""
SHORTEST_M = 1.5
"""Shortest abutment (m)."""
STEP_M = 0.25
"""Distance of the places along an outline at which an abutment is searched (m)."""
BELOW_M = 2.5
"""A street of level 0 that reaches at least this far below a deck (m) passes below it."""
PASSES_M2 = 1.0
"""Least area of the part of a street that lies so far within the outline (m2)."""
INNER = 0.4
"""Share of the width of a narrow deck that replaces `BELOW_M`."""
TURN_DEG = 45.0
"""An outline has a corner where it turns by more than this (degrees)."""
WIDEST_M = 40.0
"""If half of a straight side up to this length (m) is an abutment, the whole side is, with its pavements."""
RISE_M = 0.75
"""Largest difference in height of visible roads on both sides of an abutment (m)."""
BESIDE_M = 6.0
"""Distance from the middle of an abutment up to which these roads are compared (m)."""
AROUND_M = 16.0
"""Distance from there up to which cells decide whether a road is visible (m)."""
ROUGHNESS_M, BEND = 0.15, 0.1
"""Largest residuals (m) and differences of slope of the flat patches of a visible road."""
APART_M = 0.02
"""Distance between decks and roads of level 0 (m)."""
TUNNEL_M = 50.0
"""Longest tunnel (m): heights of a longer tunnel would be guessed."""
SAME_M = 0.01
"""Vertices within this distance are the same (m)."""
PART_M2 = 1.0
"""Parts of a road beside another road that are smaller than this are slivers (m2)."""
MOST_SHARED = 0.5
"""A road that shares more than this part of its area with another road lies on the same deck."""

Lines = NDArray[np.object_]


def levels_of(
    areas: NDArray[np.object_], shapes: NDArray[np.object_], numbers: NDArray[np.int64], data: TileData
) -> tuple[tuple[Level, ...], tuple[str, ...]]:
    """Return the levels on which the surface of a tile depends, by ascending number, and notes.

    - `areas`, `shapes`, `numbers` ``(n,)``: the roads on and around the tile's grid as polygons, their
      original shapes (`rasterise.Roads`), and their levels.
    - `data`: heights of the tile; abutments between roads of different heights are refused.
    """
    if not numbers.any():
        return (), ()
    known = ~shapely.is_empty(areas) & has_place(areas)
    areas, shapes, numbers = areas[known], shapes[known], numbers[known]
    invalid = ~shapely.is_valid(areas)
    areas[invalid] = shapely.make_valid(areas[invalid])
    streets = areas[numbers == 0]
    window, near = _grown(data.grid, 0.0), _grown(data.core, REACH_M)
    levels, notes = [], list(crossing_notes(areas, shapes, numbers, data.core))
    for number in np.unique(numbers[numbers != 0]).tolist():
        level = _level(number, _polygons(shapely.union_all(areas[numbers == number])), streets, data)
        if number < 0:
            level, left_out = _with_portals(level, data.core)
            notes += left_out
        if not shapely.intersects(shapely.union(level.areas, level.approach), near):
            continue
        if number > 0:
            parts = shapely.get_parts(level.areas)
            alone = parts[lack_abutment(parts, level.abutments, data.grid, data.core)]
            if len(alone):
                notes.append(
                    f"segment: {count(len(alone), 'deck')} of level {number} without an abutment at a road "
                    f"of level 0, such as at {place(alone[0])}; check the level of the roads at its ends, "
                    f"and gaps above {GAP_M:g} m"
                )
        cut = _polygons(shapely.intersection(level.areas, window))
        levels.append(replace(level, areas=cut))
    return tuple(levels), tuple(notes)


def _polygons(geometry: shapely.Geometry) -> shapely.MultiPolygon:
    """Return the polygons of a geometry of any kind."""
    return shapely.MultiPolygon(list(polygons_of(geometry)))


def _grown(grid: Grid, distance_m: float) -> shapely.Polygon:
    west, south, east, north = grid.bounds
    return shapely.box(west - distance_m, south - distance_m, east + distance_m, north + distance_m)


def _level(number: int, areas: shapely.MultiPolygon, streets: Lines, data: TileData) -> Level:
    """Return a level with all its areas."""
    near = streets[shapely.dwithin(streets, areas, APPROACH_M + GAP_M)]
    # Streets with a part far within an outline pass below the deck, or above the tunnel.
    parts = shapely.get_parts(areas)
    width = 2 * shapely.area(parts) / shapely.length(parts)
    inner = shapely.union_all(shapely.buffer(parts, -np.minimum(BELOW_M, INNER * width)))
    passes = shapely.area(shapely.intersection(near, inner)) >= PASSES_M2
    touching = near[~passes & shapely.dwithin(near, areas, GAP_M)]
    lines = list(_ends(areas, touching))
    if number > 0:
        window = _grown(data.grid, 0.0)
        lines = [line for line in lines if shapely.intersects(line, window)]
        # The road beyond a portal lies below the ground around it, and under tree crowns.
        deck = cells(np.array([areas]), data.grid)
        street = cells(touching, data.grid) & ~deck
        lines = [line for line in lines if _is_level(line, deck, street, data)]
    abutments = shapely.MultiLineString(lines)
    ground = shapely.difference(shapely.union_all(near[~passes]), shapely.buffer(areas, APART_M))
    road = _touching(
        _polygons(shapely.intersection(ground, shapely.buffer(abutments, APPROACH_M))), abutments
    )
    gaps = shapely.difference(shapely.buffer(abutments, GAP_M, cap_style="flat"), areas)
    approach = _polygons(shapely.union(road, gaps))
    beside = shapely.intersection(shapely.union_all(near[passes]), shapely.buffer(abutments, REACH_M))
    return Level(number, areas, abutments, approach, _polygons(shapely.difference(beside, approach)))


def _ends(areas: shapely.MultiPolygon, streets: Lines) -> Iterator[shapely.LineString]:
    """Yield the lines on outlines at which a street ends; streets that continue below are left out."""
    for polygon in shapely.get_parts(shapely.orient_polygons(areas)):
        for ring in (polygon.exterior, *polygon.interiors):
            for side in _sides(ring):
                yield from _fronts(side, streets)


def _sides(ring: shapely.LinearRing) -> list[shapely.LineString]:
    """Return an outline in pieces between its corners; the first piece begins at a corner."""
    corners = shapely.get_coordinates(shapely.remove_repeated_points(ring, 1e-6))[:-1]
    steps = np.diff(corners, axis=0, append=corners[:1])
    angle = np.degrees(np.arctan2(steps[:, 1], steps[:, 0]))
    sharp = np.abs((angle - np.roll(angle, 1) + 180) % 360 - 180) > TURN_DEG
    first = int(sharp.argmax())
    corners, sharp = np.roll(corners, -first, axis=0), np.roll(sharp, -first)
    starts = np.flatnonzero(sharp).tolist() if sharp.any() else [0]
    closed = np.concatenate([corners, corners[:1]])
    return [shapely.LineString(closed[i : j + 1]) for i, j in pairwise([*starts, len(corners)])]


def _fronts(side: shapely.LineString, streets: Lines) -> Iterator[shapely.LineString]:
    """Yield the abutments on one side of an outline that has the area on its left."""
    places = shapely.get_coordinates(shapely.segmentize(side, STEP_M))
    steps = np.diff(places, axis=0)
    outward = np.column_stack([steps[:, 1], -steps[:, 0]]) / np.hypot(*steps.T)[:, None]
    middle = (places[:-1] + places[1:]) / 2
    joined = np.zeros(len(middle), np.bool_)
    for street in streets[shapely.dwithin(streets, side, GAP_M)]:
        ahead = [_is_at(street, middle + distance * outward) for distance in (0.1, GAP_M / 2, GAP_M)]
        inside = [_is_at(street, middle - share * BELOW_M * outward) for share in np.linspace(0.2, 1, 5)]
        joined |= np.any(ahead, axis=0) & ~np.all(inside, axis=0)
    if joined.mean() >= 0.5 and side.length <= WIDEST_M:
        joined[:] = True
    changes = np.flatnonzero(np.diff(joined, prepend=False, append=False))
    for i, j in zip(changes[::2], changes[1::2], strict=True):
        line = shapely.LineString(places[i : j + 1])
        if line.length >= SHORTEST_M:
            yield line


def _is_at(area: shapely.Geometry, places: Floats) -> Bools:
    return np.asarray(shapely.intersects_xy(area, *places.T))


def _is_level(abutment: shapely.LineString, deck: Bools, street: Bools, data: TileData) -> bool:
    """Return whether deck and street have the same height at an abutment, or one of them is not visible."""
    x, y = shapely.get_coordinates(abutment.interpolate(0.5, normalized=True))[0]
    grid = data.grid
    row, col = (int(value) for value in grid.cells(np.array(x), np.array(y)))
    n = int(AROUND_M / grid.cell) + 1
    rows, cols = slice(max(row - n, 0), row + n + 1), slice(max(col - n, 0), col + n + 1)
    away = np.hypot(grid.eastings[cols] - x, grid.northings[rows][:, None] - y)
    dsm, dtm = data.dsm[rows, cols], data.dtm[rows, cols]
    near = away <= BESIDE_M
    above = _median(np.where(_flat(dsm, deck[rows, cols], grid.cell), dsm, np.nan)[near])
    road = street[rows, cols]
    ground = np.where(_flat(dsm, road, grid.cell), dsm, np.where(road, dtm, np.nan))
    return not abs(above - _median(ground[near])) > RISE_M


def _flat(heights: Floats, road: Bools, cell: float) -> Bools:
    return flat_cells(heights, road & np.isfinite(heights), cell, ROUGHNESS_M, BEND)


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _touching(areas: shapely.MultiPolygon, abutments: shapely.MultiLineString) -> shapely.MultiPolygon:
    """Return the polygons that begin at an abutment."""
    parts = shapely.get_parts(areas)
    shared = shapely.length(shapely.intersection(shapely.buffer(parts, GAP_M), abutments))
    return shapely.MultiPolygon(list(parts[shared >= SHORTEST_M]))


def _with_portals(level: Level, core: Grid) -> tuple[Level, list[str]]:
    """Return the tunnels that begin and end within reach, and a note about other tunnels on the tile."""
    parts, kept, notes = shapely.get_parts(level.areas), list[shapely.Polygon](), list[str]()
    abutments = shapely.get_parts(level.abutments)
    for part in parts:
        portals = shapely.dwithin(abutments, part, APART_M)
        corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(part))
        length = float(np.hypot(*np.diff(corners, axis=0).T).max())
        if np.count_nonzero(portals) >= 2 and length <= TUNNEL_M:
            kept.append(part)
        elif shapely.intersects(part, _grown(core, 0.0)):
            why = f"is longer than {TUNNEL_M:g} m" if length > TUNNEL_M else "has no two portals"
            notes.append(
                f"segment: the tunnel at {place(part)} (level {level.number}) {why}, so it is left out"
            )
    areas = shapely.MultiPolygon(kept)
    abutments = abutments[shapely.dwithin(abutments, areas, APART_M)] if kept else abutments[:0]
    lines = shapely.MultiLineString(list(abutments))
    approach = _touching(level.approach, lines)
    return replace(level, areas=areas, abutments=lines, approach=approach), notes


def lack_abutment(parts: Lines, abutments: shapely.MultiLineString, grid: Grid, core: Grid) -> Bools:
    """Return which decks on a tile have no abutment, ``(n,)``; decks beyond its grid may have one there."""
    known = shapely.contains_properly(_grown(grid, 0.0), parts) & shapely.intersects(parts, _grown(core, 0.0))
    return np.asarray(known & ~shapely.dwithin(parts, abutments, APART_M))


def crossing_notes(areas: Lines, shapes: Lines, numbers: NDArray[np.int64], core: Grid) -> tuple[str, ...]:
    """Return a note for each level but 0 on the pairs of its roads that cross on the core by mistake.

    Roads that cross correctly have a common vertex, such as a junction on a deck. Without a common vertex,
    one of them really lies on another level, and the surface of both is a compromise.

    - `areas`, `shapes`, `numbers` ``(n,)``: valid polygons of roads, the polygons or lines from which they
      were made, and their levels. Areas that only close wedges between roads have the shape None.
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


def _cross(pair: Lines, shapes: Lines, common: shapely.Geometry) -> bool:
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
