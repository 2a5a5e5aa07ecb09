"""Roads as lines in space, with grade and crossfall for each metre, as a GeoPackage for GIS programs."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.crs import compound
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import Location, read
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.vectors import vector_date
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.types import Floats, HeightAt
from flexroad.tools.export import reference_line as lines
from flexroad.tools.export.along_roads import (
    RouteUnit,
    Work,
    millimetres,
    reference_line,
    route_row,
    tile_faults,
    totals,
    with_line,
    write_units,
)
from flexroad.tools.export.network import network
from flexroad.tools.export.reference_line import ReferenceLine
from flexroad.tools.export.source import Options, Source
from flexroad.tools.export.tile_outputs import (
    MARKERS,
    SMOOTH,
    ManifestRow,
    TileOutput,
    steps_left_out,
    write_whole,
)

pyogrio = lazy("pyogrio")

VERSION = 2
NAME = "_roads.gpkg"

ROADS, SEGMENTS = "roads", "segments"
"""Layers of the file."""
BATCH = 50_000
"""Number of segments that are written at a time."""
HEIGHT_SOURCE = {
    HeightSource.MEASURED: "measured",
    HeightSource.DTM: "dtm",
    HeightSource.INFERRED: "inferred",
}
"""Values of the column ``height_source``."""
PERCENT = 100.0
STEP_M = 1.0
"""Length of a segment (m)."""
ACROSS = np.linspace(-0.5, 0.5, 9)
"""Places across the carriageway at which the crossfall is measured, as shares of its width."""


Road = tuple[ManifestRow, dict[str, NDArray[Any]]]
"""One road of ``n`` segments: its columns in the layer ``roads`` (first its id), and its arrays.

Arrays: ``points``, ``(n + 1, 3)``: easting, northing, height (m), and the columns of the layer ``segments``.
"""


def write(path: Path, roads: Iterable[Road], crs: str, date: datetime) -> None:
    """Write roads to a new GeoPackage.

    The layer ``roads`` has a line per road, ``segments`` a line per metre. Unknown numbers are null.

    - `roads`: at least one road; all have the same columns.
    - `crs`: CRS of the points, compound if the CRS of the heights is known.
    - `date`: date of the data (UTC), so that equal roads give equal bytes.
    """
    batch, new = list[Road](), True
    with vector_date(date):
        for road in roads:
            batch.append(road)
            if sum(len(arrays["height_source"]) for _, arrays in batch) >= BATCH:
                _append(path, batch, crs, new)
                batch, new = [], False
        if batch:
            _append(path, batch, crs, new)


def _append(path: Path, batch: list[Road], crs: str, new: bool) -> None:
    arrays = {name: [own[name] for _, own in batch] for name in batch[0][1]}
    points = arrays.pop("points")
    sizes = np.array([len(own) for own in points])
    lines = shapely.linestrings(np.concatenate(points), indices=np.repeat(np.arange(len(batch)), sizes))
    columns = {name: _column([row[name] for row, _ in batch]) for name in batch[0][0]}
    _table(path, ROADS, lines, columns, crs, new)
    pairs = np.concatenate([np.stack([own[:-1], own[1:]], axis=1) for own in points])
    key = next(iter(columns))
    height_source = np.concatenate(arrays.pop("height_source"))
    names = np.array([HEIGHT_SOURCE.get(HeightSource(kind)) for kind in range(len(HeightSource))], object)
    numbers = {name: np.concatenate(values) for name, values in arrays.items()}
    owner = np.repeat(columns[key], sizes - 1)
    values = {f"road_{key}": owner, **numbers, "height_source": names[height_source]}
    _table(path, SEGMENTS, shapely.linestrings(pairs), values, crs, new)


def _column(values: list[Any]) -> NDArray[Any]:
    """Return a column of numbers, with NaN for None, or of texts."""
    if any(isinstance(value, str) for value in values):
        return np.array(values, object)
    if all(isinstance(value, int) for value in values):
        return np.array(values, np.int64)
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _table(
    path: Path, layer: str, lines: NDArray[np.object_], columns: Mapping[str, Any], crs: str, new: bool
) -> None:
    kinds = pyogrio.errors
    unwritable = kinds.DataLayerError, kinds.DataSourceError, kinds.FeatureError, kinds.GeometryError
    try:
        pyogrio.raw.write(
            path,
            geometry=shapely.to_wkb(lines, output_dimension=3),
            field_data=list(columns.values()),
            fields=np.array(list(columns), object),
            layer=layer,
            driver="GPKG",
            geometry_type="LineString Z",
            crs=crs,
            append=not new,
            nan_as_null=True,
        )
    except unwritable as error:
        raise TaskError(f"{path} cannot be written: {error}; check the disk") from error


def write_lines(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write all roads as one GeoPackage; return the summary."""
    roads = network(source, options)
    work = Work(roads.frame, source.vertical)
    rows, key = write_units(VERSION, lines_output, work, roads, tiles, folder, executor)
    crs = compound(source.crs, source.vertical) if source.vertical else source.crs

    date = max(tile.datetime for tile in source.tiles).astimezone(UTC)

    def fill(local: Path) -> None:
        # GDAL needs a name that ends in .gpkg, and writes other files next to it.
        with ScratchFolder() as scratch:
            file = Path(scratch, f"roads{NAME}")
            write(file, (road for row in rows for road in _of_route(folder, row)), crs, date)
            copyfile(file, local)

    write_whole(folder / f"{source.run.path.name}{NAME}", key, {}, fill)
    every = [road for row in rows for road in row["roads"]]
    steps = max(road["steps_max_m"] for road in every)
    left_out = steps_left_out(steps)
    figures = totals(rows, roads) | {
        "steps_max_m": round(steps, 6),
        "tile_steps_max_mm": max(road["tile_steps_max_mm"] for road in every),
        "faults": tile_faults(every),
    }
    return with_line(figures, f"along {SMOOTH}{left_out}" if left_out else "")


