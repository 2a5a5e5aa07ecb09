"""Points, lines and polygons with heights of a run: the common part of all formats of features."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.guard.open_vector import ERRORS, layer_info, vector_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import reason
from flexroad.pipeline.run.sampler import Heights
from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.flagged import Bits, passed
from flexroad.tasks.roads import attributes
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.lift.lines import STEP_M, Line, largest, steepest
from flexroad.tools.lift.network import ANY, Numbers, along, filled, of_levels
from flexroad.tools.lift.shapes import POINT, POLYGON, Shape
from flexroad.tools.lift.types import POINTS, Lifted, Options, RunSurface, Steep

pyogrio = lazy("pyogrio")
if TYPE_CHECKING:
    import pandas as pd
else:
    pd = lazy("pandas")

MOST_PIECES = 200_000
"""Largest number of such points of a segment; in segments of more than 100 km their distance is larger."""
ACROSS_M = 1.0
"""The crossfall of a line is measured at this distance on both sides (m)."""
COLUMNS = ("grade_max_percent", "crossfall_max_percent", "error_estimate_m")
"""Columns that are added on request."""
BATCH_BYTES, BATCH_FEATURES = 2**25, 50_000
"""Size of the geometries and number of the features in memory at a time."""
ZERO = "no ground of the run: has the height 0, as the format has one dimension for all"


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """A feature of a file."""

    id: str
    shape: Shape | None
    wanted: int = int(ANY)
    """Number of its level, or `ANY`."""


def vector_info(source: Path) -> dict[str, Any]:
    """Return pyogrio's description of the layer of a file."""
    try:
        name = vector_name(source)
        with warnings.catch_warnings():
            # The M values of a Shapefile are read without GDAL.
            warnings.filterwarnings("ignore", "Measured")
            return layer_info(name, str(pyogrio.list_layers(name)[0, 0]))
    except ERRORS as error:
        raise TaskError(f"cannot be read: {reason(error)}") from error


def level_columns(names: Iterable[str]) -> list[str]:
    """Return the columns of a layer that give the level of a feature; empty if no column does."""
    known = attributes.LEVEL_COLUMNS
    own = [name for name in names if name.lower() in known]
    # OSM's layer only orders crossing features: alone it is not a level, and often has another meaning.
    return own if any(name.lower() != "layer" for name in own) else []


def wanted_levels(columns: Mapping[str, Sequence[Any]], count: int) -> list[int]:
    """Return the level of each feature, from its values in `level_columns`; `ANY` without such columns."""
    if not columns:
        return [int(ANY)] * count
    table = pd.DataFrame(
        {name.lower(): pd.Series(list(values), dtype=object) for name, values in columns.items()}
    )
    return [int(number) for number in attributes.level_numbers(table)[0]]


def percent_columns(row: Lifted) -> tuple[float | None, float | None, float | None]:
    """Return the values of `COLUMNS`; None where unknown."""
    values = (100 * row.grade, 100 * row.crossfall, row.error_m)
    grade, crossfall, error = (round(value, 4) if np.isfinite(value) else None for value in values)
    return grade, crossfall, error


def with_zero(shape: Shape | None, row: Lifted) -> tuple[Shape | None, Lifted]:
    """Return a geometry with z and its row, for formats where all have a z: without ground 0, with a note."""
    if shape is None or shape.z or not (shape.paths or shape.parts):
        return shape and shape.flat(), row
    return shape.flat(), replace(row, note=ZERO)


def lifted(
    features: Sequence[Feature], run: RunSurface, options: Options
) -> Iterator[tuple[Shape | None, Lifted]]:
    """Yield each feature's geometry with heights, and its row of the report.

    Lines are straight between their vertices in the CRS of the file. Features without any ground are yielded
    unchanged.

    - `features`: some features of a layer, which fit in memory.
    """
    paths = _Paths.of(features, run)
    ends = np.cumsum(np.bincount(paths.feature, paths.pieces, len(features)).astype(np.intp))
    first = 0
    while first < len(features):
        before = ends[first - 1] if first else 0
        last = max(int(np.searchsorted(ends, before + POINTS, side="right")), first + 1)
        yield from _group(features[first:last], paths.of_features(first, last), run, options)
        first = last


