"""Roads of an export as OpenCRG and OpenDRIVE, one route after the other, and the report of their errors."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import Location, read, stat, write
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile, GroundTile, passing
from flexroad.pipeline.run.sampler import LARGEST_STEP_M, TileSampler, length_text
from flexroad.pipeline.store.tables import csv_text
from flexroad.tasks.errors import TaskError
from flexroad.tasks.levels.along_route import PlaceLevels, route_levels, structures
from flexroad.tasks.quality.flagged import flag_names
from flexroad.tasks.roads.routes import Route
from flexroad.tasks.types import Bools, Floats, HeightAt
from flexroad.tools.export import opencrg, opendrive
from flexroad.tools.export import reference_line as lines
from flexroad.tools.export.georeference import LocalFrame
from flexroad.tools.export.network import Network, network
from flexroad.tools.export.profiles import (
    NONE,
    HeightGrid,
    Profiles,
    across,
    grid_error,
    height_grid,
    largest_steps,
    on_carriageway,
    profile_error,
    profiles,
)
from flexroad.tools.export.reference_line import ReferenceLine
from flexroad.tools.export.source import Options, Source
from flexroad.tools.export.tile_outputs import (
    MARKERS,
    SMOOTH,
    Encode,
    ManifestRow,
    TileOutput,
    steps_left_out,
    write_outputs,
    write_whole,
)

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = lazy("pandas")

VERSION = 8
"""Version of the division into roads, their lines, grids and errors."""
INTERNAL = ["bounds", "lanes_assumed"]
"""Entries of a road's row that the report does not show."""
SUMMARY = (
    *("crg_max_mm", "profiles_mean_mm", "profiles_max_mm", "elevation_mean_mm", "elevation_max_mm"),
    *("crg_steps_max_mm", "carriageway_steps_max_mm", "tile_steps_max_mm"),
)
"""Errors in the summary: means over the length of the roads, and maxima over all roads."""
REPORT = "roads.csv"
MOST_NAMED = 3
"""Number of roads that a message names."""
SHOWN_M = 10.0
"""The user is told if more of the centre lines is left out (m). Short ends of routes are always left out."""


@dataclass(frozen=True)
class Work:
    """What all roads of an export have in common."""

    frame: LocalFrame
    vertical: str | None
    left_hand: bool = False
    crg: str | None = None
    """Folder of the OpenCRG files, relative to the OpenDRIVE file; None if OpenCRG is not exported."""


@dataclass(frozen=True, eq=False)
class RouteUnit:
    """One route of an export, with the tiles that it touches."""

    number: int
    """From 1."""
    route: Route
    tiles: tuple[GroundTile, ...]
    levelled: bool = False
    """Whether the roads of the export have levels."""

    @property
    def id(self) -> str:
        """Number of the route."""
        return str(self.number)

    @property
    def label(self) -> str:
        """Name of the route in messages."""
        return f"road {self.number}"

    @cached_property
    def fingerprint(self) -> str:
        """Hash of its lines and of the surfaces below."""
        text = sha256(repr(self.tiles).encode())
        for part in self.route.parts:
            text.update(repr((part.width_m, part.lanes, part.oneway, part.name)).encode())
            text.update(part.points.tobytes())
            if self.levelled:
                text.update(repr(part.level).encode())
        return text.hexdigest()

    @property
    def sampler(self) -> TileSampler:
        """The surfaces of its tiles."""
        return TileSampler(self.tiles)

    def tile_step(self, line: ReferenceLine, v: Floats, inside: Bools, work: Work) -> float:
        """Return the largest step between the tiles below a road (m); 0 on one tile.

        - `v` ``(m,)``: distances from the line.
        - `inside` ``(n, m)``: the places beside the line's points that are compared.
        """
        x, y = line.beside(v)
        index: NDArray[np.intp] = np.where(inside, np.arange(x.size).reshape(x.shape), -1)
        starts = np.concatenate([index[:-1].ravel(), index[:, :-1].ravel()])
        ends = np.concatenate([index[1:].ravel(), index[:, 1:].ravel()])
        joined = (starts >= 0) & (ends >= 0)
        easting, northing = (values.ravel() for values in work.frame.to_run(x, y))
        return self.sampler.tile_step(easting, northing, starts[joined], ends[joined], self.levels(x, y))

    def levels(self, x: Floats, y: Floats) -> PlaceLevels | None:
        """Return the levels of places in the local frame; None if the route is on level 0 alone."""
        return None if self._levels is None else self._levels(x, y)

    def levels_on(self, x: Floats, y: Floats) -> NDArray[np.int8]:
        """Return the levels of the centre line at places on it."""
        found = self.levels(x, y)
        return np.zeros(x.shape, np.int8) if found is None else found.of_line

    @cached_property
    def _levels(self) -> Callable[[Floats, Floats], PlaceLevels] | None:
        return route_levels(self.route)

    def height(self, work: Work, steps: bool = False) -> HeightAt:
        """Return the surface in the local frame without steps, or only the height that the steps add."""
        return lambda x, y: self.sampler.on_road(*work.frame.to_run(x, y), self.levels(x, y), steps)

    def flags(self, line: ReferenceLine, work: Work) -> str:
        """Return the names of the flags on the carriageway of a road."""
        v = across(line, 1.0, 0.0)
        x, y = line.beside(v)
        on = np.abs(v) <= line.width[:, None] / 2
        x, y = x[on], y[on]
        bits = self.sampler.flags(*work.frame.to_run(x, y), self.levels_on(x, y))
        return ", ".join(flag_names(bits))

    def road_id(self, part: int) -> int:
        """Return the number of a road; readers of OpenDRIVE need whole numbers."""
        return self.number * 1000 + part


