"""Plan of the streets and streams: a lattice of slightly curved lines, rotated against the raster.

Streets are pieces of lattice lines between two crossings. Everything is a function of seed and absolute
coordinates: each tile evaluates the part of the plan near it, and neighbours agree. Distances are exact to
second order in a line's curvature; the radius of curvature is several blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.synthetic.world import generator

Box = tuple[float, float, float, float]
"""Lowest x and y, highest x and y in the plan's frame (m)."""

BENDS = ((3.7, 0.06), (7.9, 0.14))
"""Wavelength and amplitude of a line's bends, in blocks."""
JITTER = 0.15
"""Greatest shift of a line from its position in the lattice, in blocks."""
MEDIAN_M = 1.5
"""Half width of the strip between two carriageways (m)."""
MEDIAN_END_M = 10.0
"""Distance from a crossing to the end of the median, and from there to its full width (m)."""
PHASE_SPREAD = 0.6
"""Greatest phase difference (rad) of a line's bends from the common phase; lines stay roughly parallel."""
Range = tuple[float, float]

DISTRICT_M = 250
"""Side of a district, a square of one stratum (m): a tile of the usual size lies in one."""


@dataclass(frozen=True)
class _Stratum:
    """Density of buildings, traffic and vegetation in an area."""

    name: str
    share: float
    """Fraction of the districts."""
    side_streets: float
    """Fraction of the possible side streets that exist; main streets always exist."""
    main_width_m: Range
    side_width_m: Range
    lot_m: Range
    """Street front of a lot (m)."""
    built: float
    """Fraction of the lots with a house."""
    gap_m: Range
    """Gap between neighbouring houses (m); 0 for terraced houses."""
    setback_m: Range
    """Distance from the carriageway's edge to the facade (m)."""
    depth_m: Range
    eaves_m: Range
    """Height of the eaves over the ground (m)."""
    flat_roofs: float
    """Fraction of the houses with a flat roof."""
    parked: float
    """Fraction of the parking slots with a car."""
    moving: float
    """Moving cars per street."""
    avenues: float
    """Fraction of the street sides with a row of trees."""
    garden_trees: float
    """Trees per street away from the kerb."""


STRATA = {
    stratum.name: stratum
    for stratum in (
        _Stratum("urban", 0.7, 0.85, (12, 16), (8, 11), (13, 22), 0.88, (0, 0), (1.2, 4), (10, 13), (9, 19),
                0.35, 0.5, 1.5, 0.5, 8),
        _Stratum("suburban", 0.1, 0.7, (9, 12), (6.5, 8), (17, 24), 0.85, (5, 10), (4, 8), (9, 12), (4, 7),
                0.1, 0.25, 0.6, 0.35, 12),
        _Stratum("rural", 0.2, 0.2, (8, 11), (5, 6.5), (25, 45), 0.2, (8, 20), (5, 14), (9, 16), (3.5, 7),
                0.05, 0.02, 0.4, 0.4, 6),
    )
}  # fmt: skip
"""Strata by name; the fractions are from the paper's 168, 23 and 49 tiles."""


def find_stratum(name: str) -> _Stratum:
    """Return the stratum with a name."""
    if name not in STRATA:
        raise TaskError(f"no stratum {name!r}; there are {', '.join(STRATA)}")
    return STRATA[name]


def stratum_at(seed: int, easting: float, northing: float) -> _Stratum:
    """Return the stratum of the district at a point."""
    key = math.floor(easting / DISTRICT_M), math.floor(northing / DISTRICT_M)
    shares = np.cumsum([stratum.share for stratum in STRATA.values()])
    index = int(np.searchsorted(shares, generator(seed, "stratum", *key).random(), side="right"))
    return list(STRATA.values())[min(index, len(STRATA) - 1)]


@dataclass(frozen=True, eq=False)
class _Line:
    """A lattice line: its coordinate across as a smooth function of the coordinate along it."""

    position: float
    """Mean coordinate across (m)."""
    wavenumbers: Floats
    phases: Floats
    amplitudes: Floats

    def across(self, along: Any) -> Any:
        """Return the coordinate across the line's axis (m)."""
        angle = np.multiply.outer(along, self.wavenumbers) + self.phases
        return self.position + np.sin(angle) @ self.amplitudes

    def slope(self, along: Any) -> Any:
        """Return the derivative of `across`."""
        angle = np.multiply.outer(along, self.wavenumbers) + self.phases
        return np.cos(angle) @ (self.wavenumbers * self.amplitudes)


