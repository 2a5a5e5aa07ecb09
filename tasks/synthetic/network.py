"""Where the streets and streams run: a gently bent lattice, turned against the raster.

Streets are pieces of lattice lines between two crossings. Everything is a function of the seed and of
absolute coordinates: each tile evaluates the part of the plan near it, and neighbours agree. Distances
are exact to second order in a line's curvature, whose radius is several blocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.strata import Stratum, named, stratum_at
from flexroad.tasks.types import Floats

Box = tuple[float, float, float, float]
"""Lowest x and y, highest x and y (m) in the plan's frame."""

BENDS = ((3.7, 0.06), (7.9, 0.14))
"""Wavelength and amplitude of a line's bends, in blocks."""
JITTER = 0.15
"""Greatest shift of a line from its place in the lattice, in blocks."""
MEDIAN_M = 1.5
"""Half width of the strip between two carriageways."""
MEDIAN_END_M = 10.0
"""From a crossing to the median's nose, and from there to its full width."""
OUT_OF_STEP = 0.6
"""Greatest phase difference (rad) of a line's bends from those all lines share: blocks stay blocks."""


@dataclass(frozen=True, eq=False)
class Line:
    """A lattice line: where it runs across, as a smooth function of where we are along it."""

    position: float
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
    """Axis, line and piece: the street's name for random generators."""
    line: Line
    start: float
    end: float
    half_width_m: float
    """Half of the carriageway."""
    stratum: Stratum
    cross_slope: float = 0.0
    """One-sided fall of the carriageway, on top of its crown."""
    median_m: float = 0.0
    """Half of the strip that parts the two carriageways; 0 where there is one."""

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
        """Return how far along the nearest point of the centre line is, and the distance to it (m)."""
        along, across = (y, x) if self.runs_along_y else (x, y)
        slope = self.line.slope(along)
        step = (across - self.line.across(along)) * slope / (1 + slope**2)
        foot = np.clip(along + step, self.start, self.end)
        return foot, np.hypot(across - self.line.across(foot), along - foot)

    def lateral(self, x: Floats, y: Floats, along: Floats) -> Floats:
        """Return the signed offset of points from their foot, across the street only (m).

        Beyond the street's ends it shrinks to 0 on the axis: no step where a dead end's sides meet.
        """
        across = x if self.runs_along_y else y
        offset: Floats = (across - self.line.across(along)) * np.sqrt(1 + self.line.slope(along) ** 2)
        return offset

    def strip(self, along: Floats) -> Floats:
        """Return half of the median's width (m); it ends before the crossings."""
        inside = np.minimum(along - self.start, self.end - along) - MEDIAN_END_M
        return self.median_m * np.clip(inside / MEDIAN_END_M, 0, 1)

    def point(self, along: Any, lateral: Any) -> tuple[Any, Any]:
        """Return x and y of points beside the centre line (``lateral`` m, to either side)."""
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

    banks: tuple[Line, Line]
    paved: bool = False
    """Whether it is a sunken road instead."""

    def distance(self, x: Floats, y: Floats) -> Floats:
        """Return the distance from the stream's axis (m)."""
        one, other = self.banks
        axis = (one.across(y) + other.across(y)) / 2
        away: Floats = np.abs(x - axis) / np.hypot(1, (one.slope(y) + other.slope(y)) / 2)
        return away


