"""Roads as vectors on a tile: areas as they are, centre lines as wide as they say.

Lines end flat, as roads do; where ends of lines meet, a disc closes the wedge between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.vectors import Query, read_near
from flexroad.tasks.roads import widths
from flexroad.tasks.types import Bools, Floats, Source, TileData

CLASS_TAGS = ("highway", "area:highway")
"""OSM's tags of a road's class: in tables that have them, features without are no roads."""
HIDDEN_TAGS = ("tunnel", "covered")
"""What lies under something is not what the heights show."""
BRIDGE, AREA = "bridge", "area"
NO = ("", "no", "false", "f", "n", "0", "0.0", "nan", "<na>", "none")
"""How tables say that something is not so."""
SAME_M = 0.01
"""Ends of lines so close are one."""


class Options(widths.Options):
    """Which features are roads, and how wide lines are."""

    layer: str | None = Field(
        None, description="layer of a file with several; of OSM's own format, lines and areas are both taken"
    )
    where: str | None = Field(None, description="which features, in SQL: class = 'road'")
    class_columns: tuple[str, ...] = Field(
        (*CLASS_TAGS, "fclass", "class"),
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
        ),
        description="classes that are no carriageway, or none yet, or none any more",
    )
    tunnels: bool = Field(False, description="keep what lies in tunnels, passages and under roofs")


DEFAULTS = Options()


@dataclass(frozen=True, eq=False)
class Roads:
    """The roads near a tile."""

    areas: NDArray[np.object_]
    """Polygons in the tile's CRS, ``(n,)``."""
    bridge: Bools
    """Which of them are on bridges, ``(n,)``."""
    notes: tuple[str, ...] = ()


def rasterise_roads(data: TileData, options: Options = DEFAULTS) -> Bools:
    """Return the cells of a tile whose centre is on a road, ``(H, W)``; see `roads` for errors."""
    return cells(roads(data.roads, data.grid, options).areas, data.grid)


def cells(areas: NDArray[np.object_], grid: Grid) -> Bools:
    """Return the cells whose centre lies in one of the polygons, ``(H, W)``."""
    from rasterio.features import rasterize

    areas = areas[~shapely.is_empty(areas)]
    if not len(areas):
        return np.zeros(grid.shape, bool)
    burnt: Any = rasterize(areas, out_shape=grid.shape, transform=grid.transform, dtype=np.uint8)
    return np.asarray(burnt != 0)


def roads(source: Source | None, grid: Grid, options: Options) -> Roads:
    """Return the roads on and around a grid, as polygons.

    Parameters
    ----------
    source : Source or None
        The tile's layer ``roads``.
    grid : Grid
        The ground wanted; what touches it is returned whole.
    options : Options
        What is a road, and how wide.

    Raises
    ------
    TaskError
        If the tile has no such layer, or a file cannot be used.
    """
    if source is None:
        raise TaskError(
            "no roads layer in the catalog: give a vector file with --roads to `flexroad catalog` "
            "or `flexroad prepare`"
        )
    reach = options.max_width_m / 2
    west, south, east, north = grid.bounds
    bounds = (west - reach, south - reach, east + reach, north + reach)
    columns = _columns(options)
    found = [
        _of_table(
            read_near(Query(path, options.layer, options.where, columns, source.crs, grid.crs), bounds),
            options,
        )
        for path in source.paths
    ]
    return Roads(
        np.concatenate([part.areas for part in found]),
        np.concatenate([part.bridge for part in found]),
        tuple(note for part in found for note in part.notes),
    )


def _columns(options: Options) -> tuple[str, ...]:
    told = (*options.width_columns, *options.class_columns, *CLASS_TAGS, "lanes", BRIDGE, AREA, *HIDDEN_TAGS)
    return tuple(dict.fromkeys(name.lower() for name in told))


