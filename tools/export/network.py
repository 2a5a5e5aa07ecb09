"""The roads of an export: routes along centre lines, each with the tiles that it touches."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, union
from flexroad.catalog.scan.vectors import file_and_layer, opened
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import types
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.vectors import Query, encoding_notes, read_near
from flexroad.tasks.roads import attributes, rasterise
from flexroad.tasks.roads import routes as routing
from flexroad.tasks.roads.routes import CentreLine, Route
from flexroad.tasks.segment import vector
from flexroad.tools.export.georeference import LocalFrame
from flexroad.tools.export.source import Options, Source

BEYOND_M = 25.0
"""Centre lines are cut this far beyond the tiles (m), so that their smoothing at the limit is the same."""
SIDE_M = 3.0
"""Surfaces are needed up to this distance beyond the lines and grids of a road (m)."""
NAMES = ("name", "fullname", "stt_naam", "nam", "ref")
"""Columns with a road's name or number: OSM, TIGER, NWB, ATKIS; the first with a value wins."""
DIRECTIONS = ("oneway", "one_way", "rijrichtng")
"""Columns with the direction of traffic: OSM, other tables, NWB."""
FORWARD = ("yes", "true", "1", "1.0", "f", "h", "ft")
"""Values for traffic only from the first to the last point: OSM, its shapefiles (F), NWB (H)."""
AGAINST = ("-1", "-1.0", "reverse", "t", "tf")
"""Values for traffic only from the last to the first point; OSM's shapefiles and NWB have T."""
ONE_WAY_CLASSES = ("motorway",)
"""Classes of OSM that are one-way unless a tag says otherwise."""
JUNCTION, ROUNDABOUTS = "junction", ("roundabout", "circular")


@dataclass(frozen=True, eq=False)
class Network:
    """Routes on the tiles of an export."""

    frame: LocalFrame
    routes: tuple[Route, ...]
    """Routes in the coordinates of the frame."""
    tiles: tuple[NDArray[np.intp], ...]
    """Per route, indices of the tiles that it touches, in the order of `Source.tiles`."""
    lengths: tuple[float, ...]
    """Per route, its length on the tiles (m)."""
    areas: int
    """Number of road polygons that were left out."""
    notes: tuple[str, ...]
    levels: bool = False
    """Whether the run has levels, and a road is on a deck or in a tunnel."""


@lru_cache(maxsize=1)
def network(source: Source, options: Options) -> Network:
    """Return the roads of an export; the formats of one export share the result."""
    boxes = shapely.box(*np.array([tile.grid.bounds for tile in source.tiles]).T)
    found = _read(source, options)
    given = f"--roads {options.roads}" if options.roads else f"the roads of {source.run.path}"
    if not found.lines and found.areas:
        raise ConfigError(
            f"{given}: {count(found.areas, 'area')} and no line; exports along roads need centre lines: "
            "name a file with --roads"
        )
    ground = shapely.union_all(boxes)
    lines = _clipped(found.lines, ground)
    if not lines:
        raise ConfigError(f"{given}: no road lies on the tiles; check the file's CRS and the selected tiles")
    frame = _frame(source)
    local = [replace(line, points=np.column_stack(frame.to_local(*line.points.T))) for line in lines]
    routes = tuple(routing.routes(local))
    shapes = [shapely.LineString(np.column_stack(frame.to_run(*route.points.T))) for route in routes]
    tree = shapely.STRtree(boxes)
    reach = (max(part.width_m for part in route.parts) / 2 + SIDE_M for route in routes)
    touched = tuple(
        np.sort(tree.query(line, predicate="dwithin", distance=away))
        for line, away in zip(shapes, reach, strict=True)
    )
    lengths = tuple(map(float, shapely.length(shapely.intersection(shapes, ground))))
    return Network(
        frame, routes, touched, lengths, found.areas, found.notes, any(line.level for line in lines)
    )


def _read(source: Source, options: Options) -> CentreLines:
    """Return the centre lines whose boxes touch the tiles."""
    stage = source.run.config.chains[source.variant]["segment"]
    if options.roads is not None:
        file = _given(options.roads, source.crs)
        places = {file: union([tile.grid.bounds for tile in source.tiles])}
        chosen = rasterise.Options()
    else:
        places = _of_catalog(source)
        chosen = stage if isinstance(stage, rasterise.Options) else rasterise.Options()
    levels = isinstance(stage, vector.Options) and stage.levels
    try:
        return read_centre_lines(places, source.crs, chosen, levels)
    except TaskError as error:
        raise ConfigError(str(error)) from error


