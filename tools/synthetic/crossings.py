"""Scenes of a main road that crosses other roads on decks and in tunnels, with the true height of each level.

The main road is straight, along x in the plan's frame. Every `SPACING_M` another road crosses it. Level 0 is
the ground with its roads, also below decks; level 1 is on decks, level -1 in tunnels. Everything is a
function of seed and absolute coordinates, so tiles join.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Bounds, Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.network import Plan
from flexroad.tools.synthetic.objects import Car, Crown
from flexroad.tools.synthetic.population import Objects
from flexroad.tools.synthetic.scene import DTM_BLUR_M, MAIN, MARGIN_M, SIDE, CentreLine, Scene, terrain_model
from flexroad.tools.synthetic.spoilers import Canvas, surface_model
from flexroad.tools.synthetic.surfaces import CROSSFALL, Relief, relief, smoothstep
from flexroad.tools.synthetic.world import SOUTH_M, WEST_M, generator

SPACING_M = 200.0
"""Distance between the crossings of the main road (m)."""
MAIN_M, CROSS_M = 4.0, 3.5
"""Half widths of the carriageways (m)."""
DECK_M, CREST_M = 5.0, 5.5
"""Half widths of a deck and of an embankment's crest (m)."""
TROUGH_M = 4.5
"""Half width of the main road's cutting at a tunnel, between its walls (m)."""
REACH_M = 90.0
"""Length of a crossing road on either side of the main road (m)."""
RAMP_M, LEVEL_M = 70.0, 12.0
"""Length of a crossing road's ramps, and of half of the level piece between them (m)."""
SHARE = 0.6
"""The main road rises or dips by this fraction of the clearance, the crossing road by the rest."""
SLOPE, WALL = 1 / 1.5, 20.0
"""Slope of embankments and of walls (m per m)."""
VERGE_M, BLEND_M = 1.5, 9.0
"""Strip beside a crossing road at its height, and width over which it blends into the terrain (m)."""
BESIDE_M = 6.5
"""Distance from the axis of a deck to the ground from which the DTM below it is interpolated (m)."""
RAIL_M, RAIL_OFFSET_M = 1.0, 4.75
"""Height of a parapet over its deck, and its distance from the axis (m)."""
TREES = 24
"""Trees per crossing, before trees on roads and banks are left out."""


class CrossingOptions(Options):
    """Shapes of the crossings, drawn from the seed, and errors of the survey."""

    clearance_m: tuple[float, float] = Field(
        (5.5, 8.0), description="least and greatest height of the upper over the lower road (m)"
    )
    skew_deg: tuple[float, float] = Field(
        (0.0, 35.0), description="least and greatest difference of the roads' angle from a right angle"
    )
    wall_m: tuple[float, float] = Field(
        (1.0, 4.0), description="least and greatest distance from the crossing road's edge to an abutment (m)"
    )
    slopes: float = Field(
        0.5, ge=0, le=1, description="fraction of the decks that end on slopes instead of walls"
    )
    tunnels: float = Field(
        0.25,
        ge=0,
        le=1,
        description="fraction of the crossings at which the main road lies below, in a tunnel",
    )
    density: float = Field(1.0, ge=0, le=1, description="fraction of cars, trees and parapets that exist")
    dsm_noise_m: float = Field(0.04, ge=0, description="noise of the DSM (standard deviation, m)")
    dtm_noise_m: float = Field(0.04, ge=0, description="noise of the DTM (standard deviation, m)")
    datum_m: float = Field(100.0, ge=-400, le=8000, description="mean height of the world (m)")


DEFAULTS = CrossingOptions()


