"""Differences between the rasters of a survey and the true ground, besides noise and objects.

These are changes between two surveys (new road surfaces, new kerbs, excavations), and low vegetation that a
scan does not penetrate. Others are mixed cells at edges and walls, errors of a terrain model under houses,
and cells without a height:

- ground hidden by crowns. The survey sees a crown from one image, so the ground at its far side is hidden.
  More ground is hidden if the crown is nearer to the image's edge;
- water: it gives no echo, and two images of it have no common features.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.special import ndtri

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.network import Stream, Street
from flexroad.tools.synthetic.objects import Crown, GroundAt, House, Roof, from_middle
from flexroad.tools.synthetic.population import Area, Objects
from flexroad.tools.synthetic.spoilers import Canvas, covered
from flexroad.tools.synthetic.surfaces import BED_M
from flexroad.tools.synthetic.world import SceneOptions, field, generator

KINDS = ("surface", "kerb", "excavation")
LENGTH_M = {"surface": (30.0, 100.0), "kerb": (8.0, 30.0), "excavation": (4.0, 20.0)}
RISE_M = {"surface": (0.02, 0.06), "kerb": (0.10, 0.15), "excavation": (-2.0, -0.6)}
PAVEMENT_M = 2.2
"""Width of a new kerb on the carriageway's edge (m)."""
TRENCH_M = (1.5, 4.0)
"""Width of an excavation (m)."""
BESIDE_M = 3.0
"""Greatest distance of an excavation's middle from the carriageway (m)."""
WALL_M = 1.5
"""Least height step between neighbouring cells at a wall (m)."""
THICKET_M = (6.0, 60.0)
"""Shortest and longest wave of the thickets (m)."""
CLEAR_M = 1.5
"""Width of the strip beside a carriageway without vegetation (m)."""
RIM_M = 1.5
"""Distance beyond the walls within which the ground was removed with the house (m)."""
TILT = 0.5
"""Tilt of a scar, as a fraction of its depth."""
SPREAD = 0.5
"""Greatest relative deviation of the length of a crown's hidden ground: crowns differ in density."""
WOBBLE_M = (5.0, 40.0)
"""Shortest and longest wave of the offset of the mask's edges (m)."""
STRETCH_M = (20.0, 120.0)
"""Shortest and longest wave of the fields for places where the mask reaches beyond the carriageway (m)."""
SOLID = 0.8
"""Radius of the dense part of a crown, which hides the ground, as a fraction of the crown's radius."""
FACADE_REACH_M = 8.0
"""Greatest distance from the carriageway of a facade that is mistaken for road (m)."""


@dataclass(frozen=True)
class _Change:
    """A stretch of a street whose height changed; lengths in m along and across the centre line."""

    street: Street
    start: float
    end: float
    left: float
    right: float
    rise: float
    """Height of the later survey over the earlier one."""


def changes(streets: Sequence[Street], seed: int, mean: float) -> tuple[_Change, ...]:
    """Return the changes of streets, ``mean`` per street on average."""
    found = list[_Change]()
    for street in streets if mean > 0 else ():
        rng = generator(seed, "works", *street.key)
        found += [_drawn(street, str(rng.choice(KINDS)), rng) for _ in range(rng.poisson(mean))]
    return tuple(found)


def _drawn(street: Street, kind: str, rng: np.random.Generator) -> _Change:
    half, side = street.half_width_m, rng.choice((-1, 1))
    length, rise = rng.uniform(*LENGTH_M[kind]), rng.uniform(*RISE_M[kind])
    start = rng.uniform(street.start, max(street.end - length, street.start))
    if kind == "surface":
        left, right = -half, half
    elif kind == "kerb":
        left, right = sorted((side * (half - PAVEMENT_M), side * half))
    else:
        middle, width = rng.uniform(-1, 1) * (half + BESIDE_M), rng.uniform(*TRENCH_M)
        left, right = middle - width / 2, middle + width / 2
    return _Change(street, start, min(start + length, street.end), left, right, rise)


def rise(found: Sequence[_Change], x: Floats, y: Floats) -> Floats:
    """Return the height of the later survey's ground above the earlier at points in the plan's frame (m)."""
    total = np.zeros(np.shape(x))
    for change in found:
        along, _ = change.street.foot(x, y)
        lateral = change.street.lateral(x, y, along)
        inside = (along >= change.start) & (along <= change.end)
        inside &= (lateral >= change.left) & (lateral <= change.right)
        # Beyond a street's ends the foot stays at the end.
        inside &= (along > change.street.start) & (along < change.street.end)
        total[inside] = change.rise
    return total