def lines_output(unit: RouteUnit, work: Work) -> TileOutput:
    """Return the roads of a route as arrays; a road ends where the surface does."""
    height, step = unit.height(work), unit.height(work, steps=True)
    line, problem = reference_line(unit)
    known = np.empty(0) if line is None else height(line.x, line.y)
    parts = [] if line is None else lines.parts(line, np.isfinite(known))
    rows, arrays = list[ManifestRow](), dict[str, Any]()
    for number, part in enumerate(parts):
        along = stations(part, height)
        own = _road(unit.road_id(number), part, along, stations(part, step))
        on_line = np.zeros(1), np.ones((len(part.x), 1), np.bool_)
        own["tile_steps_max_mm"] = millimetres(unit.tile_step(part, *on_line, work))
        own["flags"] = unit.flags(part, work)
        segments = _arrays(along, unit, work)
        if unit.levelled:
            levels = unit.levels_on(along.middle_x, along.middle_y)
            own["level"] = max(levels.tolist(), key=abs)
            segments["level"] = levels.astype(np.int32)
        rows.append(own)
        arrays |= {f"{number}.{name}": values for name, values in segments.items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    files = {_file(unit.number): buffer.getvalue()} if rows else {}
    return TileOutput(files, route_row(unit, rows, problem))


def _file(route: int) -> str:
    return f"{MARKERS}/{route}.npz"


def _road(road: int, line: ReferenceLine, along: Stations, steps: Stations) -> ManifestRow:
    """Return the columns of a road in the layer ``roads``.

    - `along`, `steps`: stations of the surface without steps, and of the heights that steps add.
    """
    step = np.diff(along.s)
    edges = [steps.height + slope * steps.width / 2 for slope in (steps.left, steps.right)]
    return {
        "id": road,
        "name": line.name,
        "length_m": float(along.s[-1]),
        "width_m": float(along.width.mean()),
        "lanes": line.lanes,
        "oneway": int(line.oneway),
        "grade_mean_percent": float(PERCENT * np.average(np.abs(along.grade), weights=step)),
        "grade_max_percent": float(PERCENT * np.abs(along.grade).max()),
        "crossfall_mean_percent": _mean(PERCENT * np.abs(along.crossfall)),
        "steps_max_m": float(np.nanmax(np.abs(np.concatenate([steps.z, steps.height, *edges])))),
    }


def _mean(values: Any) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _arrays(along: Stations, unit: RouteUnit, work: Work) -> dict[str, Any]:
    easting, northing = work.frame.to_run(along.x, along.y)
    middle = along.middle_x, along.middle_y
    error, height_source = unit.sampler.errors(*work.frame.to_run(*middle), unit.levels_on(*middle))
    return {
        "points": np.column_stack([easting, northing, along.z]),
        "height_source": height_source,
        "s_m": along.s[:-1],
        "height_m": along.height,
        "grade_percent": PERCENT * along.grade,
        "crossfall_percent": PERCENT * along.crossfall,
        "left_percent": PERCENT * along.left,
        "right_percent": PERCENT * along.right,
        "curvature_per_m": along.curvature,
        "width_m": along.width,
        "error_m": error,
    }


def _of_route(folder: Location, row: ManifestRow) -> Iterator[Road]:
    """Yield the roads of a route from its arrays."""
    if not row["roads"]:
        return
    with np.load(io.BytesIO(read(folder / _file(row["route"])))) as arrays:
        for number, road in enumerate(row["roads"]):
            prefix = f"{number}."
            own = [name for name in arrays.files if name.startswith(prefix)]
            yield road, {name.removeprefix(prefix): arrays[name] for name in own}


@dataclass(frozen=True, eq=False)
class Stations:
    """``n`` consecutive segments of equal length."""

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
    """Height at the middle, ``(n,)``, m."""
    grade: Floats
    """Rise of the segment per metre along it, ``(n,)``; positive uphill."""
    crossfall: Floats
    """Slope of the best straight line of the cross-section, ``(n,)``; positive where the left is higher."""
    left: Floats
    """Slope from the middle of the carriageway to its left edge, ``(n,)``; negative where it falls."""
    right: Floats
    """Slope from the middle of the carriageway to its right edge, ``(n,)``."""
    curvature: Floats
    """Curvature in plan, ``(n,)``, 1/m; positive to the left."""
    width: Floats
    """Width of the carriageway, ``(n,)``, m."""


def stations(line: ReferenceLine, height: HeightAt) -> Stations:
    """Return the segments of a line; a rest of less than a metre at its end is left out.

    - `line`: the distance of its points is a metre divided by an even number.
    - `height`: the surface in the line's coordinates; NaN beyond it.
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
        # The places are symmetric: so the slope of the best line does not depend on its height.
        crossfall=(away * across).sum(axis=1) / (away**2).sum(axis=1),
        left=(across[:, -1] - at_middle) / (width / 2),
        right=(across[:, 0] - at_middle) / (width / 2),
        curvature=line.curvature[middle],
        width=width,
    )
