"""Rasterise the roads of a vector file: areas directly, centre lines buffered to their width.

Lines have flat ends; where ends of lines meet, a disc closes the wedge between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import LayerMissing
from flexroad.tasks.io.vectors import Query, encoding_notes, has_place, read_near
from flexroad.tasks.roads import attributes
from flexroad.tasks.roads.attributes import NO, is_yes
from flexroad.tasks.types import Bools, Floats, Source, TileData

rasterio = lazy("rasterio")

CLASS_TAGS = ("highway", "area:highway")
"""OSM's tags of a road's class: in tables with these columns, features without a value are not roads."""
HIDDEN_TAGS = ("tunnel", "covered")
"""Tags of covered roads, whose heights are not in the DSM."""
BRIDGE, AREA = "bridge", "area"
FARTHEST_M = 75.0
"""Distance from the grid up to which roads are read if they have levels (m)."""
SAME_M = 0.01
"""Ends of lines within this distance are the same (m)."""


class Options(attributes.Options):
    """Selection of road features, and the width of lines."""

    layer: str | None = Field(
        None, description="layer of a file with several; for the OSM format, lines and areas are both used"
    )
    where: str | None = Field(None, description="SQL condition that selects features: class = 'road'")
    class_columns: tuple[str, ...] = Field(
        (*CLASS_TAGS, "fclass", "class", "mtfcc", "bst_code", "bgt_functie", "bgt-functie"),
        description="columns (or OSM tags) with a road's class; the first with a value wins",
    )
    left_out: tuple[str, ...] = Field(
        (
            *("proposed", "planned", "construction", "razed", "abandoned", "demolished", "dismantled"),
            *("removed", "disused", "footway", "path", "steps", "cycleway", "bridleway", "pedestrian"),
            *(
                "corridor",
                "elevator",
                "platform",
                "via_ferrata",
                "bus_stop",
                "crossing",
                "traffic_island",
                "services",
                "rest_area",
            ),
            # TIGER: walkways, stairways, winter trails, bike and bridle paths; NWB, BGT: foot and bike paths.
            *("s1710", "s1720", "s1810", "s1820", "s1830", "fp", "vp", "voetpad", "voetpad op trap"),
            *("fietspad", "ruiterpad", "voetgangersgebied", "spoorbaan", "baan voor vliegverkeer"),
        ),
        description="classes of planned or removed roads, and classes that are not carriageways",
    )
    tunnels: bool = Field(False, description="keep roads in tunnels, passages and under roofs")


DEFAULTS = Options()


@dataclass(frozen=True, eq=False)
class Roads:
    """The roads near a tile."""

    areas: NDArray[np.object_]
    """Polygons in the tile's CRS, ``(n,)``."""
    shapes: NDArray[np.object_]
    """The polygons or lines from which they were made, ``(n,)``; None for discs between lines."""
    bridge: Bools
    """Which of them are on bridges, ``(n,)``."""
    level: NDArray[np.int64]
    """Their levels, ``(n,)``; 0 if levels are not read."""
    notes: tuple[str, ...] = ()


def rasterise_roads(data: TileData, options: Options = DEFAULTS) -> Bools:
    """Return the cells of a tile whose centre is on a road, ``(H, W)``; see `roads` for errors."""
    return cells(roads(data.roads, data.grid, options).areas, data.grid)


def cells(areas: NDArray[np.object_], grid: Grid) -> Bools:
    """Return the cells whose centre lies in one of the polygons, ``(H, W)``."""
    areas = areas[~shapely.is_empty(areas) & has_place(areas)]
    if not len(areas):
        return np.zeros(grid.shape, bool)
    burnt: Any = rasterio.features.rasterize(
        areas, out_shape=grid.shape, transform=grid.transform, dtype=np.uint8
    )
    return np.asarray(burnt != 0)


def roads(source: Source | None, grid: Grid, options: Options, levels: bool = False) -> Roads:
    """Return the roads on and around a grid, as polygons.

    - `source`: the tile's layer ``roads``.
    - `grid`: the area to read; roads that touch it are returned completely.
    - `levels`: whether to read levels. Roads below level 0 are then kept, even without `Options.tunnels`.
    """
    if source is None:
        raise LayerMissing(
            "no roads layer in the catalog: give a vector file with --roads to `flexroad catalog` "
            "or `flexroad prepare`"
        )
    # The area is large enough for both portals of a tunnel that reaches the grid.
    reach = max(attributes.MAX_WIDTH_M / 2, FARTHEST_M if levels else 0.0)
    west, south, east, north = grid.bounds
    bounds = (west - reach, south - reach, east + reach, north + reach)
    names = columns(options) + (attributes.LEVEL_COLUMNS if levels else ())
    layer = options.layer or source.sublayer
    parts, notes = list[Roads](), list[str]()
    for path in source.paths:
        table = read_near(Query(path, layer, options.where, names, source.crs, grid.crs), bounds)
        notes += encoding_notes(table, path)
        parts.append(_from_table(table, options, levels))
    return Roads(
        np.concatenate([part.areas for part in parts]),
        np.concatenate([part.shapes for part in parts]),
        np.concatenate([part.bridge for part in parts]),
        np.concatenate([part.level for part in parts]),
        (*notes, *(note for part in parts for note in part.notes)),
    )