def mixed(dsm: Floats, truth: Floats, share: float, rng: np.random.Generator) -> tuple[Floats, Bools]:
    """Return the surface model with a fraction of the cells at walls mixed (m), and the mask of those cells.

    A mixed cell is never below the true ground.
    """
    low, high = minimum_filter(dsm, 3), maximum_filter(dsm, 3)
    chosen = (high - low > WALL_M) & (rng.random(dsm.shape) < share)
    between = np.maximum(low + rng.random(dsm.shape) * (high - low), truth)
    return np.where(chosen, between, dsm), chosen


def growth(
    seed: int, x: Floats, y: Floats, edge: Floats, height_m: float, rng: np.random.Generator
) -> Floats:
    """Return the height of low vegetation, ``(H, W)``, m; 0 without vegetation.

    - `x`, `y`, `edge`: coordinates in the plan's frame, and distance to the nearest carriageway (m).
    - `height_m`: mean height inside a thicket (m).
    - `rng`: draws the height of each cell relative to the mean.
    """
    thick = field(seed, "thickets", THICKET_M, 18)(x, y)
    covered: Bools = (thick > 0) & (edge > CLEAR_M)
    # A skewed distribution of mean 1: most cells are lower than the mean, a few are far higher.
    ragged: Floats = rng.gamma(2.0, 0.5, x.shape)
    return np.where(covered, height_m * np.minimum(thick, 1) * ragged, 0.0)