@dataclass(frozen=True)
class _Crossing:
    """One crossing: positions along the main road, lengths in m."""

    number: int
    skew: float
    """Difference of the crossing road's angle from a right angle (rad)."""
    clearance_m: float
    wall_m: float
    slopes: bool
    tunnel: bool

    @property
    def along(self) -> float:
        """Position of its centre along the main road (m)."""
        return self.number * SPACING_M

    @property
    def level(self) -> int:
        """Level of the main road at the crossing."""
        return -1 if self.tunnel else 1

    @property
    def half_length_m(self) -> float:
        """Half length of the deck or tunnel."""
        bank = self.clearance_m / SLOPE if self.slopes and not self.tunnel else 0.0
        corner = (TROUGH_M if self.tunnel else DECK_M) * abs(math.sin(self.skew))
        return (CROSS_M + self.wall_m + bank + corner) / math.cos(self.skew)

    def across(self, s: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Return coordinates along and across the crossing road (m)."""
        sin, cos = math.sin(self.skew), math.cos(self.skew)
        return (s - self.along) * sin + v * cos, (s - self.along) * cos - v * sin

    def rise(self, s: Floats) -> Floats:
        """Return the height of the main road above the hills (m), at positions along it."""
        ramp = SPACING_M / 2 - self.half_length_m - 5
        away = np.maximum(np.abs(s - self.along) - self.half_length_m, 0)
        return self.level * SHARE * self.clearance_m * smoothstep(1 - away / ramp)

    def dip(self, t: Floats) -> Floats:
        """Return the depth of the crossing road below the hills (m), at positions along it."""
        away = np.maximum(np.abs(t) - LEVEL_M, 0)
        return self.level * (1 - SHARE) * self.clearance_m * smoothstep(1 - away / RAMP_M)


@dataclass(frozen=True)
class Crossings:
    """The world of a seed; heights and roads in map coordinates."""

    seed: int
    options: CrossingOptions = DEFAULTS

    @cached_property
    def plan(self) -> Plan:
        """The frame: x is along the main road."""
        turn = float(generator(self.seed, "main road").uniform(10, 40))
        return Plan(self.seed, SPACING_M, 0.0, "rural", turn)

    def height(self, level: int, easting: Floats, northing: Floats) -> Floats:
        """Return the true height of a level (m) at points; NaN outside of it. Level 0 is everywhere."""
        s, v = self._along(easting, northing)
        z = np.full(np.shape(s), np.nan)
        for crossing, near in self._near(s):
            if level == 0:
                z[near] = self._ground(crossing, s[near], v[near])
            elif level == crossing.level:
                z[near] = np.where(
                    _inside(crossing, s[near], v[near]), self._main(crossing, s, v)[near], np.nan
                )
        return z

    def areas(self, level: int, bounds: Bounds) -> NDArray[np.object_]:
        """Return the decks or tunnels of a level near some bounds, as polygons, ``(n,)``."""
        half = DECK_M if level > 0 else MAIN_M
        lines = [
            self._line(c, -c.half_length_m, c.half_length_m) for c in self._at(bounds) if c.level == level
        ]
        strips: NDArray[np.object_] = shapely.buffer(
            np.array([shapely.LineString(line) for line in lines], object), half, cap_style="flat"
        )
        return strips

    def roads(self, bounds: Bounds) -> list[CentreLine]:
        """Return the roads near some bounds; the main road is cut at the ends of decks and tunnels."""
        lines = list[CentreLine]()
        for crossing in self._at(bounds):
            half, end = crossing.half_length_m, SPACING_M / 2
            for low, high, level in ((-end, -half, 0), (-half, half, crossing.level), (half, end, 0)):
                lines.append(CentreLine(self._line(crossing, low, high), 2 * MAIN_M, MAIN, level))
            t = np.array([-REACH_M, REACH_M])
            line = self._on_map(crossing.along + t * math.sin(crossing.skew), t * math.cos(crossing.skew))
            lines.append(CentreLine(line, 2 * CROSS_M, SIDE))
        return lines

    def road(self, easting: Floats, northing: Floats) -> Bools:
        """Return which points lie on a road that is visible from above."""
        s, v = self._along(easting, northing)
        road = np.abs(v) <= MAIN_M
        for crossing, near in self._near(s):
            inside, (t, u) = _inside(crossing, s, v), crossing.across(s, v)
            cross = (np.abs(u) <= CROSS_M) & (np.abs(t) <= REACH_M)
            here = (road & ~inside) | cross if crossing.tunnel else road | (cross & ~inside)
            road = np.where(near, here, road)
        return road

    def terrain_model(self, easting: Floats, northing: Floats) -> Floats:
        """Return the ground of a DTM (m): below decks linear between the ground on both sides."""
        s, v = self._along(easting, northing)
        z = self.height(0, easting, northing)
        for crossing, near in self._near(s):
            hidden = near & (np.abs(v) < BESIDE_M) & (np.abs(s - crossing.along) < crossing.half_length_m + 1)
            if not crossing.tunnel and hidden.any():
                at, share = s[hidden], (v[hidden] + BESIDE_M) / (2 * BESIDE_M)
                right, left = (
                    self._ground(crossing, at, np.full(at.shape, side)) for side in (-BESIDE_M, BESIDE_M)
                )
                z[hidden] = right + share * (left - right)
        return z

    def objects(self, bounds: Bounds) -> Objects:
        """Return cars, trees and parapets near some bounds."""
        cars, crowns, rails = list[Car](), list[Crown](), [np.zeros((3, 0))]
        for crossing in self._at(bounds):
            rng = generator(self.seed, "crossing objects", crossing.number)
            cars += self._cars(crossing, rng)
            crowns += self._crowns(crossing, rng)
            if not crossing.tunnel and self.options.density > 0:
                rails.append(self._rails(crossing))
        traces = np.concatenate(rails, axis=1)
        return Objects((), tuple(crowns), tuple(cars), (), (), (), (), traces, np.zeros((3, 0)))

    @cached_property
    def _origin(self) -> tuple[float, float]:
        """The centre of crossing 0 in the plan's frame: 30 to 50 m from the corner of a block of tiles."""
        east, north = generator(self.seed, "first crossing").uniform(30, 50, 2)
        x, y = self.plan.from_map(WEST_M + east, SOUTH_M + north)
        return float(x), float(y)

    @cached_property
    def _land(self) -> Relief:
        return relief(self.seed, 0.02, 0.15, self.options.datum_m)

    def _crossing(self, number: int) -> _Crossing:
        rng, options = generator(self.seed, "crossing", number), self.options
        skew = math.radians(rng.uniform(*options.skew_deg)) * rng.choice((-1, 1))
        clearance, wall, slopes = (
            rng.uniform(*options.clearance_m),
            rng.uniform(*options.wall_m),
            rng.random(),
        )
        tunnel = math.floor((number + 1) * options.tunnels) > math.floor(number * options.tunnels)
        return _Crossing(number, float(skew), float(clearance), float(wall), slopes < options.slopes, tunnel)

    def _along(self, easting: Floats, northing: Floats) -> tuple[Floats, Floats]:
        """Return coordinates along and across the main road (m)."""
        x, y = self.plan.from_map(np.asarray(easting, float), np.asarray(northing, float))
        return x - self._origin[0], y - self._origin[1]

    def _near(self, s: Floats) -> Iterator[tuple[_Crossing, Bools]]:
        """Yield each crossing with the points that are nearest to it along the main road."""
        number = np.rint(s / SPACING_M).astype(np.int64)
        for k in np.unique(number):
            yield self._crossing(int(k)), number == k

    def _at(self, bounds: Bounds) -> list[_Crossing]:
        """Return the crossings that may reach within `MARGIN_M` of some bounds."""
        west, south, east, north = bounds
        s, v = self._along(np.array([west, west, east, east]), np.array([south, north, south, north]))
        reach = REACH_M + MARGIN_M
        if v.min() > reach or v.max() < -reach:
            return []
        low, high = round((s.min() - MARGIN_M) / SPACING_M), round((s.max() + MARGIN_M) / SPACING_M)
        return [self._crossing(k) for k in range(low, high + 1)]

    def _hills(self, s: Floats, v: Floats) -> Floats:
        return self._land.large(s + self._origin[0], v + self._origin[1]) + self._land.datum_m

    def _main(self, crossing: _Crossing, s: Floats, v: Floats) -> Floats:
        """Return the height of the main road, continued level beyond its edges (m)."""
        fall = CROSSFALL * np.hypot(np.clip(v, -MAIN_M, MAIN_M), 0.5)
        return self._hills(s, np.zeros_like(v)) + crossing.rise(s) - fall

    def _cross(self, crossing: _Crossing, t: Floats, u: Floats) -> Floats:
        """Return the height of the crossing road, continued level beyond its edges and ends (m)."""
        t = np.clip(t, -REACH_M, REACH_M)
        on_s = crossing.along + t * math.sin(crossing.skew)
        fall = CROSSFALL * np.hypot(np.clip(u, -CROSS_M, CROSS_M), 0.5)
        return self._hills(on_s, t * math.cos(crossing.skew)) - crossing.dip(t) - fall

    def _ground(self, crossing: _Crossing, s: Floats, v: Floats) -> Floats:
        """Return the height of level 0 at points that are nearest to a crossing (m)."""
        t, u = crossing.across(s, v)
        terrain = self._hills(s, v) + self._land.small(s + self._origin[0], v + self._origin[1])
        low = self._cross(crossing, t, u)
        beyond = np.hypot(np.maximum(np.abs(u) - CROSS_M, 0), np.maximum(np.abs(t) - REACH_M, 0))
        weight = 1 - smoothstep((beyond - VERGE_M) / BLEND_M)
        z = terrain * (1 - weight) + low * weight
        inside = crossing.half_length_m - np.abs(s - crossing.along)
        top, aside = self._main(crossing, s, v), np.abs(v)
        if crossing.tunnel:
            cut = top + WALL * np.maximum(aside - TROUGH_M, 0)
            return np.where(inside > 0, z, np.maximum(np.minimum(z, cut), _embankment(top, aside)))
        z = np.where(inside > 0, z, np.minimum(z, top + SLOPE * np.maximum(aside - CREST_M, 0)))
        bank, free = _embankment(top, aside), np.abs(u) - CROSS_M - crossing.wall_m
        if crossing.slopes:
            cut = np.minimum(bank - SLOPE * np.maximum(inside, 0), low + SLOPE * np.maximum(free, 0))
        else:
            cut = np.where((inside > 0) | (free < 0), -np.inf, bank)
        bank = np.where((inside <= 0) & (aside <= CREST_M), bank, cut)
        return np.maximum(z, bank)

    def _line(self, crossing: _Crossing, low: float, high: float) -> Floats:
        """Return the ends of a piece of the main road, ``(2, 2)``, by distances from the crossing (m)."""
        return self._on_map(crossing.along + np.array([low, high]), np.zeros(2))

    def _on_map(self, s: Floats, v: Floats) -> Floats:
        return np.column_stack(self.plan.to_map(s + self._origin[0], v + self._origin[1]))

    def _cars(self, crossing: _Crossing, rng: np.random.Generator) -> Iterator[Car]:
        """Yield cars on both roads, none below a deck or in a tunnel."""
        for main, reach in ((True, SPACING_M / 2), (False, REACH_M)):
            for along in np.arange(4 - reach, reach - 4, 23.0) + rng.uniform(0, 10):
                lane, exists = 1.8 * rng.choice((-1, 1)), rng.random() < self.options.density
                sin, cos = (1.0, 0.0) if main else (math.sin(crossing.skew), math.cos(crossing.skew))
                s, v = crossing.along + along * sin + lane * cos, along * cos - lane * sin
                hidden = _inside(crossing, np.array([s]), np.array([v]), 4.0)[0] and main == crossing.tunnel
                if exists and not hidden:
                    x, y = s + self._origin[0], v + self._origin[1]
                    yield Car(float(x), float(y), math.atan2(cos, sin), 2.2, 0.9, 1.5, moving=False)

    def _crowns(self, crossing: _Crossing, rng: np.random.Generator) -> Iterator[Crown]:
        """Yield trees away from roads, banks and cuttings."""
        for _ in range(TREES):
            s, v = crossing.along + rng.uniform(-0.5, 0.5) * SPACING_M, rng.uniform(-REACH_M, REACH_M)
            radius, height, exists = rng.uniform(2, 4), rng.uniform(5, 9), rng.random() < self.options.density
            at = np.array([s]), np.array([v])
            beside = abs(crossing.across(*at)[1][0]) - CROSS_M
            if exists and abs(v) > 18 + radius and beside > 2 + radius:
                x, y = s + self._origin[0], v + self._origin[1]
                top = float(self._ground(crossing, *at)[0]) + height
                yield Crown(float(x), float(y), float(radius), top, float(height), hides=False)

    def _rails(self, crossing: _Crossing) -> Floats:
        """Return x, y and height of points along both parapets of a deck, ``(3, n)``."""
        along = crossing.along + np.arange(-crossing.half_length_m, crossing.half_length_m, 0.25)
        s, v = np.tile(along, 2), np.repeat([-RAIL_OFFSET_M, RAIL_OFFSET_M], along.size)
        return np.stack([s + self._origin[0], v + self._origin[1], self._main(crossing, s, v) + RAIL_M])


def _inside(crossing: _Crossing, s: Floats, v: Floats, margin_m: float = 0.0) -> Bools:
    """Return which points, given along and across the main road, are on a deck or in a tunnel."""
    half = (MAIN_M if crossing.tunnel else DECK_M) + margin_m
    return (np.abs(s - crossing.along) <= crossing.half_length_m + margin_m) & (np.abs(v) <= half)


def _embankment(top: Floats, aside: Floats) -> Floats:
    """Return the surface of an embankment whose crest has the height ``top`` (m)."""
    return top - SLOPE * np.maximum(aside - CREST_M, 0)


def make_crossings(grid: Grid, seed: int, options: CrossingOptions = DEFAULTS) -> Scene:
    """Make one tile of the world of a seed, like `scene.make_scene`; the mask is the visible road."""
    if seed < 0:
        raise TaskError(f"a seed is 0 or more, not {seed}")
    world = Crossings(seed, options)
    wide = grid.buffered(4 * DTM_BLUR_M)
    canvas, inner = Canvas.of(wide, world.plan), wide.window(grid)
    at = np.meshgrid(wide.eastings, wide.northings)
    levels = {level: world.height(level, *at) for level in (0, 1, -1)}
    deck = np.isfinite(levels[1])
    truth, road = np.where(deck, levels[1], levels[0]), world.road(*at)[inner]
    rng = generator(seed, "survey", *map(int, grid.origin))
    dsm, kind = surface_model(canvas, truth, deck, world.objects(wide.bounds), 0.0, rng)
    dsm += options.dsm_noise_m * rng.standard_normal(dsm.shape)
    dtm = terrain_model(world.terrain_model(*at), wide.cell, options.dtm_noise_m, rng)
    return Scene(
        grid=grid,
        stratum="crossings",
        dsm=dsm[inner],
        dtm=dtm[inner],
        road_mask=road,
        reference=truth[inner],
        extended_dtm=np.where(deck, truth, dtm)[inner],
        reference_road=road,
        kind=kind[inner],
        levels={
            level: heights[inner] for level, heights in levels.items() if np.isfinite(heights[inner]).any()
        },
    )