@dataclass(frozen=True, eq=False)
class Street:
    """One street between two crossings."""

    key: tuple[int, int, int]
    """Axis, line and piece: the key of the street's random generators."""
    line: _Line
    start: float
    end: float
    half_width_m: float
    """Half width of the street, median included (m)."""
    stratum: _Stratum
    cross_slope: float = 0.0
    """One-sided slope of the carriageway, added to its crossfall."""
    median_m: float = 0.0
    """Half width of the strip between two carriageways (m); 0 if there is one carriageway."""

    @property
    def runs_along_y(self) -> bool:
        """Whether the line gives x as a function of y; else y as a function of x."""
        return self.key[0] == 0

    @cached_property
    def box(self) -> Box:
        """The centre line's bounding box."""
        across = self.line.across(np.linspace(self.start, self.end, 9))
        low, high = float(across.min()), float(across.max())
        return (low, self.start, high, self.end) if self.runs_along_y else (self.start, low, self.end, high)

    def foot(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the coordinate along the line of its nearest point, and the distance to it (m)."""
        along, across = (y, x) if self.runs_along_y else (x, y)
        slope = self.line.slope(along)
        step = (across - self.line.across(along)) * slope / (1 + slope**2)
        foot = np.clip(along + step, self.start, self.end)
        return foot, np.hypot(across - self.line.across(foot), along - foot)

    def lateral(self, x: Floats, y: Floats, along: Floats) -> Floats:
        """Return the signed offset of points from the centre line, across the street only (m).

        Beyond the street's ends it is 0 on the axis, so a dead end has no step between its sides.
        """
        across = x if self.runs_along_y else y
        offset: Floats = (across - self.line.across(along)) * np.sqrt(1 + self.line.slope(along) ** 2)
        return offset

    def strip(self, along: Floats) -> Floats:
        """Return half of the width of the median strip (m); 0 near the crossings."""
        inside = np.minimum(along - self.start, self.end - along) - MEDIAN_END_M
        return self.median_m * np.clip(inside / MEDIAN_END_M, 0, 1)

    def point(self, along: Any, lateral: Any) -> tuple[Any, Any]:
        """Return x and y of points ``lateral`` m beside the centre line; the sign is the side."""
        slope = self.line.slope(along)
        length = np.sqrt(1 + slope**2)
        across = self.line.across(along) + lateral / length
        along = along - lateral * slope / length
        return (across, along) if self.runs_along_y else (along, across)

    def heading(self, along: Any) -> Any:
        """Return the direction of the centre line (rad from x towards y)."""
        angle = np.arctan(self.line.slope(along))
        return np.pi / 2 - angle if self.runs_along_y else angle


@dataclass(frozen=True, eq=False)
class Stream:
    """A watercourse half-way between two neighbouring lines."""

    banks: tuple[_Line, _Line]
    paved: bool = False
    """Whether it is a sunken road, not a stream."""

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Return the distance from the stream's axis (m)."""
        left, right = self.banks
        axis = (left.across(y) + right.across(y)) / 2
        distance: Floats = np.abs(x - axis) / np.hypot(1, (left.slope(y) + right.slope(y)) / 2)
        return distance


@dataclass(frozen=True)
class Plan:
    """The street plan of one world."""

    seed: int
    block_m: float
    """Mean distance of neighbouring lattice lines (m)."""
    stream_share: float
    """Fraction of the gaps between lines with a stream."""
    stratum: str | None = None
    """The stratum of the complete world, or None for a mix of districts."""
    turn_deg: float | None = None
    """Direction of the lattice (degrees); None if drawn from the seed."""
    sunken_share: float = 0.0
    """Fraction of the other gaps with a sunken road; streets cross it on bridges."""
    cross_slope: float = 0.0
    """Greatest one-sided slope of a street."""
    medians: float = 0.0
    """Fraction of the main streets that are dual carriageways."""
    roundabouts: float = 0.0
    """Fraction of the crossings of two main streets that are roundabouts."""

    @cached_property
    def _turn(self) -> tuple[float, float]:
        drawn = generator(self.seed, "turn").uniform(np.pi / 12, np.pi * 5 / 12)
        angle = drawn if self.turn_deg is None else math.radians(self.turn_deg)
        return math.cos(angle), math.sin(angle)

    def from_map(self, easting: Any, northing: Any) -> tuple[Any, Any]:
        """Return map coordinates in the plan's frame."""
        cos, sin = self._turn
        return cos * easting + sin * northing, cos * northing - sin * easting

    def to_map(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return coordinates of the plan's frame in map coordinates."""
        cos, sin = self._turn
        return cos * x - sin * y, sin * x + cos * y

    def stratum_at(self, x: Any, y: Any) -> _Stratum:
        """Return the stratum at one point."""
        return find_stratum(self.stratum) if self.stratum else stratum_at(self.seed, *self.to_map(x, y))

    def streets(self, box: Box) -> list[Street]:
        """Return the streets that touch the box."""
        columns, rows = self._reach(box[0], box[2]), self._reach(box[1], box[3])
        pieces = ((axis, i, j) for i in columns for j in rows for axis in (0, 1))
        streets = (_street(self, axis, *((i, j) if axis == 0 else (j, i))) for axis, i, j in pieces)
        return [street for street in streets if street is not None and _touch(street.box, box)]

    def streams(self, box: Box) -> Iterator[Stream]:
        """Yield the streams and sunken roads that may touch the box; they run along y."""
        for i in self._reach(box[0], box[2]):
            wet = generator(self.seed, "stream", i).random() < self.stream_share
            if wet or generator(self.seed, "sunken", i).random() < self.sunken_share:
                yield Stream((_line(self, 0, i), _line(self, 0, i + 1)), paved=not wet)

    def circles(self, box: Box, margin_m: float) -> Iterator[tuple[float, float]]:
        """Yield the centres of the roundabouts in the box plus a margin; only main streets meet there."""
        for i in self._reach(box[0], box[2]):
            for j in self._reach(box[1], box[3]):
                if i % 2 or j % 2 or generator(self.seed, "circle", i, j).random() >= self.roundabouts:
                    continue
                x, y = _crossing(self, i, j)
                grown = (box[0] - margin_m, box[1] - margin_m, box[2] + margin_m, box[3] + margin_m)
                if _touch((x, y, x, y), grown):
                    yield x, y

    def _reach(self, low: float, high: float) -> range:
        """Return the indices of the lines that may lie between two coordinates."""
        return range(math.floor(low / self.block_m) - 2, math.ceil(high / self.block_m) + 2)


def _touch(a: Box, b: Box) -> bool:
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]


@lru_cache(maxsize=4096)
def _line(plan: Plan, axis: int, index: int) -> _Line:
    lengths, amplitudes = np.array(BENDS).T * plan.block_m
    shared = generator(plan.seed, "bends", axis).uniform(0, 2 * np.pi, lengths.size)
    rng = generator(plan.seed, "line", axis, index)
    position = (index + rng.uniform(-JITTER, JITTER)) * plan.block_m
    phases = shared + rng.uniform(-PHASE_SPREAD, PHASE_SPREAD, lengths.size)
    return _Line(position, 2 * np.pi / lengths, phases, amplitudes)


@lru_cache(maxsize=4096)
def _crossing(plan: Plan, column: int, row: int) -> tuple[float, float]:
    """Return the point where two lines meet, by fixed-point iteration (the slopes are small)."""
    upright, level = _line(plan, 0, column), _line(plan, 1, row)
    x, y = upright.position, level.position
    for _ in range(12):
        x, y = float(upright.across(y)), float(level.across(x))
    return x, y


@lru_cache(maxsize=4096)
def _street(plan: Plan, axis: int, line: int, piece: int) -> Street | None:
    """Return piece ``piece`` of a line, up to the next crossing line; None without a street.

    Lines of even number are main streets, so one end of every side street lies on a main street.
    """
    ends = [_crossing(plan, *((line, p) if axis == 0 else (p, line))) for p in (piece, piece + 1)]
    stratum = plan.stratum_at(*np.mean(ends, axis=0))
    rng = generator(plan.seed, "street", axis, line, piece)
    is_main = line % 2 == 0
    if rng.random() > stratum.side_streets and not is_main:
        return None
    # Drawn per line, not per piece: a street keeps its width across a crossing.
    fraction = generator(plan.seed, "width", axis, line).random()
    low, high = stratum.main_width_m if is_main else stratum.side_width_m
    width = low + fraction * (high - low)
    along = 1 - axis
    key = (axis, line, piece)
    cross_slope = plan.cross_slope * generator(plan.seed, "lean", axis, line).uniform(-1, 1)
    dual = is_main and generator(plan.seed, "median", axis, line).random() < plan.medians
    return Street(
        key,
        _line(plan, axis, line),
        ends[0][along],
        ends[1][along],
        width / 2 + dual * MEDIAN_M,
        stratum,
        cross_slope,
        dual * MEDIAN_M,
    )