@dataclass(frozen=True, eq=False)
class _Paths:
    """The coordinates of all paths of some features."""

    values: Floats
    """``(n, 4)``: x, y, z, m; NaN for z and m that a path does not have."""
    east: Floats
    north: Floats
    path: NDArray[np.intp]
    """``(n,)``, the number of the path of each vertex."""
    feature: NDArray[np.intp]
    """``(n,)``, the number of the feature of each vertex."""
    pieces: NDArray[np.intp]
    """``(n,)``, number of pieces of the segment after each vertex; 1 after the last vertex of a path."""
    length: Floats
    """``(n,)``, length of that segment (m); 0 after the last vertex."""

    @classmethod
    def of(cls, features: Sequence[Feature], run: RunSurface) -> _Paths:
        parts, owners = list[Floats](), list[int]()
        for number, feature in enumerate(features):
            for _, z, m, path in feature.shape.all_paths() if feature.shape else ():
                values = path
                if not (z and m):
                    values = np.full((len(path), 4), np.nan)
                    values[:, : 2 + z] = path[:, : 2 + z]
                    if m:
                        values[:, 3] = path[:, -1]
                parts.append(values)
                owners.append(number)
        sizes = np.array([len(part) for part in parts], np.intp)
        values = np.concatenate(parts) if parts else np.zeros((0, 4))
        path_of = np.repeat(np.arange(len(parts)), sizes)
        east, north = run.to_run(values[:, 0], values[:, 1])
        length, pieces = np.zeros(len(values)), np.ones(len(values), np.intp)
        on = np.flatnonzero(path_of[:-1] == path_of[1:])
        length[on] = np.hypot(east[on + 1] - east[on], north[on + 1] - north[on])
        length[~np.isfinite(length)] = 0.0
        near = on[_near(run, east, north, on)]
        pieces[near] = np.clip(np.ceil(length[near] / STEP_M), 1, MOST_PIECES)
        owner = np.repeat(np.array(owners, np.intp), sizes)
        return cls(values, east, north, path_of, owner, pieces, length)

    def of_features(self, first: int, last: int) -> _Paths:
        """Return the paths of some features."""
        start, end = np.searchsorted(self.feature, [first, last])
        return _Paths(**{each.name: getattr(self, each.name)[start:end] for each in fields(self)})


def _near(run: RunSurface, east: Floats, north: Floats, on: NDArray[np.intp]) -> Bools:
    """Return which segments may lie on the run's tiles; ``on`` has their first vertices."""
    west, south, right, top = run.bounds
    inside = (np.fmax(east[on], east[on + 1]) >= west) & (np.fmin(east[on], east[on + 1]) <= right)
    inside &= (np.fmax(north[on], north[on + 1]) >= south) & (np.fmin(north[on], north[on + 1]) <= top)
    return np.asarray(inside)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Points along paths: their vertices and points between them."""

    values: Floats
    """``(n, 4)``, x, y, z, m; z and m are linear between the vertices."""
    east: Floats
    north: Floats
    along: Floats
    """``(n,)``, distance from the start of the group of paths (m)."""
    is_vertex: Bools
    path_starts: NDArray[np.intp]
    """Index of the first point of each path, and last the number of all points."""

    @classmethod
    def of(cls, paths: _Paths, run: RunSurface) -> _Samples:
        vertex = np.repeat(np.arange(len(paths.pieces)), paths.pieces)
        starts = np.cumsum(paths.pieces) - paths.pieces
        share = (np.arange(len(vertex)) - starts[vertex]) / paths.pieces[vertex]
        following = np.minimum(vertex + 1, len(paths.pieces) - 1)
        values = paths.values[vertex]
        between = share > 0
        values[between] += share[between, None] * (paths.values[following] - values)[between]
        east, north = paths.east[vertex], paths.north[vertex]
        if between.any():
            east[between], north[between] = run.to_run(values[between, 0], values[between, 1])
        before = np.cumsum(paths.length) - paths.length
        firsts = np.flatnonzero(np.diff(paths.path, prepend=-1))
        path_starts = np.append(starts[firsts], len(vertex))
        return cls(values, east, north, before[vertex] + share * paths.length[vertex], ~between, path_starts)

    def crossfalls(self, numbers: Numbers, run: RunSurface) -> Floats:
        """Return the crossfall at each point of a line, from points on both sides on the same level."""
        right, up = np.zeros(len(self.east)), np.zeros(len(self.east))
        for start, end in pairwise(self.path_starts.tolist()):
            if end - start > 1:
                right[start:end] = np.gradient(self.north[start:end])
                up[start:end] = -np.gradient(self.east[start:end])
        found, size = np.full(len(right), np.nan), np.hypot(right, up)
        usable = np.flatnonzero(np.isfinite(size) & (size > 0))
        right, up, numbers = right[usable] / size[usable], up[usable] / size[usable], numbers[usable]
        sides = []
        for across in (ACROSS_M, -ACROSS_M):
            heights = run.at(self.east[usable] + across * right, self.north[usable] + across * up)
            sides.append(of_levels(heights, numbers))
        found[usable] = np.abs(sides[0] - sides[1]) / (2 * ACROSS_M)
        return found


@dataclass(slots=True, eq=False)
class _Path:
    """A path among the points of a group."""

    start: int
    end: int
    code: int
    m: bool

    def of(self, values: Any) -> Any:
        """Return the path's part of values of all points."""
        return values[self.start : self.end]