def units(roads: Network, tiles: Iterable[FinishedTile]) -> Iterator[RouteUnit]:
    """Yield each route as soon as its last tile has been read."""
    waiting: defaultdict[int, list[int]] = defaultdict(list)
    passed: dict[int, GroundTile] = {}
    for number, touched in enumerate(roads.tiles):
        if len(touched):
            waiting[int(touched[-1])].append(number)
    for index, tile in enumerate(tiles):
        passed[index] = GroundTile.of(tile)
        for number in waiting.pop(index, ()):
            touching = tuple(passed[int(k)] for k in roads.tiles[number])
            yield RouteUnit(number + 1, roads.routes[number], touching, roads.levels)


def write_crg(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write an OpenCRG file per road and the report; return the summary."""
    roads = network(source, options)
    work = Work(roads.frame, source.vertical)
    rows, _ = write_units(opencrg.VERSION, crg_output, work, roads, tiles, folder, executor)
    summary = report(folder, rows, roads)
    error, steps = summary["crg_max_mm"], steps_left_out((summary["crg_steps_max_mm"] or 0.0) / 1000)
    surface = SMOOTH if steps else "the surface"
    text = f"misses {surface} by at most {length_text(error / 1000, 1)}{steps}" if error is not None else ""
    return with_line(summary, text)


def write_xodr(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write all roads as one OpenDRIVE file. It refers to the OpenCRG files, if these are exported."""
    roads = network(source, options)
    crg = "../crg/" if "crg" in options.formats else None
    work = Work(roads.frame, source.vertical, options.left_hand, crg)
    rows, key = write_units(opendrive.VERSION, xodr_output, work, roads, tiles, folder, executor)
    summary = report(folder, rows, roads)
    edges = np.array([road["bounds"] for row in rows for road in row["roads"]])
    bounds = (*edges[:, :2].min(axis=0), *edges[:, 2:].max(axis=0))

    def fill(local: Path) -> None:
        with local.open("wb") as file:
            texts = (read(folder / _fragment(row["route"])) for row in rows if row["roads"])
            opendrive.write(file, texts, roads.frame.proj, bounds, source.run.path.name)

    write_whole(folder / f"{source.run.path.name}{opendrive.NAME}", key, {}, fill)
    summary["notes"] += lane_notes(rows)
    return with_line(summary, _without_crg(summary))


def _without_crg(summary: Mapping[str, Any]) -> str:
    """Return a text for the user: the distance of the profiles from the surface; empty if unknown."""
    if summary["profiles_mean_mm"] is None:
        return ""
    errors = [
        "{} on average, at most {}".format(
            *(length_text(summary[f"{name}_{of}_mm"] / 1000) for of in ("mean", "max"))
        )
        for name in ("profiles", "elevation")
    ]
    steps = steps_left_out((summary["carriageway_steps_max_mm"] or 0.0) / 1000)
    surface = SMOOTH if steps else "the surface"
    alone = f"by elevation alone (CARLA, SUMO) by {errors[1]}"
    return f"misses {surface} by {errors[0]}, without OpenCRG; {alone}{steps}"


def write_units(
    version: int,
    encode: Encode,
    work: Work,
    roads: Network,
    tiles: Iterable[FinishedTile],
    folder: Location,
    executor: Executor,
) -> tuple[list[ManifestRow], str]:
    """Write the files of each route; return their rows, in order, and a fingerprint of all files."""
    whole = sha256(f"{version} {VERSION} {work}".encode())

    def counted() -> Iterator[RouteUnit]:
        for unit in units(roads, tiles):
            whole.update(f"{unit.id} {unit.fingerprint}".encode())
            yield unit

    versions = version * 1000 + VERSION
    outputs = write_outputs(counted(), folder, versions, encode, work, executor)
    rows = sorted(outputs, key=lambda row: int(row["route"]))
    if not any(row["roads"] for row in rows):
        why = f"no road could be written: {rows[0]['problem']}, and so on" if rows else None
        raise ConfigError(why or "no road lies on the tiles")
    return rows, whole.hexdigest()


def crg_output(unit: RouteUnit, work: Work) -> TileOutput:
    """Return the OpenCRG files of a route."""
    roads, problem = _roads(unit, work)
    heights = work.vertical or "as in the run"
    comment = "FlexRoad: {}\nx, y: {}\nheights: {}"
    files = {
        f"{road}{opencrg.NAME}": opencrg.encode(
            grid, comment.format(grid.line.name, work.frame.proj, heights)
        )
        for road, grid, _, _ in roads
    }
    return TileOutput(files, route_row(unit, [row for *_, row in roads], problem))


def xodr_output(unit: RouteUnit, work: Work) -> TileOutput:
    """Return the roads of a route as XML of OpenDRIVE."""
    roads, problem = _roads(unit, work)
    texts = list[bytes]()
    for road, grid, fitted, _ in roads:
        crg = None if work.crg is None else f"{work.crg}{road}{opencrg.NAME}"
        decks = structures(unit.levels_on(grid.line.x, grid.line.y), grid.line.s)
        texts.append(opendrive.encode(str(road), grid.line, fitted, crg, decks, work.left_hand))
    return TileOutput(
        {_fragment(unit.number): b"".join(texts)}, route_row(unit, [row for *_, row in roads], problem)
    )


def _fragment(route: int) -> str:
    return f"{MARKERS}/{route}.xml"


def _roads(unit: RouteUnit, work: Work) -> tuple[list[tuple[int, HeightGrid, Profiles, ManifestRow]], str]:
    """Return numbers, grids, profiles and rows of a route's roads, or the reason why it has no road."""
    height, step = unit.height(work), unit.height(work, steps=True)
    line, problem = reference_line(unit)
    parts = [] if line is None else lines.usable(line, height(line.x, line.y))
    roads = []
    for part, own in enumerate(parts):
        grid = height_grid(own, height)
        fitted, on = profiles(grid), on_carriageway(grid)
        found = row(unit.road_id(part), grid, height, step, fitted, unit.tile_step(own, grid.v, on, work))
        roads.append((unit.road_id(part), grid, fitted, found | {"flags": unit.flags(own, work)}))
    return roads, problem


def reference_line(unit: RouteUnit) -> tuple[ReferenceLine | None, str]:
    """Return the line of a route, or the reason why it has no line."""
    try:
        line = lines.reference_line(unit.route)
    except TaskError as error:
        return None, str(error)
    return line, f"shorter than {lines.MIN_LENGTH_M:g} m" if line is None else ""


def route_row(unit: RouteUnit, roads: list[ManifestRow], problem: str) -> ManifestRow:
    """Return the row of a route: its roads, or the reason why it has no road."""
    if not roads and not problem:
        problem = "no part of it has a surface for long enough"
    return {"route": unit.number, "roads": roads, "problem": problem}


def row(
    road: int, grid: HeightGrid, height: HeightAt, step: HeightAt, fitted: Profiles, tile_step: float
) -> ManifestRow:
    """Return a road's row of the report.

    - `height`, `step`: the surface without steps, and the height that steps add, in the line's coordinates.
    - `tile_step`: the largest step between the tiles below its carriageway (m).
    """
    line = grid.line
    (crg_median, crg_max), (mean, most) = grid_error(grid, height), profile_error(grid, fitted)
    # CARLA and SUMO read only the elevation: their roads are level across.
    level_mean, level_most = profile_error(grid, Profiles(fitted.elevation, NONE))
    crg_steps, carriageway_steps = largest_steps(grid, step)
    half, lanes = float(line.width.max()) / 2, opendrive.lane_count(line)
    errors = {
        "crg_median_mm": crg_median,
        "crg_max_mm": crg_max,
        "profiles_mean_mm": mean,
        "profiles_max_mm": most,
        "elevation_mean_mm": level_mean,
        "elevation_max_mm": level_most,
        "crg_steps_max_mm": crg_steps,
        "carriageway_steps_max_mm": carriageway_steps,
        "tile_steps_max_mm": tile_step,
        "off_centre_line_mm": line.offset_m,
    }
    return {
        "id": road,
        "name": line.name,
        "length_m": round(float(line.s[-1]), 3),
        "width_m": round(2 * half, 3),
        "lanes": lanes,
        "lanes_assumed": not line.lanes and lanes > (1 if line.oneway else 2),
        **{key: millimetres(value) for key, value in errors.items()},
        "bounds": [
            float(line.x.min()) - half,
            float(line.y.min()) - half,
            float(line.x.max()) + half,
            float(line.y.max()) + half,
        ],
    }


def millimetres(metres: float) -> float | None:
    """Return a length in mm for JSON; None if unknown."""
    return round(metres * 1000, 3) if np.isfinite(metres) else None


def report(folder: Location, rows: list[ManifestRow], roads: Network) -> dict[str, Any]:
    """Write the report of the roads, if it has changed; return the summary for the manifest."""
    every = [road for row in rows for road in row["roads"]]
    table = pd.DataFrame(every, dtype=object).drop(columns=INTERNAL)
    data, file = csv_text(table).encode(), folder / REPORT
    known = stat(file)
    if known is None or known.size != len(data) or read(file) != data:
        write(file, data)
    return {
        **totals(rows, roads),
        **{name: _of_all(every, name) for name in SUMMARY},
        "faults": tile_faults(every),
    }


def tile_faults(roads: list[ManifestRow]) -> list[str]:
    """Return a line that names the roads on tiles that do not meet; empty if all tiles meet."""
    name = "tile_steps_max_mm"
    apart = sorted(
        (road for road in roads if road[name] > 1000 * LARGEST_STEP_M), key=lambda road: -road[name]
    )
    if not apart:
        return []
    named = [f"{road['id']} {road['name'] or ''}".strip() for road in apart]
    listed = ", ".join(
        f"road {text}: {length_text(road[name] / 1000)}"
        for text, road in zip(named[:MOST_NAMED], apart[:MOST_NAMED], strict=True)
    )
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    verb = "lie" if len(apart) > 1 else "lies"
    return [f"{count(len(apart), 'road')} {verb} on tiles that do not meet ({listed}{more})"]


def lane_notes(rows: list[ManifestRow]) -> list[str]:
    """Return notes on roads with lanes of unusual width, and on roads divided into lanes by their width."""
    every = [road for row in rows for road in row["roads"]]
    assumed = [road for road in every if road["lanes_assumed"]]
    lane_m = [road["width_m"] / road["lanes"] for road in every]
    unusual = [
        road
        for road, width in zip(every, lane_m, strict=True)
        if width > opendrive.WIDEST_M or (road["lanes"] > 1 and width < opendrive.NARROWEST_M)
    ]
    notes = []
    for roads, text in (
        (assumed, "so wide that its lanes are assumed; give the number of lanes"),
        (unusual, "with lanes of less than 2 m or more than 6 m; correct width or number of lanes"),
    ):
        if roads:
            widest = max(roads, key=lambda road: float(road["width_m"]))
            named = f"road {widest['id']}: {widest['width_m']:g} m, {count(widest['lanes'], 'lane')}"
            notes.append(f"{count(len(roads), 'road')} {text} ({named})")
    return notes


def totals(rows: list[ManifestRow], roads: Network) -> dict[str, Any]:
    """Return number, length and flags of the roads, and the length of centre lines left out on the tiles."""
    length = sum(road["length_m"] for row in rows for road in row["roads"])
    flagged = {str(road["id"]): road["flags"] for row in rows for road in row["roads"] if road["flags"]}
    return {
        "roads": sum(len(row["roads"]) for row in rows),
        "length_m": round(length, 1),
        "left_out_m": round(max(0.0, sum(roads.lengths) - length), 1),
        "left_out_areas": roads.areas,
        "flagged_roads": flagged,
        "notes": [*roads.notes, *([passing(flagged, "road")] if flagged else [])],
    }


def with_line(figures: Mapping[str, Any], error: str = "") -> dict[str, Any]:
    """Return figures with a summary line for the user: number and length of the roads, their error."""
    text = f"{count(figures['roads'], 'road')}, {figures['length_m'] / 1000:.2f} km"
    if figures["left_out_m"] >= SHOWN_M:
        text += f", {figures['left_out_m'] / 1000:.2f} km of centre lines left out"
    if figures["left_out_areas"]:
        text += f", {count(figures['left_out_areas'], 'area')} without centre line left out"
    return {**figures, "summary": f"{text}; {error}" if error else text}


def _of_all(roads: list[ManifestRow], key: str) -> float | None:
    """Return the mean over the length of the roads, or the largest value; None if unknown."""
    known = [road for road in roads if road[key] is not None]
    if "_mean_" not in key:
        return max((road[key] for road in known), default=None)
    length = sum(road["length_m"] for road in known)
    return round(sum(road[key] * road["length_m"] for road in known) / length, 3) if known else None
