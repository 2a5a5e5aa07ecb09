"""A scene: the rasters of a survey for one tile, the true ground and roads, and centre lines."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.points.binning import Points, bins
from flexroad.tools.synthetic.network import Box, Plan, Stream, Street
from flexroad.tools.synthetic.objects import GroundAt
from flexroad.tools.synthetic.population import Objects, populate
from flexroad.tools.synthetic.spoilers import BARE, Canvas, Kind, surface_model
from flexroad.tools.synthetic.surfaces import (
    CIRCLE_M,
    ISLAND_M,
    REACH_M,
    SUNKEN_M,
    Ground,
    ground,
    relief,
)
from flexroad.tools.synthetic.survey_errors import (
    changes,
    growth,
    hidden,
    mixed,
    rise,
    scars,
    segmentation,
    water,
)
from flexroad.tools.synthetic.world import DEFAULTS, SceneOptions, field, generator

OBJECT_REACH_M = 45.0
"""Greatest distance of a house, crown, car or patch from its street's centre line (m)."""
DTM_BLUR_M = 1.0
"""Standard deviation of the Gaussian that models the DTM's smoothing by interpolation (m)."""
DTM_GRAIN_M = 3.0
"""Correlation length of the DTM's noise (m)."""
FLIGHT_WAVES_M = (300.0, 1500.0)
"""Shortest and longest wave of the offset between two surveys (m)."""
GROUND, DECK, OTHER = 2, 17, 1
"""Classes by ASPRS LAS 1.4; all other points are unclassified."""
DECK_M = 0.5
"""The true surface is a deck where it is this much above the terrain model (m)."""
STEP_M = 5.0
"""Distance between the points of a centre line (m)."""
MARGIN_M = 50.0
"""Centre lines within this distance around the grid are included (m)."""
MAIN, SIDE, SUNKEN = "secondary", "residential", "primary"


@dataclass(frozen=True, eq=False)
class Scene:
    """One tile of a synthetic world."""

    grid: Grid
    stratum: str
    dsm: Floats
    """Surface model with houses, crowns, cars and noise, ``(H, W)``, m; NaN where unknown."""
    dtm: Floats
    """Terrain model without bridges, smoothed and noisy, ``(H, W)``, m."""
    road_mask: Bools
    """Road with the errors of a segmentation, ``(H, W)``."""
    reference: Floats
    """True height of road and terrain with bridges at the time of the DSM, ``(H, W)``, m."""
    extended_dtm: Floats
    """The DTM with the bridges' decks: the paper's reference, ``(H, W)``, m."""
    reference_road: Bools
    """True road, ``(H, W)``."""
    kind: NDArray[np.uint8]
    """Kind of the object in the surface model, a `Kind` per cell, ``(H, W)``."""
    levels: Mapping[int, Floats] = dataclasses.field(default_factory=dict)
    """True height of each level, ``(H, W)``, m; NaN outside of it. Only from `tools.synthetic.crossings`."""

    @property
    def layers(self) -> Mapping[str, NDArray[np.generic]]:
        """The rasters, by the catalog's layer names."""
        return {
            "dsm": self.dsm,
            "dtm": self.dtm,
            "road_mask": self.road_mask,
            "reference": self.reference,
            "reference_road": self.reference_road,
        }


def make_scene(grid: Grid, seed: int, stratum: str | None = None, options: SceneOptions = DEFAULTS) -> Scene:
    """Make one tile of the world of a seed.

    Ground, streets, objects and errors of the mask are functions of seed and absolute coordinates, so tiles
    of one seed join without a step. The noise of the heights is drawn per tile.

    - `stratum`: stratum of the complete world: ``urban``, ``suburban`` or ``rural``; by default a mix of
      districts.
    """
    if seed < 0:
        raise TaskError(f"a seed is 0 or more, not {seed}")
    plan = plan_of(seed, stratum, options)
    # A margin prevents edge effects of the smoothed terrain model on the tile.
    wide = grid.buffered(4 * DTM_BLUR_M)
    canvas, inner = Canvas.of(wide, plan), wide.window(grid)
    ground_at = _ground_near(canvas, options)
    here = ground_at(canvas.x, canvas.y)
    truth = _truth(canvas, here, options)
    streets = plan.streets(_box(canvas, OBJECT_REACH_M))
    farther = plan.streets(_box(canvas, 2 * OBJECT_REACH_M))
    objects = populate(streets, farther, seed, ground_at, options)
    rng = generator(seed, "survey", *map(int, grid.origin))
    dsm, kind = _survey(canvas, here, truth, objects, options, rng)
    offset = field(seed, "flights", FLIGHT_WAVES_M, 5, options.flight_offset_m)(canvas.x, canvas.y)
    west, south, east, north = wide.bounds
    centre = plan.from_map((west + east) / 2, (south + north) / 2)
    bare = here.bare + scars(canvas, objects.houses, seed, options.scars_m) + offset
    dtm = terrain_model(bare, wide.cell, options.dtm_noise_m, rng)
    return Scene(
        grid=grid,
        stratum=plan.stratum_at(*centre).name,
        dsm=dsm[inner],
        dtm=dtm[inner],
        road_mask=segmentation(canvas, here.edge, objects, ground_at, options)[inner],
        reference=truth[inner],
        extended_dtm=np.where(here.deck, here.graded + offset, dtm)[inner],
        reference_road=here.road[inner],
        kind=kind[inner],
    )


