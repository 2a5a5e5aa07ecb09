"""Common types of the formats: the surface of a run for a file, options, and the rows of the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds
from flexroad.catalog.crs import in_plan, short
from flexroad.catalog.errors import CatalogError
from flexroad.pipeline.config.options import METHOD, OUTPUTS, option
from flexroad.pipeline.run.sampler import Heights, RunSampler, required_crs, to_crs
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

HeightsAt = Callable[[Floats, Floats], Heights]
"""Heights at x and y, ``(n,)`` each, in the coordinates of the file."""
NEAR_M = 5.0
"""Consecutive points that are closer than this belong to one line (m); lines have a point every metre."""
NO_POINTS = np.zeros(0), np.zeros(0)
"""Points of a part that needs no heights, for `with_heights`."""
POINTS = 500_000
"""Number of points of a batch: about 200 MB with their heights and their parts."""
T = TypeVar("T")


@dataclass(frozen=True)
class Frame:
    """The coordinate system of a file: its coordinates are turned, then ``x``, ``y`` and ``z`` are added."""

    crs: str | None
    """Any text that PROJ reads; None if the file names no CRS."""
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    turn: float = 0.0
    """Radians, counter-clockwise."""


@dataclass(eq=False)
class _Seen:
    """What is known of the points looked up for a file."""

    known: int = 0
    """Number of points with a height."""
    bounds: Floats = field(default_factory=lambda: np.array([np.inf, np.inf, -np.inf, -np.inf]))
    """Bounds of all points, in the CRS of the run."""
    earlier: set[str] = field(default_factory=set)
    tile_step_m: float = 0.0
    """Largest step between tiles on its lines."""


@dataclass(frozen=True, eq=False)
class RunSurface:
    """The surface of a run at coordinates of a file, or of one of its layers."""

    ground: RunSampler
    crs: str
    place: Frame
    steps: bool
    given: bool
    """Whether the user gave the CRS."""
    seen: _Seen = field(default_factory=_Seen)

    def in_crs(self, crs: str | None, layer: str) -> RunSurface:
        """Return the surface for a layer with its own CRS; a CRS given by the user has priority."""
        if self.given:
            return self
        if crs is None:
            raise TaskError(
                f"has the layer {layer} without a CRS; give it with --crs, such as --crs EPSG:25832"
            )
        return replace(self, crs=plan_crs(crs))

    @cached_property
    def run_crs(self) -> str:
        """The CRS of the run."""
        return required_crs(self.ground)

    @cached_property
    def bounds(self) -> Bounds:
        """West, south, east and north of the tiles of the run (m, in its CRS)."""
        tiles = np.array([tile.grid.bounds for tile in self.ground.run.catalog.usable])
        west, south = tiles[:, :2].min(axis=0).tolist()
        east, north = tiles[:, 2:].max(axis=0).tolist()
        return west, south, east, north

    def to_run(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return easting and northing (m) in the CRS of the run."""
        place, x, y = self.place, np.asarray(x), np.asarray(y)
        ahead, left = math.cos(place.turn), math.sin(place.turn)
        with np.errstate(invalid="ignore"):
            east, north = x * ahead - y * left + place.x, x * left + y * ahead + place.y
        return to_crs(east, north, self.crs, self.run_crs)

    def __call__(self, x: Floats, y: Floats) -> Heights:
        """Return heights of all levels at coordinates of the file; NaN without a surface."""
        return self.at(*self.to_run(x, y))

    def at(self, easting: Floats, northing: Floats) -> Heights:
        """Return heights of all levels at points in the CRS of the run."""
        found, earlier = self.ground.heights(easting, northing, self.steps)
        found = replace(found, z=found.z - self.place.z)
        seen = self.seen
        seen.earlier.update(earlier)
        step = self.ground.largest_tile_step(easting, northing, NEAR_M)
        seen.tile_step_m = max(seen.tile_step_m, step)
        seen.known += int(np.isfinite(found.z).any(axis=0).sum())
        inside = np.isfinite(easting) & np.isfinite(northing)
        if inside.any():
            part = np.array([[values.min(), values.max()] for values in (easting[inside], northing[inside])])
            seen.bounds[:2] = np.minimum(seen.bounds[:2], part[:, 0])
            seen.bounds[2:] = np.maximum(seen.bounds[2:], part[:, 1])
        return found

    def errors(self, easting: Floats, northing: Floats, numbers: NDArray[np.int8]) -> Floats:
        """Return the estimated errors (m) at points on levels, in the CRS of the run."""
        return self.ground.errors(easting, northing, numbers)[0]

    def require_heights(self) -> None:
        """Raise an error if no point has had a height."""
        if self.seen.known:
            return
        if not np.isfinite(self.seen.bounds).all():
            raise TaskError("has no road or feature with coordinates")
        raise TaskError(
            f"does not lie on the finished tiles: it lies in {_box(self.seen.bounds)}, they in "
            f"{_box(self.bounds)} ({short(self.run_crs)}); correct its CRS with --crs and --offset"
        )


