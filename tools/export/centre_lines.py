"""Centre lines of roads from the tables of a vector file, with what their attributes say of the lanes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.io.vectors import Query, encoding_notes, read_near
from flexroad.tasks.roads import attributes
from flexroad.tasks.roads.rasterise import Options, columns, selected
from flexroad.tasks.roads.routes import CentreLine
from flexroad.tasks.types import Source

NAMES = ("name", "fullname", "stt_naam", "nam", "ref")
"""Columns with a road's name or number: OSM, TIGER, NWB, ATKIS; the first with a value wins."""
DIRECTIONS = ("oneway", "one_way", "rijrichtng")
"""Columns with the direction of traffic: OSM, other tables, NWB."""
FORWARD = ("yes", "true", "1", "1.0", "f", "h", "ft")
"""Values of traffic only from the first point to the last: OSM, its shapefiles (F), NWB (H)."""
AGAINST = ("-1", "-1.0", "reverse", "t", "tf")
"""Values of traffic only from the last point to the first; OSM's shapefiles and NWB have T."""
ONE_WAY_CLASSES = ("motorway",)
"""Classes of OSM that are one-way unless a tag says otherwise."""
JUNCTION, ROUNDABOUTS = "junction", ("roundabout", "circular")


@dataclass(frozen=True)
class CentreLines:
    """The centre lines near a place."""

    lines: tuple[CentreLine, ...]
    areas: int
    """Number of road polygons, which have no centre line and are left out."""
    notes: tuple[str, ...] = ()


def read_centre_lines(
    source: Source, bounds: Bounds, crs: str, options: Options, levels: bool = False
) -> CentreLines:
    """Return the centre lines whose boxes touch an area.

    - `source`: vector files; equal lines of several files are one.
    - `bounds`: west, south, east and north (m, in ``crs``).
    - `crs`: CRS of the result.
    - `levels`: whether to read levels. Roads below level 0 are then kept, whatever ``options.tunnels`` says.
    """
    names = (*columns(options), *NAMES, *DIRECTIONS, JUNCTION)
    names += attributes.LEVEL_COLUMNS if levels else ()
    found: dict[bytes, CentreLine] = {}
    areas, notes = 0, list[str]()
    for path in source.paths:
        layer = options.layer or source.sublayer
        table = read_near(Query(path, layer, options.where, names, source.crs, crs), bounds)
        part = from_table(table, options, levels)
        found |= {line.points.tobytes(): line for line in part.lines}
        areas += part.areas
        notes += (*encoding_notes(table, path), *part.notes)
    return CentreLines(tuple(found.values()), areas, tuple(dict.fromkeys(notes)))


def from_table(table: Any, options: Options, levels: bool = False) -> CentreLines:
    """Return the centre lines of a table of features, whose columns are in lower case."""
    table, classes, numbers, unread = selected(table, options, levels)
    members, row = shapely.get_parts(table.geometry.to_numpy(), return_index=True)
    shapes, member = shapely.get_parts(members, return_index=True)
    row, kinds = row[member], shapely.get_type_id(shapes)
    is_line = np.isin(kinds, (1, 2)) & (shapely.length(shapes) > 0)
    rows, row_of = np.unique(row[is_line], return_inverse=True)
    table, classes, numbers = table.iloc[rows], classes[rows], numbers[rows]
    width, notes = attributes.widths(table, classes, options)
    lanes = [int(number) if np.isfinite(number) else None for number in attributes.lanes(table, options)]
    way, name = _direction(table, classes), _texts(table, NAMES)
    lines = []
    for shape, k in zip(shapes[is_line], row_of, strict=True):
        points = shapely.get_coordinates(shape)
        line = CentreLine(points, float(width[k]), lanes[k], bool(way[k]), name[k], int(numbers[k]))
        lines.append(line.reverse if way[k] < 0 else line)
    return CentreLines(tuple(lines), int((kinds == 3).sum()), (*unread, *notes))


def _direction(table: Any, classes: NDArray[np.object_]) -> NDArray[np.int8]:
    """Return 1, -1 or 0 per row: traffic only along the line, only against it, or both."""
    values = [value.lower() for value in _texts(table, DIRECTIONS)]
    implied = np.isin(classes, ONE_WAY_CLASSES)
    implied |= np.isin([value.lower() for value in _texts(table, (JUNCTION,))], ROUNDABOUTS)
    known: Mapping[str, int] = {**dict.fromkeys(FORWARD, 1), **dict.fromkeys(AGAINST, -1), "": 2}
    given = np.array([known.get(value, 0) for value in values], np.int8)
    return np.where(given == 2, implied, given).astype(np.int8)


def _texts(table: Any, names: tuple[str, ...]) -> list[str]:
    """Return the first value of each row, as text; empty if no column has one."""
    texts = [""] * len(table)
    for name in names:
        for k, value in enumerate(table.get(name, ())):
            texts[k] = texts[k] or (str(value).strip() if attributes.has_value(value) else "")
    return texts