@dataclass(frozen=True, eq=False)
class _Group:
    """Some features with the surface at the points along their paths."""

    samples: _Samples
    z: Floats
    """``(n,)``, heights of the points on the levels of their paths; NaN without ground."""
    numbers: Numbers
    """``(n,)``, numbers of the levels of the points."""
    flags: Bits
    """``(n,)``, flags of the surface at the points."""
    crossfalls: Floats | None
    errors: Floats | None
    options: Options


def _group(
    features: Sequence[Feature], paths: _Paths, run: RunSurface, options: Options
) -> Iterator[tuple[Shape | None, Lifted]]:
    samples = _Samples.of(paths, run)
    starts, first = samples.path_starts.tolist(), 0
    own = list[list[_Path]]()
    for feature in features:
        kinds = [(code, m) for code, _, m, _ in feature.shape.all_paths()] if feature.shape else []
        ends = pairwise(starts[first : first + len(kinds) + 1])
        own.append([_Path(start, end, *kind) for (start, end), kind in zip(ends, kinds, strict=True)])
        first += len(kinds)
    heights = run.at(samples.east, samples.north)
    z, numbers = _on_levels(heights, features, own)
    known = np.isfinite(z)
    errors = crossfalls = None
    if options.columns:
        errors = np.full(len(z), np.nan)
        errors[known] = run.errors(samples.east[known], samples.north[known], numbers[known])
    if options.columns or options.crossfall_limit is not None:
        crossfalls = samples.crossfalls(numbers, run)
    group = _Group(samples, z, numbers, heights.flags_on(numbers), crossfalls, errors, options)
    for feature, parts in zip(features, own, strict=True):
        if feature.shape is None or not parts:
            yield feature.shape and feature.shape.with_paths(iter(())), Lifted(feature.id)
        elif feature.shape.code == POINT:
            yield _point(feature.id, feature.shape, parts[0].start, group)
        else:
            yield _with_heights(feature, feature.shape, parts, group)


def _on_levels(
    heights: Heights, features: Sequence[Feature], paths: Sequence[Sequence[_Path]]
) -> tuple[Floats, Numbers]:
    """Return the heights of points along paths, on the level of each path, and the numbers of the levels."""
    z, numbers = heights.ground.copy(), np.zeros(heights.z.shape[1], np.int8)
    other = heights.several
    if not other.any():
        return z, numbers
    for feature, parts in zip(features, paths, strict=True):
        for path in parts:
            if not path.of(other).any():
                continue
            place = slice(path.start, path.end)
            own = heights[place]
            if path.code == POINT and feature.wanted == ANY:
                # Like flexroad query: the highest level.
                row = int(np.flatnonzero(np.isfinite(own.z[:, 0]))[-1])
                z[place], numbers[place] = own.z[row], own.numbers[row]
                continue
            z[place], numbers[place] = along(own, np.full(path.end - path.start, feature.wanted, np.int8))
            if path.code == POLYGON:
                # A ring ends where it begins.
                z[path.end - 1], numbers[path.end - 1] = z[path.start], numbers[path.start]
    return z, numbers


def _point(name: str, shape: Shape, at: int, group: _Group) -> tuple[Shape, Lifted]:
    """Return the result of `_with_heights` for a single point, faster: a file may have millions of points."""
    z = float(group.z[at])
    if not math.isfinite(z):
        return shape, Lifted(name, levels=(), points_without_ground=1)
    values = group.samples.values[at : at + 1].copy()
    before = abs(float(values[0, 2]) - z)
    values[0, 2] = z
    return Shape(POINT, True, shape.m, [values if shape.m else values[:, :3]]), Lifted(
        name,
        levels=(int(group.numbers[at]),),
        before_m=before,
        error_m=math.nan if group.errors is None else float(group.errors[at]),
        flags=int(group.flags[at]),
    )