def columns(options: Options) -> tuple[str, ...]:
    """Return the columns, or OSM tags, that a selection of roads and their widths need, in lower case."""
    of_width = (*options.width_columns, *options.lane_columns, *attributes.WIDTH_CLASS_COLUMNS)
    names = (*of_width, *options.class_columns, *CLASS_TAGS, BRIDGE, AREA, *HIDDEN_TAGS)
    return tuple(dict.fromkeys(name.lower() for name in names))


def _from_table(table: Any, options: Options, levels: bool) -> Roads:
    """Return the roads of one table."""
    table, classes, numbers, unread = selected(table, options, levels)
    # A collection of multi-part features needs two steps to be split into simple parts.
    members, row = shapely.get_parts(table.geometry.to_numpy(), return_index=True)
    parts, member = shapely.get_parts(members, return_index=True)
    row = row[member]
    bridge, level = is_yes(table, BRIDGE)[row], numbers[row]
    parts = _closed(parts, is_yes(table, AREA)[row])
    is_line = np.isin(shapely.get_type_id(parts), (1, 2))
    is_area = shapely.get_type_id(parts) == 3
    lines, of_line = parts[is_line], row[is_line]
    rows, row_of = np.unique(of_line, return_inverse=True)
    width, notes = attributes.widths(table.iloc[rows], classes[rows], options)
    half = width[row_of] / 2
    joints, joint_bridge, joint_level = _joints(lines, half, bridge[is_line], level[is_line])
    strips = shapely.buffer(lines, half, quad_segs=8, cap_style="flat", join_style="round")
    return Roads(
        np.concatenate([parts[is_area], strips, joints]),
        np.concatenate([parts[is_area], lines, np.full(len(joints), None)]),
        np.concatenate([bridge[is_area], bridge[is_line], joint_bridge]),
        np.concatenate([level[is_area], level[is_line], joint_level]),
        (*unread, *notes),
    )


def selected(
    table: Any, options: Options, levels: bool
) -> tuple[Any, NDArray[np.object_], NDArray[np.int64], tuple[str, ...]]:
    """Return the road rows of a table, their classes in lower case or empty, their levels, and notes.

    The notes are on levels that cannot be read. With levels, tunnels are not left out as hidden.
    """
    numbers, notes = np.zeros(len(table), np.int64), tuple[str, ...]()
    if levels:
        numbers, notes = attributes.level_numbers(table)
    classes = _classes(table, options.class_columns)
    chosen = _is_road(table, classes, options, numbers < 0)
    return table[chosen], classes[chosen], numbers[chosen], notes


def _classes(table: Any, columns: tuple[str, ...]) -> NDArray[np.object_]:
    """Return each row's class in lower case, ``(n,)``; empty where no column has a value."""
    classes = np.full(len(table), "", object)
    for column in map(str.lower, columns):
        if column in table:
            values = np.array([str(value).strip().lower() for value in table[column]], object)
            classes = np.where((classes == "") & ~np.isin(values, NO), values, classes)
    return classes


def _is_road(table: Any, classes: NDArray[np.object_], options: Options, tunnels: Bools) -> Bools:
    road: Bools = ~np.isin(classes, [name.lower() for name in options.left_out])
    if any(tag in table for tag in CLASS_TAGS):
        road &= _classes(table, CLASS_TAGS) != ""
    if not options.tunnels:
        for tag in HIDDEN_TAGS:
            road &= tunnels | ~is_yes(table, tag)
    return road


def _closed(parts: NDArray[np.object_], area: Bools) -> NDArray[np.object_]:
    """Return the parts with closed lines that are tagged as areas turned into polygons."""
    whole = area & shapely.is_closed(parts) & np.isin(shapely.get_type_id(parts), (1, 2))
    whole &= shapely.get_num_points(parts) > 3
    filled = parts.copy()
    filled[whole] = [shapely.Polygon(line.coords) for line in parts[whole]]
    return filled


def _joints(
    lines: NDArray[np.object_], half: Floats, bridge: Bools, level: NDArray[np.int64]
) -> tuple[NDArray[np.object_], Bools, NDArray[np.int64]]:
    """Return discs where ends of lines meet, ``(n,)``, whether only bridges meet there, and their levels.

    The radius of a disc is the second largest half width of the lines that end there. So a wide road that
    continues as a narrow road does not bulge beyond the narrow width. Where lines of several levels meet,
    there is no disc: it would be a street below the deck.
    """
    if not len(lines):
        return np.empty(0, object), np.zeros(0, bool), np.empty(0, np.int64)
    ends = np.concatenate([shapely.get_coordinates(shapely.get_point(lines, i)) for i in (0, -1)])
    radius, decks = np.tile(half, 2), np.tile(bridge, 2)
    _, node = np.unique(np.rint(ends / SAME_M), axis=0, return_inverse=True)
    order = np.lexsort((-radius, node))
    first = np.flatnonzero(np.diff(node[order], prepend=-1))
    many = np.diff(first, append=len(order)) > 1
    levels = np.tile(level, 2)[order]
    lowest, highest = (part.reduceat(levels, first) for part in (np.minimum, np.maximum))
    many &= lowest == highest
    second = order[first[many] + 1]
    deck = np.logical_and.reduceat(decks[order], first)[many]
    discs: NDArray[np.object_] = shapely.buffer(shapely.points(ends[second]), radius[second], quad_segs=8)
    return discs, deck, lowest[many]