def _box(bounds: Sequence[float] | Floats) -> str:
    west, south, east, north = bounds
    return f"W {west:.0f} S {south:.0f} E {east:.0f} N {north:.0f}"


def plan_crs(crs: str) -> str:
    """Return the horizontal part of the CRS of a file."""
    try:
        return in_plan(crs)
    except CatalogError as error:
        raise TaskError(f"has a CRS that PROJ does not read: {error}; give another CRS with --crs") from error


@dataclass(frozen=True)
class Options:
    """Options of heights for files."""

    tolerance_m: float = option(
        0.005, METHOD, "Largest distance of profiles and lines from the surface (m).", "METRES", min=0.0001
    )
    lateral: Literal["superelevation", "none"] = option(
        "superelevation", METHOD, "Cross-section of OpenDRIVE roads."
    )
    beyond: Literal["keep", "flat"] = option(
        "keep", METHOD, "Heights where the run has no surface: unchanged, or level from there on."
    )
    add_vertices: bool | None = option(
        None,
        METHOD,
        "Add vertices where lines leave the surface; default: yes, but not to OSM files.",
        name="vertices/--no-vertices",
    )
    columns: bool = option(
        False,
        OUTPUTS,
        "Add the columns grade_max_percent, crossfall_max_percent and error_estimate_m to features.",
    )
    grade_limit: float | None = option(
        None, OUTPUTS, "Write places with a steeper grade as points beside the report.", "PERCENT", min=0
    )
    """In m/m; the command takes percent."""
    crossfall_limit: float | None = option(
        None, OUTPUTS, "Write places with a steeper crossfall as points beside the report.", "PERCENT", min=0
    )
    """In m/m; the command takes percent."""


@dataclass(frozen=True, slots=True)
class Steep:
    """A place above a limit."""

    kind: Literal["grade", "crossfall"]
    value: float
    """Its grade or crossfall (m/m)."""
    x: float
    """Place in the coordinates of the file."""
    y: float


@dataclass(frozen=True, slots=True)
class Lifted:
    """One road or feature of a file: a row of the report. Lengths and heights in m, grades in m/m.

    NaN where a figure is unknown, or the format does not have it.
    """

    id: str
    length_m: float = np.nan
    without_ground_m: float = 0.0
    """Length where the run has no surface."""
    levels: tuple[int, ...] = (0,)
    """Numbers of the levels from which its heights are."""
    unknown_deck_m: float = 0.0
    """Length on bridges and in tunnels whose level the run does not have."""
    before_m: float = np.nan
    """Largest distance of its old heights from the surface."""
    elevation_m: float = np.nan
    """Largest distance of its carriageway from the surface, with the elevation only."""
    superelevation_m: float = np.nan
    """The same with the superelevation."""
    grade: float = np.nan
    """Largest grade."""
    crossfall: float = np.nan
    """Largest crossfall."""
    error_m: float = np.nan
    """Largest estimated error of the surface."""
    steep: tuple[Steep, ...] = ()
    note: str = ""
    points_without_ground: int = 0
    """Number of points where the run has no surface."""
    flags: int = 0
    """Flags of the surface along it (`tasks.quality.flagged.flag_names`)."""


def with_heights(
    parts: Iterable[T], points: Callable[[T], tuple[Floats, Floats]], heights: HeightsAt
) -> Iterator[tuple[T, Heights]]:
    """Yield the parts in order, with the heights of their points. Each tile is read once per batch of points.

    - `points`: returns x and y of the points of a part, ``(n,)`` each.
    """
    batch, size = list[tuple[T, Floats, Floats]](), 0
    for part in parts:
        batch.append((part, *points(part)))
        size += 1 + len(batch[-1][1])
        if size >= POINTS:
            yield from _answered(batch, heights)
            batch, size = [], 0
    if batch:
        yield from _answered(batch, heights)


def _answered(batch: list[tuple[T, Floats, Floats]], heights: HeightsAt) -> Iterator[tuple[T, Heights]]:
    parts, x, y = zip(*batch, strict=True)
    found, start = heights(np.concatenate(x), np.concatenate(y)), 0
    for part, own in zip(parts, x, strict=True):
        yield part, found[start : start + len(own)]
        start += len(own)