@dataclass(frozen=True)
class Plan:
    """The street plan of one world."""

    seed: int
    block_m: float
    """Mean distance of neighbouring lattice lines."""
    stream_share: float
    """Part of the gaps between lines with a stream."""
    stratum: str | None = None
    """The stratum of the whole world, or None for a mix of districts."""
    turn_deg: float | None = None
    """Direction of the lattice, or None for one of the seed."""
    sunken_share: float = 0.0
    """Part of the other gaps with a sunken road, which streets cross on bridges too."""
    cross_slope: float = 0.0
    """Greatest one-sided fall of a street."""
    medians: float = 0.0
    """Part of the main streets that are dual carriageways."""
    roundabouts: float = 0.0
    """Part of the crossings of two main streets that are roundabouts."""

    @cached_property
    def _turn(self) -> tuple[float, float]:
        drawn = generator(self.seed, "turn").uniform(np.pi / 12, np.pi * 5 / 12)
        angle = drawn if self.turn_deg is None else math.radians(self.turn_deg)
        return math.cos(angle), math.sin(angle)

    def from_map(self, easting: Any, northing: Any) -> tuple[Any, Any]:
        """Turn map coordinates into the plan's frame."""
        cos, sin = self._turn
        return cos * easting + sin * northing, cos * northing - sin * easting

    def to_map(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Turn the plan's frame into map coordinates."""
        cos, sin = self._turn
        return cos * x - sin * y, sin * x + cos * y

    def stratum_at(self, x: Any, y: Any) -> Stratum:
        """Return the stratum at one point."""
        return named(self.stratum) if self.stratum else stratum_at(self.seed, *self.to_map(x, y))

    def streets(self, box: Box) -> list[Street]:
        """Return the streets that touch the box."""
        columns, rows = self._reach(box[0], box[2]), self._reach(box[1], box[3])
        pieces = ((axis, i, j) for i in columns for j in rows for axis in (0, 1))
        found = (_street(self, axis, *((i, j) if axis == 0 else (j, i))) for axis, i, j in pieces)
        return [street for street in found if street is not None and _touch(street.box, box)]

    def streams(self, box: Box) -> Iterator[Stream]:
        """Yield the streams and sunken roads that may touch the box; they run along y."""
        for i in self._reach(box[0], box[2]):
            wet = generator(self.seed, "stream", i).random() < self.stream_share
            if wet or generator(self.seed, "sunken", i).random() < self.sunken_share:
                yield Stream((_line(self, 0, i), _line(self, 0, i + 1)), paved=not wet)

    def circles(self, box: Box, margin_m: float) -> Iterator[tuple[float, float]]:
        """Yield the centres of the roundabouts in the box grown by a margin; only main streets meet there."""
        for i in self._reach(box[0], box[2]):
            for j in self._reach(box[1], box[3]):
                if i % 2 or j % 2 or generator(self.seed, "circle", i, j).random() >= self.roundabouts:
                    continue
                x, y = _crossing(self, i, j)
                grown = (box[0] - margin_m, box[1] - margin_m, box[2] + margin_m, box[3] + margin_m)
                if _touch((x, y, x, y), grown):
                    yield x, y

    def _reach(self, low: float, high: float) -> range:
        """Return the indices of lines whose bends may bring them between two coordinates."""
        return range(math.floor(low / self.block_m) - 2, math.ceil(high / self.block_m) + 2)


def _touch(a: Box, b: Box) -> bool:
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]


@lru_cache(maxsize=4096)
def _line(plan: Plan, axis: int, index: int) -> Line:
    lengths, amplitudes = np.array(BENDS).T * plan.block_m
    shared = generator(plan.seed, "bends", axis).uniform(0, 2 * np.pi, lengths.size)
    rng = generator(plan.seed, "line", axis, index)
    position = (index + rng.uniform(-JITTER, JITTER)) * plan.block_m
    phases = shared + rng.uniform(-OUT_OF_STEP, OUT_OF_STEP, lengths.size)
    return Line(position, 2 * np.pi / lengths, phases, amplitudes)


@lru_cache(maxsize=4096)
def _crossing(plan: Plan, column: int, row: int) -> tuple[float, float]:
    """Where two lines meet: a fixed point, as the slopes' product is far below one."""
    upright, level = _line(plan, 0, column), _line(plan, 1, row)
    x, y = upright.position, level.position
    for _ in range(12):
        x, y = float(upright.across(y)), float(level.across(x))
    return x, y


@lru_cache(maxsize=4096)
def _street(plan: Plan, axis: int, line: int, piece: int) -> Street | None:
    """Piece ``piece`` of a line, up to the next crossing line, or None if it was not built.

    Lines of even number are main streets; one end of every side street is therefore at a main one.
    """
    ends = [_crossing(plan, *((line, p) if axis == 0 else (p, line))) for p in (piece, piece + 1)]
    stratum = plan.stratum_at(*np.mean(ends, axis=0))
    rng = generator(plan.seed, "street", axis, line, piece)
    is_main = line % 2 == 0
    if rng.random() > stratum.side_streets and not is_main:
        return None
    # Drawn per line, not per piece: a street keeps its width across a crossing.
    wide = generator(plan.seed, "width", axis, line).random()
    low, high = stratum.main_width_m if is_main else stratum.side_width_m
    width = low + wide * (high - low)
    along = 1 - axis
    key = (axis, line, piece)
    lean = plan.cross_slope * generator(plan.seed, "lean", axis, line).uniform(-1, 1)
    parted = is_main and generator(plan.seed, "median", axis, line).random() < plan.medians
    return Street(
        key,
        _line(plan, axis, line),
        ends[0][along],
        ends[1][along],
        width / 2 + parted * MEDIAN_M,
        stratum,
        lean,
        parted * MEDIAN_M,
    )
