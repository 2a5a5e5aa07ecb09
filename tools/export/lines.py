"""Roads of an export as lines in space, with grade, crossfall and estimated error for each metre."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator
from datetime import UTC
from pathlib import Path
from shutil import copyfile
from typing import Any

import numpy as np

from flexroad.catalog.crs import compound
from flexroad.catalog.storage.paths import Location, read
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tools.export import reference_line as lines
from flexroad.tools.export import road_lines
from flexroad.tools.export.along_line import Stations, stations
from flexroad.tools.export.along_roads import (
    NO_ROAD,
    RouteUnit,
    Work,
    millimetres,
    reference_line,
    tile_faults,
    totals,
    with_line,
    write_units,
)
from flexroad.tools.export.network import network
from flexroad.tools.export.pieces import (
    MARKERS,
    SMOOTH,
    Piece,
    Row,
    steps_left_out,
    write_whole,
)
from flexroad.tools.export.reference_line import ReferenceLine
from flexroad.tools.export.road_lines import RoadLine
from flexroad.tools.export.source import Options, Source

PERCENT = 100.0


def write_lines(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write all roads as one GeoPackage; return the summary."""
    roads = network(source, options)
    work = Work(roads.frame, source.vertical)
    rows, key = write_units(road_lines.VERSION, lines_piece, work, roads, tiles, folder, executor)
    found = sum(len(row["roads"]) for row in rows)
    if not found:
        raise ConfigError(f"no road could be written: {rows[0]['problem']}, and so on" if rows else NO_ROAD)
    crs = compound(source.crs, source.vertical) if source.vertical else source.crs

    date = max(tile.datetime for tile in source.tiles).astimezone(UTC)

    def fill(local: Path) -> None:
        # GDAL wants a name that ends like a GeoPackage, and writes other files beside it.
        with ScratchFolder() as scratch:
            file = Path(scratch, f"roads{road_lines.NAME}")
            road_lines.write(file, (road for row in rows for road in _of_route(folder, row)), crs, date)
            copyfile(file, local)

    write_whole(folder / f"{source.run.path.name}{road_lines.NAME}", key, {}, fill)
    steps = max((road["steps_max_m"] for row in rows for road in row["roads"]), default=0.0)
    left_out = steps_left_out(steps)
    every = [road for row in rows for road in row["roads"]]
    tile_steps = max(road["tile_steps_max_mm"] for road in every)
    return with_line(
        {
            **totals(rows, roads),
            "steps_max_m": round(steps, 6),
            "tile_steps_max_mm": tile_steps,
            "faults": tile_faults(every),
        },
        f"along {SMOOTH}{left_out}" if left_out else "",
    )


def lines_piece(unit: RouteUnit, work: Work) -> Piece:
    """Return the roads of a route as arrays; a road ends where the surface does."""
    height, step = unit.height(work), unit.step(work)
    line, problem = reference_line(unit)
    known = np.empty(0) if line is None else height(line.x, line.y)
    parts = [] if line is None else lines.parts(line, np.isfinite(known), lines.Options())
    rows, arrays = list[Row](), dict[str, Any]()
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
    if not rows and not problem:
        problem = "no part of it has a surface for long enough"
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    files = {_file(unit.number): buffer.getvalue()} if rows else {}
    return Piece(files, {"route": unit.number, "roads": rows, "problem": problem})


def _file(route: int) -> str:
    return f"{MARKERS}/{route}.npz"


def _road(road: int, line: ReferenceLine, along: Stations, steps: Stations) -> Row:
    """Return the columns of a road in the layer ``roads``.

    - `along`, `steps`: of the surface without steps, and of the steps above it.
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


def _of_route(folder: Location, row: Row) -> Iterator[RoadLine]:
    """Yield the roads of a route from its arrays."""
    if not row["roads"]:
        return
    with np.load(io.BytesIO(read(folder / _file(row["route"])))) as arrays:
        for number, road in enumerate(row["roads"]):
            prefix = f"{number}."
            own = {
                name.removeprefix(prefix): arrays[name] for name in arrays.files if name.startswith(prefix)
            }
            points, height_source = own.pop("points"), own.pop("height_source")
            yield RoadLine(road, points, own, height_source)