def _with_heights(
    feature: Feature, shape: Shape, paths: list[_Path], group: _Group
) -> tuple[Shape | None, Lifted]:
    """Return the geometry of a feature with heights, and its row."""
    place = slice(paths[0].start, paths[-1].end)
    known = np.isfinite(group.z[place])
    if not known.any():
        along = group.samples.along
        length = sum(float(along[path.end - 1] - along[path.start]) for path in paths)
        points = sum(path.code == POINT for path in paths)
        of_lines = length if points < len(paths) else np.nan
        return shape, Lifted(feature.id, of_lines, length, (), points_without_ground=points)
    z = group.z[place]
    if group.options.beyond == "keep":
        z = np.where(known, z, group.samples.values[place, 2])
    z = filled(group.samples.along[place], z)
    new, kept = list[Floats](), list[NDArray[np.intp]]()
    for path in paths:
        profile = z[path.start - place.start : path.end - place.start]
        add = group.options.add_vertices is not False
        chosen = _line(path, group.samples).needed(profile, group.options.tolerance_m, add)
        values = path.of(group.samples.values)[chosen]
        values[:, 2] = profile[chosen]
        new.append(values if path.m else values[:, :3])
        kept.append(chosen)
    return shape.with_paths(iter(new)), _row(feature, paths, z, kept, group)


def _line(path: _Path, samples: _Samples) -> Line:
    x, y, *_ = path.of(samples.values).T
    return Line(x, y, path.of(samples.along), path.of(samples.is_vertex))


def _row(
    feature: Feature, paths: list[_Path], z: Floats, kept: list[NDArray[np.intp]], group: _Group
) -> Lifted:
    """Return the row of a feature with heights z at the points of its paths."""
    samples, options, place = group.samples, group.options, slice(paths[0].start, paths[-1].end)
    known, number = np.isfinite(group.z[place]), group.numbers[place]
    moved = np.abs(samples.values[place, 2] - z)[known & samples.is_vertex[place]]
    beyond = not known.all()
    missing = known & (number == 0) & (feature.wanted not in (ANY, 0))
    length, without, unknown, points, steep = 0.0, 0.0, 0.0, 0, list[Steep]()
    off, grade, crossfall, lines = [np.nan], [np.nan], [np.nan], False
    for path, chosen in zip(paths, kept, strict=True):
        own = slice(path.start - place.start, path.end - place.start)
        if path.code == POINT:
            points += int(not known[own][0])
            continue
        lines, s = True, path.of(samples.along)
        x, y = path.of(samples.values)[:, :2].T
        length += s[-1] - s[0]
        line = _line(path, samples)
        if beyond:
            without += line.length_where(~known[own])
        if missing.any():
            unknown += line.length_where(missing[own])
        off.append(largest(np.abs(np.interp(s, s[chosen], z[own][chosen]) - z[own])[known[own]]))
        slopes = np.abs(grades(s, np.where(known[own], z[own], np.nan), 0.999 * STEP_M))
        grade.append(largest(slopes))
        steep += steepest("grade", slopes, options.grade_limit, x, y)
        if group.crossfalls is not None and path.code != POLYGON:
            slopes = path.of(group.crossfalls)
            crossfall.append(largest(slopes))
            steep += steepest("crossfall", slopes, options.crossfall_limit, x, y)
    return Lifted(
        feature.id,
        float(length) if lines else np.nan,
        float(without),
        tuple(np.unique(number[known]).tolist()),
        float(unknown),
        largest(moved),
        largest(off),
        grade=largest(grade),
        crossfall=largest(crossfall),
        error_m=np.nan if group.errors is None else largest(group.errors[place]),
        points_without_ground=points,
        steep=tuple(steep),
        flags=passed(group.flags[place]),
    )


@compiled()
def grades(s: Floats, z: Floats, over: float) -> Floats:
    """Return the grade from each point of a line to the first point at least ``over`` metres further.

    NaN for the last points, and where a height is unknown. A shorter line has the grade between its ends.
    """
    found, end = np.full(len(s), np.nan), 0
    if s[-1] - s[0] < over:
        if s[-1] > s[0]:
            found[0] = (z[-1] - z[0]) / (s[-1] - s[0])
        return found
    for i in range(len(s)):
        # Distances between points are a little shorter than the largest allowed distance.
        while end < len(s) and s[end] - s[i] < over:
            end += 1
        if end == len(s):
            break
        found[i] = (z[end] - z[i]) / (s[end] - s[i])
    return found
