"""Answers of ``flexroad query``: heights, normals and classes of a run at points or along lines."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TextIO

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.crs import short
from flexroad.catalog.guard.open_vector import ERRORS
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import parse_location, write
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import count, reason
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import SEE_REPORT
from flexroad.pipeline.run.sampler import (
    LARGEST_STEP_M,
    STEP_REMEDY,
    Answer,
    RunSampler,
    crs_of,
    length_text,
    required_crs,
    to_crs,
)
from flexroad.pipeline.store.tables import csv_text
from flexroad.tasks.quality.flagged import Bits, flag_names
from flexroad.tasks.types import Floats
from flexroad.tools.results.query_files import Points

if TYPE_CHECKING:
    import geopandas
    import pandas as pd
else:
    geopandas, pd = lazy("geopandas"), lazy("pandas")

MAX_POINTS = 10_000_000
"""Largest number of points of the profiles of one command: their table takes gigabytes."""
LevelWanted = int | Literal["all"] | None
"""A number of a level, all levels of each point, or the highest."""
MOST_NAMED = 3
"""Kinds of flagged places that a note names."""
PASSED_M = 1.0
"""Distance of the points between two steps of a profile at which flagged places are looked for (m)."""
MILLIMETRES = ("distance_m", "easting", "northing")
"""Columns that are written with three decimals; other numbers have nine digits."""


@dataclass(frozen=True, eq=False)
class AnswerTable:
    """A table of n points with the heights, normals and classes of a run."""

    table: pd.DataFrame
    """One row per point: the given columns, then the columns of the answer."""
    easting: Floats
    northing: Floats
    """``(n,)``, m, in the CRS of the run; NaN where the coordinates are unknown."""
    crs: str | None
    """CRS of the run; None if its tiles have several."""
    answer: Answer
    notes: tuple[str, ...] = ()
    """Lines for the user."""
    separator: str = ","
    decimal: str = "."
    level: LevelWanted = None
    """The level that was asked for."""

    def write_csv(self, out: TextIO | Path) -> None:
        """Write the table as CSV. Text that a spreadsheet takes for a formula gets a leading apostrophe."""
        table = self.table.copy()
        for name in MILLIMETRES:
            if name in table and table[name].dtype.kind == "f":
                texts = (f"{value:.3f}".replace(".", self.decimal) for value in table[name])
                table[name] = ["" if text == "nan" else text for text in texts]
        text = csv_text(table, sep=self.separator, decimal=self.decimal, float_format="%.9g")
        if isinstance(out, Path):
            write(parse_location(out), text.encode())
        else:
            out.write(text)

    def write_geopackage(self, path: Path) -> None:
        """Write the table as a GeoPackage of points in the CRS of the run, 3D where they have a height."""
        known = np.isfinite(self.easting) & np.isfinite(self.northing)
        shapes = np.full(len(known), None, dtype=object)
        shapes[known] = shapely.points(self.easting[known], self.northing[known])
        high = known & np.isfinite(self.answer.height)
        shapes[high] = shapely.points(self.easting[high], self.northing[high], self.answer.height[high])
        frame = geopandas.GeoDataFrame(self.table, geometry=shapes, crs=self.crs)
        with ScratchFolder() as folder:
            file = Path(folder, "query.gpkg")
            try:
                frame.to_file(file, layer="query", driver="GPKG", engine="pyogrio")
            except ERRORS as error:
                raise ConfigError(f"{path}: cannot be written: {reason(error)}; write a CSV") from error
            write(parse_location(path), file.read_bytes())


def at_points(sampler: RunSampler, points: Points, level: LevelWanted = None) -> AnswerTable:
    """Return the columns height_m, nx, ny, nz, tile, class and flags at points.

    Points of a vector file also get the columns easting and northing (m), in the CRS of the run. With a level
    there is also a column level; with all levels, each point has a row for each level that it has.
    """
    easting, northing, table = points.x, points.y, points.table
    if points.crs is not None:
        easting, northing = to_crs(points.x, points.y, points.crs, required_crs(sampler))
    if points.vector:
        table = table.assign(easting=easting, northing=northing)
    rows, answer = _on_level(sampler, easting, northing, level)
    whole = table.iloc[rows].assign(**_columns(answer, level))
    return AnswerTable(
        whole,
        easting[rows],
        northing[rows],
        crs_of(sampler),
        answer,
        points.notes,
        points.separator,
        points.decimal,
        level,
    )


def _on_level(
    sampler: RunSampler, easting: Floats, northing: Floats, level: LevelWanted
) -> tuple[NDArray[np.intp], Answer]:
    """Return for each row the index of its point, and the values of the run there."""
    if level == "all":
        return sampler.on_every_level(easting, northing)
    return np.arange(len(easting)), sampler.at(easting, northing, level)


def along_lines(
    sampler: RunSampler, lines: list[Floats], step_m: float, level: LevelWanted = None
) -> AnswerTable:
    """Return profiles: the values of a run every ``step_m`` along lines, and at their ends.

    The columns are line (only if there are several), distance_m, easting, northing, height_m, grade_percent,
    nx, ny, nz, tile, class and flags. The grade is the slope of the surface in the direction of the line,
    positive uphill. Flags apply up to the next point. For levels see `at_points`.
    """
    points = stations(lines, step_m)
    easting, northing = points.easting.to_numpy(), points.northing.to_numpy()
    rows, answer = _on_level(sampler, easting, northing, level)
    if step_m > PASSED_M and level != "all":
        answer = replace(answer, flags=_up_to_next(sampler, lines, points, level))
    points = points.iloc[rows]
    # A normal is (-dz/dx, -dz/dy, 1), scaled to length 1.
    slope = -(answer.normal[:, :2] * points[["east", "north"]].to_numpy()).sum(axis=1) / answer.normal[:, 2]
    table = points.drop(columns=["east", "north"] if len(lines) > 1 else ["line", "east", "north"])
    columns = _columns(answer, level)
    table = table.assign(height_m=columns.pop("height_m"), grade_percent=100 * slope, **columns)
    apart = sampler.largest_tile_step(easting, northing, 1.01 * step_m)
    note = f"the line crosses tiles that do not meet, by up to {length_text(apart)}; {STEP_REMEDY}"
    notes = (note,) if apart > LARGEST_STEP_M else ()
    return AnswerTable(table, easting[rows], northing[rows], crs_of(sampler), answer, notes, level=level)


def _up_to_next(sampler: RunSampler, lines: list[Floats], points: pd.DataFrame, level: int | None) -> Bits:
    """Return the flags that each line passes from each of its points to the next one."""
    length = sum(float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines)
    between = stations(lines, max(PASSED_M, 2 * length / MAX_POINTS))
    found = sampler.at(between.easting.to_numpy(), between.northing.to_numpy(), level).flags
    # Lines are placed one after the other.
    own, fine = (
        table.line.to_numpy() * (length + 1.0) + table.distance_m.to_numpy() for table in (points, between)
    )
    bits = np.zeros(len(points), np.uint16)
    np.bitwise_or.at(bits, np.searchsorted(own, fine + 1e-6, side="right") - 1, found)
    return bits


def stations(lines: list[Floats], step_m: float) -> pd.DataFrame:
    """Return the points every ``step_m`` along lines, and at the end of each.

    The columns are line (from 1), distance_m (in plan, from the start of the line), easting, northing (m),
    and east, north: the unit vector of the line's direction; at a vertex, of the next part's direction.
    """
    lengths = [float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines]
    number = sum(length / step_m + 2 for length in lengths)
    if number > MAX_POINTS:
        raise ConfigError(f"--step {step_m:g}: about {count(round(number), 'point')}; at most {MAX_POINTS}")
    parts = [_along(line, step_m) for line in lines]
    numbers = np.repeat(np.arange(1, len(parts) + 1), [len(part) for part in parts])
    table = pd.DataFrame(
        np.concatenate(parts), columns=["distance_m", "easting", "northing", "east", "north"]
    )
    table.insert(0, "line", numbers)
    return table


def _along(line: Floats, step_m: float) -> Floats:
    """Return the points of one line, ``(n, 5)``: distance, easting, northing, direction east and north."""
    parts = np.diff(line, axis=0)
    lengths = np.hypot(*parts.T)
    # A repeated vertex has no direction.
    start, parts, lengths = line[:-1][lengths > 0], parts[lengths > 0], lengths[lengths > 0]
    ends = np.cumsum(lengths)
    distance = np.arange(0.0, ends[-1], step_m)
    # The end is a separate point unless the last step reaches it, within a millimetre.
    distance = np.append(distance[distance < ends[-1] - 1e-3], ends[-1])
    part = np.minimum(np.searchsorted(ends, distance, side="right"), len(ends) - 1)
    direction = parts[part] / lengths[part, None]
    beyond = distance - (ends[part] - lengths[part])
    return np.column_stack([distance, start[part] + beyond[:, None] * direction, direction])


def _columns(answer: Answer, level: LevelWanted) -> dict[str, Any]:
    normal = dict(zip(("nx", "ny", "nz"), answer.normal.T, strict=True))
    columns = {"height_m": answer.height, **normal, "tile": answer.tile, "class": answer.kind}
    columns |= {} if level is None else {"level": answer.level}
    return columns | {"flags": [", ".join(flag_names(bits)) for bits in answer.flags.tolist()]}


def beyond_survey(result: AnswerTable) -> str:
    """Return a line about the points where a tile has no data; empty if it has data at all points."""
    number = int(((result.answer.tile != "") & np.isnan(result.answer.height)).sum())
    if not number:
        return ""
    verb, whose = ("lies", "its") if number == 1 else ("lie", "their")
    if result.level not in (None, 0, "all"):
        return f"{count(number, 'point')} {verb} on no road of level {result.level}; {whose} height is empty"
    return f"{count(number, 'point')} {verb} beyond the survey; {whose} height, normal and class are empty"


def on_flagged(result: AnswerTable) -> str:
    """Return a line about the points on flagged places; empty if no point is on one."""
    found = Counter(name for name in result.table["flags"] if name)
    if not found:
        return ""
    number = found.total()
    told = "; ".join(f"{names}: {n:,}" for names, n in found.most_common(MOST_NAMED))
    verb = "lies" if number == 1 else "lie"
    return f"{count(number, 'point')} {verb} on flagged places ({told}); {SEE_REPORT}"


def outside(result: AnswerTable, sampler: RunSampler) -> str:
    """Return a line about the points that lie on no finished tile; empty if all lie on one.

    If all points do, it says where the tiles lie.
    """
    number = int((result.answer.tile == "").sum())
    if not number:
        return ""
    verb, whose = ("lies", "its") if number == 1 else ("lie", "their")
    line = f"{count(number, 'point')} {verb} on no finished tile; {whose} columns are empty"
    if number < len(result.answer.tile):
        return line
    bounds = np.array([tile.grid.bounds for tile in sampler.run.catalog.usable])
    west, south = bounds[:, :2].min(axis=0)
    east, north = bounds[:, 2:].max(axis=0)
    line += f"; the tiles lie in W {west:.0f} S {south:.0f} E {east:.0f} N {north:.0f}"
    line += f" ({short(result.crs)})" if result.crs else ""
    degrees = (np.abs(result.easting) <= 180) & (np.abs(result.northing) <= 90)
    return line + ("; longitude and latitude need --crs EPSG:4326" if degrees.all() else "")
