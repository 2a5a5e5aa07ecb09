"""Points along lines, for profiles of heights and grades."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.crs import short
from flexroad.catalog.text import count, shown
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.inspect.point_files import read_features, to_crs
from flexroad.tasks.types import Floats

MAX_POINTS = 10_000_000
"""Largest number of points of the profiles of one command: their table takes gigabytes."""
_COORDINATES = re.compile(r"[-+.\deE\s,]+")


@dataclass(frozen=True, eq=False)
class Stations:
    """n points along lines, in equal steps from the start of each line, and at its end."""

    line: NDArray[np.intp]
    """``(n,)``, number of the line, from 1."""
    distance: Floats
    """``(n,)``, distance from the start of the line in plan (m)."""
    easting: Floats
    northing: Floats
    """``(n,)``, m."""
    direction: Floats
    """``(n, 2)``, unit vectors: east and north components of the line's direction; at a vertex that of the
    part that begins there."""


def read_lines(given: str, crs: str | None, layer: str | None, run_crs: str) -> list[Floats]:
    """Return the vertices of lines, ``(n, 2)`` each, easting and northing (m) in the CRS of a run.

    A line is straight between its vertices in the CRS of the run.

    Parameters
    ----------
    given : str
        A vector file of lines, or the vertices of one line: ``"x y, x y"``. Parts of one feature that touch
        at their ends are one line.
    crs : str or None
        CRS of the lines, as the user says it; None: that of the file, or for vertices that of the run.
    layer : str or None
        Layer of a vector file; needed if it has several.
    run_crs : str
        CRS of the result.

    Raises
    ------
    ConfigError
        If the text is no line, the file cannot be read or has no lines, or a line cannot be transformed.
    """
    if _COORDINATES.fullmatch(given) and not Path(given).exists():
        lines, source = [_vertices(given)], crs
    else:
        lines, source = _features(Path(given), crs, layer)
    projected = [np.column_stack(to_crs(line[:, 0], line[:, 1], source, run_crs)) for line in lines]
    if not all(np.isfinite(line).all() for line in projected):
        raise ConfigError(f"--line {shown(given)}: cannot be transformed to {short(run_crs)}; check its CRS")
    long = [line for line in projected if np.ptp(line, axis=0).any()]
    if not long:
        raise ConfigError(f"--line {shown(given)}: has no length; give at least two different points")
    return long


def _vertices(text: str) -> Floats:
    try:
        return np.array([[float(x), float(y)] for x, y in (part.split() for part in text.split(","))])
    except ValueError:
        raise ConfigError(
            f"--line {shown(text)}: is neither a file nor the points of a line, "
            'such as "500010 5600010, 500050 5600030"'
        ) from None


def _features(path: Path, crs: str | None, layer: str | None) -> tuple[list[Floats], str]:
    """Return the vertices of the lines of a vector file, and their CRS."""
    table = read_features(path, crs, layer)
    shapes = [shape for shape in table.geometry if shape is not None and not shape.is_empty]
    others = [shape.geom_type for shape in shapes if not shape.geom_type.endswith("LineString")]
    if others:
        raise ConfigError(f"{path}: has features of the type {others[0]}, not lines; points go to --points")
    merged = [shapely.line_merge(shape) for shape in shapes]
    return [shapely.get_coordinates(part) for part in shapely.get_parts(merged)], table.crs.to_wkt()


def stations(lines: list[Floats], step_m: float) -> Stations:
    """Return the points every ``step_m`` along lines, and at the end of each.

    Raises
    ------
    ConfigError
        If these are more than `MAX_POINTS`.
    """
    lengths = [float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines]
    number = sum(length / step_m + 2 for length in lengths)
    if number > MAX_POINTS:
        raise ConfigError(f"--step {step_m:g}: about {count(round(number), 'point')}; at most {MAX_POINTS}")
    parts = [_along(line, step_m) for line in lines]
    numbers = np.repeat(np.arange(1, len(parts) + 1), [len(part) for part in parts])
    distance, easting, northing, east, north = np.concatenate(parts).T
    return Stations(numbers, distance, easting, northing, np.column_stack([east, north]))


def _along(line: Floats, step_m: float) -> Floats:
    """Return the points of one line, ``(n, 5)``: distance, easting, northing, direction east and north."""
    parts = np.diff(line, axis=0)
    lengths = np.hypot(*parts.T)
    # A repeated vertex has no direction.
    start, parts, lengths = line[:-1][lengths > 0], parts[lengths > 0], lengths[lengths > 0]
    ends = np.cumsum(lengths)
    distance = np.arange(0.0, ends[-1], step_m)
    # The end is a point of its own unless the last step reaches it, within a millimetre.
    distance = np.append(distance[distance < ends[-1] - 1e-3], ends[-1])
    part = np.minimum(np.searchsorted(ends, distance, side="right"), len(ends) - 1)
    direction = parts[part] / lengths[part, None]
    beyond = distance - (ends[part] - lengths[part])
    return np.column_stack([distance, start[part] + beyond[:, None] * direction, direction])