def scars(canvas: Canvas, houses: Sequence[House], seed: int, depth_m: float) -> Floats:
    """Return the error of the terrain model under houses, ``(H, W)``, m; 0 elsewhere.

    The error under a house is a tilted plane, as from interpolation across a hole.
    """
    error = np.zeros(canvas.x.shape)
    for house in houses if depth_m > 0 else ():
        window = canvas.around(house.x, house.y, float(np.hypot(house.half_length, house.half_depth)) + RIM_M)
        u, v = canvas.local(window, house.x, house.y, house.heading)
        inside = (np.abs(u) <= house.half_length + RIM_M) & (np.abs(v) <= house.half_depth + RIM_M)
        level, tilt = generator(seed, "scar", int(house.x // 1), int(house.y // 1)).normal(0, depth_m, 2)
        plane = level + TILT * tilt * u / house.half_length
        error[window] = np.where(inside, plane, error[window])
    return error


def hidden(canvas: Canvas, dsm: Floats, crowns: Sequence[Crown], seed: int, length: float) -> Bools:
    """Return the cells hidden by crowns, ``(H, W)``: beside a crown, and below the middle of its height.

    - `length`: mean length of the hidden ground at the edge of an image, per height of the crown.
    """
    found = np.zeros(dsm.shape, np.bool_)
    if length <= 0 or not crowns:
        return found
    x, y = (np.array([getattr(crown, axis) for crown in crowns]) for axis in ("x", "y"))
    for crown, away in zip(crowns, from_middle(seed, x, y).T, strict=True):
        rng = generator(seed, "hidden", int(crown.x // 1), int(crown.y // 1))
        east, north = away * length * crown.height * rng.uniform(1 - SPREAD, 1 + SPREAD)
        window = canvas.around(crown.x, crown.y, crown.radius + float(np.hypot(east, north)))
        dx, dy = canvas.x[window] - crown.x, canvas.y[window] - crown.y
        # The crown moved along its shift: the nearest of its middles to each cell.
        part = np.clip((dx * east + dy * north) / (east**2 + north**2), 0, 1)
        covered = np.hypot(dx - part * east, dy - part * north) < crown.radius
        beside = np.hypot(dx, dy) > crown.radius
        found[window] |= covered & beside & (dsm[window] < crown.top - crown.height / 2)
    return found


def water(canvas: Canvas, streams: Iterable[Stream]) -> Bools:
    """Return the cells in the beds of streams, ``(H, W)``, also those below bridges."""
    wet = np.zeros(canvas.x.shape, np.bool_)
    for stream in streams:
        if not stream.paved:
            wet |= stream.distance(canvas.x, canvas.y) < BED_M
    return wet


def segmentation(
    canvas: Canvas, edge: Floats, objects: Objects, ground_at: GroundAt, options: SceneOptions
) -> Bools:
    """Return the road mask with the errors of a segmentation, ``(H, W)``.

    - `edge`: distance of the cells to the nearest carriageway's edge, negative on the road (m).
    - `objects`: crowns hide the road; spots, and some areas, roofs and facades, are classified wrongly.
    - `ground_at`: returns the ground at points, for patches.
    - `options`: sizes of the errors; ``mask_errors`` 0 gives a perfect mask.
    """
    if not options.patch_m or not options.mask_errors:
        return _classified(canvas, edge, objects, options)
    patches = Canvas.of(_patches(canvas.grid, options.patch_m), canvas.plan)
    mask = _classified(patches, ground_at(patches.x, patches.y).edge, objects, options)
    # The mask is resampled to the cells by nearest neighbour, as in the paper.
    return mask[patches.grid.cells(*np.meshgrid(canvas.grid.eastings, canvas.grid.northings))]


def _patches(grid: Grid, side: float) -> Grid:
    """Return the lattice of patches that covers a grid; it is the same for all grids."""
    west, south, east, north = grid.bounds
    west, south = (math.floor(bound / side) * side for bound in (west, south))
    east, north = (math.ceil(bound / side) * side for bound in (east, north))
    return Grid(grid.crs, west, north, side, round((east - west) / side), round((north - south) / side))


def _classified(canvas: Canvas, edge: Floats, objects: Objects, options: SceneOptions) -> Bools:
    """Return the mask at the points of a canvas, ``(H, W)``."""
    scale = options.mask_errors
    error = scale * field(canvas.plan.seed, "wobble", WOBBLE_M, 12, options.wobble_m)(canvas.x, canvas.y)
    verge = np.where(_stretches(canvas, "verge", options.verge_share), options.verge_m, 0.0)
    mask: Bools = edge + error <= scale * verge
    if scale > 0:
        mask |= _stretches(canvas, "open ground", options.open_ground)
        _add(mask, canvas, objects.yards, error)
    for crown in objects.crowns:
        if crown.hides:
            window, inside = _disc(canvas, crown.x, crown.y, SOLID * crown.radius * scale, error)
            mask[window][inside] = False
        if objects.roofs:
            # Under most crowns the road is inferred, but beyond the carriageway every crown is seen.
            window, inside = _disc(canvas, crown.x, crown.y, crown.radius * scale, error)
            mask[window][inside & (edge[window] > 0)] = False
    for spot in objects.spots:
        window, inside = _disc(canvas, spot.x, spot.y, spot.radius * scale, error)
        mask[window][inside] = spot.road
    if scale > 0:
        _add(mask, canvas, (*objects.car_parks, *objects.fields), error)
        for roof in objects.roofs:
            _show(roof, mask, canvas, edge, options.overhang_m)
        _add(mask, canvas, objects.false_roofs, error)
    return mask


def _disc(
    canvas: Canvas, x: float, y: float, radius: float, error: Floats
) -> tuple[tuple[slice, slice], Bools]:
    """Return the window and the cells of a disc whose edge is shifted by ``error`` (m)."""
    window = canvas.around(x, y, radius + 2)
    away = np.hypot(canvas.x[window] - x, canvas.y[window] - y)
    return window, away + error[window] < radius


def _stretches(canvas: Canvas, purpose: str, share: float) -> Bools:
    """Return coherent areas that cover a fraction of the plane, ``(H, W)``."""
    if share <= 0:
        return np.zeros(canvas.x.shape, np.bool_)
    inside: Bools = field(canvas.plan.seed, purpose, STRETCH_M, 15)(canvas.x, canvas.y) < ndtri(share)
    return inside


def _add(mask: Bools, canvas: Canvas, areas: Iterable[Area], error: Floats) -> None:
    """Add the areas that are wrongly classified as road, in place."""
    for area in areas:
        if area.as_road:
            window, inside = covered(canvas, area, error)
            mask[window][inside] = True


def _show(roof: Roof, mask: Bools, canvas: Canvas, edge: Floats, overhang_m: float) -> None:
    """Remove cells that a roof hides in the photograph, and add its visible facades, in place."""
    house, (east, north) = roof.house, roof.shift
    reach = math.hypot(house.half_length, house.half_depth) + overhang_m + math.hypot(east, north)
    window = canvas.around(house.x, house.y, reach)
    size = house.half_length + overhang_m, house.half_depth + overhang_m
    stands, seen = (
        (np.abs(u) <= size[0]) & (np.abs(v) <= size[1])
        for u, v in (
            canvas.local(window, house.x + dx, house.y + dy, house.heading)
            for dx, dy in ((0.0, 0.0), (east, north))
        )
    )
    mask[window][seen | stands] = False
    if roof.facade_as_road:
        mask[window][stands & ~seen & (edge[window] <= FACADE_REACH_M)] = True