def true_height(grid: Grid, seed: int, stratum: str | None, options: SceneOptions) -> Floats:
    """Return ``reference`` of the scene that `make_scene` gives for these arguments, ``(H, W)``, m."""
    wide = grid.buffered(4 * DTM_BLUR_M)
    canvas = Canvas.of(wide, plan_of(seed, stratum, options))
    here = _ground_near(canvas, options)(canvas.x, canvas.y)
    return _truth(canvas, here, options)[wide.window(grid)]


def plan_of(seed: int, stratum: str | None, options: SceneOptions) -> Plan:
    """Return the street plan of a world."""
    return Plan(
        seed,
        options.block_m,
        options.stream_share,
        stratum,
        options.turn_deg,
        options.sunken_share,
        options.cross_slope,
        options.medians,
        options.roundabouts,
    )


def _truth(canvas: Canvas, here: Ground, options: SceneOptions) -> Floats:
    """Return the true height at the time of the DSM, ``(H, W)``, m; the DTM is from an earlier time."""
    found = changes(canvas.plan.streets(_box(canvas, OBJECT_REACH_M)), canvas.plan.seed, options.works)
    if not found:
        return here.height
    return np.where(here.deck, here.height, here.height + rise(found, canvas.x, canvas.y))


def _survey(
    canvas: Canvas,
    here: Ground,
    truth: Floats,
    objects: Objects,
    options: SceneOptions,
    rng: np.random.Generator,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the surface model with noise (m) and the `Kind` of each cell."""
    dsm, kind = surface_model(canvas, truth, here.deck, objects, options.overhang_m, rng)
    dsm += rng.uniform(*options.dsm_noise_m) * rng.standard_normal(dsm.shape)
    if options.growth_m > 0:
        seed = canvas.plan.seed
        height = options.density * growth(seed, canvas.x, canvas.y, here.edge, options.growth_m, rng)
        overgrown = (kind == Kind.GROUND) & (height > 0)
        dsm[overgrown] += height[overgrown]
        kind[overgrown] = Kind.PLANTS
    if options.mixed > 0:
        dsm, chosen = mixed(dsm, truth, options.mixed, rng)
        kind[chosen & np.isin(kind, BARE) & (dsm > truth)] = Kind.MIXED
    if options.voids > 0:
        without = water(canvas, canvas.plan.streams(_box(canvas, 0))) & ~here.deck
        without |= hidden(canvas, dsm, objects.crowns, canvas.plan.seed, options.voids)
        dsm[without] = np.nan
    return dsm, kind


def _ground_near(canvas: Canvas, options: SceneOptions) -> GroundAt:
    """Return the function that gives the ground at points on the canvas and near it."""
    plan = canvas.plan
    land = relief(plan.seed, options.slope, options.roughness_m, options.datum_m, options.embankment_m)
    # Objects may lie beyond the tile, and the streets around them even farther away.
    box = _box(canvas, 2 * OBJECT_REACH_M)
    circles = tuple(plan.circles(box, CIRCLE_M + REACH_M))
    return partial(ground, land, plan.streets(box), tuple(plan.streams(box)), circles, options.curb_m)


def terrain_model(bare: Floats, cell: float, noise_m: float, rng: np.random.Generator) -> Floats:
    """Return the bare ground, smoothed and with correlated noise, as interpolated from ground points."""
    grain = gaussian_filter(rng.standard_normal(bare.shape), DTM_GRAIN_M / cell)
    # A Gaussian of sigma cells reduces the deviation of white noise to 1 / (2 sigma sqrt(pi)).
    gain = max(2 * np.sqrt(np.pi) * DTM_GRAIN_M / cell, 1.0)
    smooth: Floats = gaussian_filter(bare, DTM_BLUR_M / cell, mode="nearest") + noise_m * gain * grain
    return smooth


def _box(canvas: Canvas, margin_m: float) -> Box:
    """Return the plan's box around a canvas."""
    x, y = canvas.x, canvas.y
    return (
        float(x.min()) - margin_m,
        float(y.min()) - margin_m,
        float(x.max()) + margin_m,
        float(y.max()) + margin_m,
    )


def scan(scene: Scene, per_m2: float, noise_m: float, seed: int = 0) -> Points:
    """Return points on a scene's surface, at random positions.

    A height is the true ground, linear between cell centres, plus the height of the object on the point's
    cell.

    - `scene`: a scene without noise (`SceneOptions.dsm_noise_m`).
    """
    grid, rng = scene.grid, generator(seed, "scan", *map(int, scene.grid.origin))
    west, south, east, north = grid.bounds
    number = round(per_m2 * (east - west) * (north - south))
    easting, northing = rng.uniform(west, east, number), rng.uniform(south, north, number)
    at = (north - northing) / grid.cell - 0.5, (easting - west) / grid.cell - 0.5
    ground = map_coordinates(scene.reference, at, order=1, mode="nearest")
    cells = bins(easting, northing, grid)
    bare = np.isin(scene.kind, BARE)
    above = np.where(bare, 0.0, scene.dsm - scene.reference).ravel()[cells]
    deck = bare & (scene.reference - scene.dtm > DECK_M)
    kind = np.where(deck, DECK, np.where(bare, GROUND, OTHER)).astype(np.uint8).ravel()[cells]
    return Points(easting, northing, ground + above + noise_m * rng.standard_normal(number), kind)


@dataclass(frozen=True, eq=False)
class CentreLine:
    """The centre line of one carriageway."""

    points: Floats
    """``(n, 2)``: easting and northing (m)."""
    width_m: float
    highway: str
    """Class: a value of OSM's ``highway`` key."""
    level: int = 0
    """Number of the level: above 0 on a deck, below 0 in a tunnel."""


def centre_lines(
    grid: Grid, seed: int, stratum: str | None = None, options: SceneOptions = DEFAULTS
) -> list[CentreLine]:
    """Return the centre lines on and around a grid, in the world of `make_scene` with the same arguments.

    A dual carriageway has two lines. The ends of medians and the islands of roundabouts are not represented.
    """
    plan = plan_of(seed, stratum, options)
    west, south, east, north = grid.buffered(MARGIN_M).bounds
    x, y = plan.from_map(np.array([west, west, east, east]), np.array([south, north, south, north]))
    box = (float(x.min()), float(y.min()), float(x.max()), float(y.max()))
    lines = [line for street in plan.streets(box) for line in _carriageways(plan, street)]
    lines += [_sunken(plan, stream, box[1], box[3]) for stream in plan.streams(box) if stream.paved]
    return lines + [_circle(plan, *centre) for centre in plan.circles(box, 0)]


def _carriageways(plan: Plan, street: Street) -> Iterator[CentreLine]:
    along = _steps(street.start, street.end)
    beside, width = (street.half_width_m + street.median_m) / 2, street.half_width_m - street.median_m
    highway = SIDE if street.key[1] % 2 else MAIN
    if not street.median_m:
        yield CentreLine(_on_map(plan, *street.point(along, 0.0)), 2 * width, highway)
        return
    for side in (-beside, beside):
        yield CentreLine(_on_map(plan, *street.point(along, side)), width, highway)


def _sunken(plan: Plan, stream: Stream, low: float, high: float) -> CentreLine:
    left, right = stream.banks
    y = _steps(low, high)
    return CentreLine(_on_map(plan, (left.across(y) + right.across(y)) / 2, y), 2 * SUNKEN_M, SUNKEN)


def _circle(plan: Plan, x: float, y: float) -> CentreLine:
    turn, radius = np.linspace(0, 2 * np.pi, 33), (CIRCLE_M + ISLAND_M) / 2
    turn[-1] = 0
    ring = _on_map(plan, x + radius * np.cos(turn), y + radius * np.sin(turn))
    return CentreLine(ring, CIRCLE_M - ISLAND_M, MAIN)


def _steps(start: float, end: float) -> Floats:
    return np.linspace(start, end, max(2, round((end - start) / STEP_M) + 1))


def _on_map(plan: Plan, x: Floats, y: Floats) -> Floats:
    return np.column_stack(plan.to_map(x, y))