def _of_table(table: Any, options: Options) -> Roads:
    """Return the roads of one table."""
    classes = _classes(table, options.class_columns)
    chosen = _is_road(table, classes, options)
    table, classes = table[chosen], classes[chosen]
    # A collection of multi-part features comes apart in two steps.
    several, of = shapely.get_parts(table.geometry.to_numpy(), return_index=True)
    parts, again = shapely.get_parts(several, return_index=True)
    of = of[again]
    bridge = _says(table, BRIDGE)[of]
    parts = _closed(parts, _says(table, AREA)[of])
    is_line = np.isin(shapely.get_type_id(parts), (1, 2))
    is_area = shapely.get_type_id(parts) == 3
    lines, of_line = parts[is_line], of[is_line]
    rows, row_of = np.unique(of_line, return_inverse=True)
    width, notes = widths.widths(table.iloc[rows], classes[rows], options)
    half = width[row_of] / 2
    joints, joint_bridge = _joints(lines, half, bridge[is_line])
    strips = shapely.buffer(lines, half, quad_segs=8, cap_style="flat", join_style="round")
    return Roads(
        np.concatenate([parts[is_area], strips, joints]),
        np.concatenate([bridge[is_area], bridge[is_line], joint_bridge]),
        notes,
    )


def _classes(table: Any, columns: tuple[str, ...]) -> NDArray[np.object_]:
    """Return each row's class in lower case, ``(n,)``; empty where none of the columns tells."""
    found = np.full(len(table), "", object)
    for column in map(str.lower, columns):
        if column in table:
            told = np.array([str(value).strip().lower() for value in table[column]], object)
            found = np.where((found == "") & ~np.isin(told, NO), told, found)
    return found


def _is_road(table: Any, classes: NDArray[np.object_], options: Options) -> Bools:
    road: Bools = ~np.isin(classes, [name.lower() for name in options.left_out])
    if any(tag in table for tag in CLASS_TAGS):
        road &= _classes(table, CLASS_TAGS) != ""
    if not options.tunnels:
        for tag in HIDDEN_TAGS:
            road &= ~_says(table, tag)
    return road


def _says(table: Any, column: str) -> Bools:
    """Return the rows that say yes, or anything but no, in a column, ``(n,)``."""
    if column not in table:
        return np.zeros(len(table), bool)
    return np.array([str(value).strip().lower() not in NO for value in table[column]], bool)


def _closed(parts: NDArray[np.object_], area: Bools) -> NDArray[np.object_]:
    """Return the parts with closed lines that say they are areas as such."""
    whole = area & shapely.is_closed(parts) & np.isin(shapely.get_type_id(parts), (1, 2))
    whole &= shapely.get_num_points(parts) > 3
    filled = parts.copy()
    filled[whole] = [shapely.Polygon(line.coords) for line in parts[whole]]
    return filled


def _joints(lines: NDArray[np.object_], half: Floats, bridge: Bools) -> tuple[NDArray[np.object_], Bools]:
    """Return discs where ends of lines meet, and which of them lie on bridges alone.

    A disc has the second largest half width of the lines that end there: a wide road that goes on as a
    narrow one bulges no farther than the narrow one is wide.
    """
    if not len(lines):
        return np.empty(0, object), np.zeros(0, bool)
    ends = np.concatenate([shapely.get_coordinates(shapely.get_point(lines, i)) for i in (0, -1)])
    radius, decks = np.tile(half, 2), np.tile(bridge, 2)
    _, node = np.unique(np.rint(ends / SAME_M), axis=0, return_inverse=True)
    order = np.lexsort((-radius, node))
    first = np.flatnonzero(np.diff(node[order], prepend=-1))
    many = np.diff(first, append=len(order)) > 1
    second = order[first[many] + 1]
    deck = np.logical_and.reduceat(decks[order], first)[many]
    discs: NDArray[np.object_] = shapely.buffer(shapely.points(ends[second]), radius[second], quad_segs=8)
    return discs, deck