def _given(roads: str, crs: str) -> types.Source:
    """Return the file that the user names."""
    path, sublayer = file_and_layer(roads)
    if not path.is_file():
        raise ConfigError(f"--roads {path}: no such file; name a vector file of centre lines")
    try:
        file = opened(path, crs, sublayer)
    except CatalogError as error:
        raise ConfigError(str(error)) from error
    if not file.has_crs:
        raise ConfigError(f"--roads {path} carries no CRS; give it one with ogr2ogr -a_srs")
    return types.Source("roads", (file.path,), sublayer=sublayer)


def _of_catalog(source: Source) -> dict[types.Source, Bounds]:
    """Return the catalog's files of roads, each with the bounds of the tiles that list it."""
    tiles = defaultdict[types.Source, list[Bounds]](list)
    for tile in source.tiles:
        for layer in tile.all_layers:
            if layer.name == "roads":
                for path in tile.paths(layer):
                    file = types.Source("roads", (path,), layer.crs, sublayer=layer.sublayer)
                    tiles[file].append(tile.grid.bounds)
    if not tiles:
        raise ConfigError(
            f"the catalog of {source.run.path} has no roads: name a file of centre lines with --roads"
        )
    return {layer: union(bounds) for layer, bounds in tiles.items()}


def _clipped(lines: tuple[CentreLine, ...], ground: shapely.Geometry) -> list[CentreLine]:
    """Return the parts of lines on and near the ground."""
    near = shapely.buffer(ground, BEYOND_M, join_style="mitre")
    shapely.prepare([ground, near])
    kept = []
    for line in lines:
        shape = shapely.LineString(line.points)
        if not shapely.intersects(ground, shape):
            continue
        if shapely.contains_properly(near, shape):
            kept.append(line)
            continue
        parts = shapely.get_parts(shapely.line_merge(shapely.intersection(shape, near)))
        parts = parts[shapely.get_type_id(parts) == 1]
        kept += [replace(line, points=shapely.get_coordinates(part)) for part in parts]
    return kept


def _frame(source: Source) -> LocalFrame:
    """Return the frame around the selected tiles. Unfinished tiles are used, too: so it does not change."""
    left_out = set(source.left_out)
    selected = [tile for tile in source.run.catalog.usable if tile.id in left_out]
    west, south, east, north = union([tile.grid.bounds for tile in (*source.tiles, *selected)])
    return LocalFrame.around(source.crs, (west + east) / 2, (south + north) / 2)


@dataclass(frozen=True)
class CentreLines:
    """The centre lines near a place."""

    lines: tuple[CentreLine, ...]
    areas: int
    """Number of road polygons; they are left out because they have no centre line."""
    notes: tuple[str, ...] = ()


def read_centre_lines(
    places: Mapping[types.Source, Bounds], crs: str, options: rasterise.Options, levels: bool = False
) -> CentreLines:
    """Return the centre lines whose boxes touch an area.

    - `places`: bounds (m, in ``crs``) by vector file. A line that several files have is returned once.
    - `levels`: whether to read levels. Roads below level 0 are then kept, whatever ``options.tunnels`` says.
    """
    names = (*rasterise.columns(options), *NAMES, *DIRECTIONS, JUNCTION)
    names += attributes.LEVEL_COLUMNS if levels else ()
    found: dict[bytes, CentreLine] = {}
    areas, notes = 0, list[str]()
    files = ((path, source, bounds) for source, bounds in places.items() for path in source.paths)
    for path, source, bounds in files:
        layer = options.layer or source.sublayer
        table = read_near(Query(path, layer, options.where, names, source.crs, crs), bounds)
        part = from_table(table, options, levels)
        found |= {line.points.tobytes(): line for line in part.lines}
        areas += part.areas
        notes += (*encoding_notes(table, path), *part.notes)
    return CentreLines(tuple(found.values()), areas, tuple(dict.fromkeys(notes)))


def from_table(table: Any, options: rasterise.Options, levels: bool = False) -> CentreLines:
    """Return the centre lines of a table of features, whose columns are in lower case."""
    table, classes, numbers, unread = rasterise.selected(table, options, levels)
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
    """Return 1, -1 or 0 per row: traffic along the line, against it, or both."""
    values = [value.lower() for value in _texts(table, DIRECTIONS)]
    implied = np.isin(classes, ONE_WAY_CLASSES)
    implied |= np.isin([value.lower() for value in _texts(table, (JUNCTION,))], ROUNDABOUTS)
    known: Mapping[str, int] = {**dict.fromkeys(FORWARD, 1), **dict.fromkeys(AGAINST, -1), "": 2}
    given = np.array([known.get(value, 0) for value in values], np.int8)
    return np.where(given == 2, implied, given).astype(np.int8)


def _texts(table: Any, names: tuple[str, ...]) -> list[str]:
    """Return the first value of each row, as text; empty if no column has a value."""
    texts = [""] * len(table)
    for name in names:
        for k, value in enumerate(table.get(name, ())):
            texts[k] = texts[k] or (str(value).strip() if attributes.has_value(value) else "")
    return texts
