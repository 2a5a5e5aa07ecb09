"""Houses, towers, trees and cars along a street, roofs in an orthophoto, and round errors of the road mask.

Each street has its own random generator, so an object across a tile border is the same object in both
tiles. Lengths are in metres, headings in rad, positions in the plan's frame.

An orthophoto is corrected with the terrain model, so objects on the terrain lean outwards in it. The picture
shows the facade where the surface model has the side of the roof near the image's middle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.network import Street
from flexroad.tools.synthetic.surfaces import Ground
from flexroad.tools.synthetic.world import generator

GroundAt = Callable[[Floats, Floats], Ground]
"""x and y in the plan's frame -> the ground at these points."""

CORNER_M = 8.0
"""Length at both ends of a street without parked cars and street trees (m)."""
HIDING = 0.4
"""Fraction of the crowns that hide the road from the segmentation."""
SLOT_M = 6.2
"""Length of a parking slot along the kerb (m)."""
GARDEN_M = 30.0
"""Greatest distance of garden trees and false patches from the carriageway (m)."""
HALF_SIDE_M, HEIGHT_M = (1.5, 7.0), (22.0, 48.0)
"""Ranges of half the side and of the height over the ground (m)."""
SETBACK_M = (10.0, 24.0)
"""Distance from the carriageway's edge to the middle of a tower (m)."""
IMAGE_M = 700.0
"""Side of the part of the orthophoto that is from one image (m)."""


@dataclass(frozen=True)
class House:
    """A box with a flat roof, or with a gable roof whose ridge is parallel to the street."""

    x: float
    y: float
    heading: float
    half_length: float
    half_depth: float
    eaves: float
    """Absolute height of the eaves."""
    rise: float
    """Height of the ridge over the eaves; 0 for a flat roof."""


@dataclass(frozen=True)
class Crown:
    """A tree's crown, seen from above."""

    x: float
    y: float
    radius: float
    top: float
    """Absolute height of the top."""
    height: float
    """Height of the top over the ground."""
    hides: bool
    """Whether the segmentation misses the road below it."""


@dataclass(frozen=True)
class Car:
    """A vehicle: a box, lower at both ends."""

    x: float
    y: float
    heading: float
    half_length: float
    half_width: float
    height: float
    moving: bool


@dataclass(frozen=True)
class Spot:
    """A round patch that the segmentation classifies wrongly."""

    x: float
    y: float
    radius: float
    road: bool
    """The wrong class: True for road."""


def houses(
    streets: Sequence[Street], seed: int, ground_at: GroundAt, density: float, storeys: float
) -> tuple[House, ...]:
    """Return the houses along both sides of streets, but not on a road or in a stream.

    ``density`` is the fraction of the stratum's houses to build, ``storeys`` a factor on their eaves.
    """
    planned = [
        house
        for street in streets
        for side in (-1, 1)
        for house in _row_of_houses(street, side, generator(seed, "houses", *street.key, side), density)
    ]
    if not planned:
        return ()
    # Slightly beyond the corners, so that eaves do not reach over the kerb; the last point is the centre.
    spread = 1.05 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0)])
    xy = np.stack([_footprint(house, spread) for house in planned], axis=1)
    under = ground_at(xy[..., 0], xy[..., 1])
    free = ((under.edge > 0.5) & (under.trough == 0)).all(axis=0)
    return _standing(planned, free, under.bare[-1], storeys)


def _standing(planned: Sequence[House], free: Bools, bare: Floats, factor: float) -> tuple[House, ...]:
    """Return the houses on free ground, with their eaves, times a factor, above the ground."""
    return tuple(
        replace(house, eaves=float(base) + factor * house.eaves)
        for house, base, ok in zip(planned, bare, free, strict=True)
        if ok
    )


def _row_of_houses(street: Street, side: int, rng: np.random.Generator, density: float) -> list[House]:
    stratum, row = street.stratum, []
    along = street.start + rng.uniform(2, 6)
    line = rng.uniform(*stratum.setback_m)  # the building line of this side
    while along + (lot := rng.uniform(*stratum.lot_m)) < street.end:
        front = lot - rng.uniform(*stratum.gap_m)
        depth, setback = rng.uniform(*stratum.depth_m), line + rng.uniform(-0.4, 0.4)
        eaves, pitch = rng.uniform(*stratum.eaves_m), rng.uniform(0.4, 0.9)
        flat, built = rng.random() < stratum.flat_roofs, rng.random() < stratum.built * density
        if built:
            middle = along + lot / 2
            x, y = street.point(middle, side * (street.half_width_m + setback + depth / 2))
            rise = 0.0 if flat else pitch * depth / 2
            heading = float(street.heading(middle))
            row.append(House(float(x), float(y), heading, front / 2, depth / 2, eaves, rise))
        along += lot
    return row


def _footprint(house: House, spread: Floats) -> Floats:
    cos, sin = np.cos(house.heading), np.sin(house.heading)
    u, v = (spread * (house.half_length, house.half_depth)).T
    return np.column_stack([house.x + cos * u - sin * v, house.y + sin * u + cos * v])


def crowns(
    streets: Sequence[Street],
    seed: int,
    ground_at: GroundAt,
    built: Sequence[House],
    density: float,
    gardens: float,
) -> tuple[Crown, ...]:
    """Return the trees at the kerbs, whose crowns reach over the road, and the trees in the gardens.

    ``density`` is the fraction of the stratum's trees to plant, ``gardens`` a factor on the garden trees.
    """
    planned = [_trees(street, generator(seed, "crowns", *street.key), gardens) for street in streets]
    if not planned:
        return ()
    x, y, radius, height, hides, draw = np.concatenate(planned, axis=1)
    under = ground_at(x, y)
    # No trunk is on the carriageway or inside a house; a crown may touch a facade.
    free = (under.edge > 0.6) & (draw < density)
    for house in built:
        free &= np.hypot(x - house.x, y - house.y) > house.half_depth + 1.5
    top = under.bare + height
    return tuple(
        Crown(float(x[i]), float(y[i]), float(radius[i]), float(top[i]), float(height[i]), bool(hides[i]))
        for i in np.flatnonzero(free)
    )


def _trees(street: Street, rng: np.random.Generator, gardens: float) -> Floats:
    """Return x, y, radius, height, whether it hides the road, and a random draw; one column per tree."""
    along, lateral, radius = np.concatenate([_avenue(street, rng), _gardens(street, rng, gardens)], axis=1)
    height = radius * rng.uniform(2.2, 3.2, radius.size) + 1.0
    hides = rng.random(radius.size) < HIDING
    return np.stack([*street.point(along, lateral), radius, height, hides, rng.random(radius.size)])


def _avenue(street: Street, rng: np.random.Generator) -> Floats:
    """Return coordinate along, lateral offset and radius of the trees at the kerb, ``(3, N)``."""
    sides = np.array([-1.0, 1.0])[rng.random(2) < street.stratum.avenues]
    along = np.arange(street.start + CORNER_M, street.end - CORNER_M, rng.uniform(9, 15))
    offset = street.half_width_m + rng.uniform(1.0, 2.2)
    lateral, along = (a.ravel() for a in np.meshgrid(sides * offset, along))
    grown = rng.random(along.size) < 0.85
    along, lateral = along[grown] + rng.uniform(-1, 1, grown.sum()), lateral[grown]
    return np.stack([along, lateral, rng.uniform(2.0, 4.2, along.size)])


def _gardens(street: Street, rng: np.random.Generator, factor: float) -> Floats:
    """Return the same for the trees away from the kerb."""
    count = rng.poisson(street.stratum.garden_trees * factor)
    along = rng.uniform(street.start, street.end, count)
    lateral = rng.choice((-1.0, 1.0), count) * (street.half_width_m + rng.uniform(2, GARDEN_M, count))
    return np.stack([along, lateral, rng.uniform(1.5, 4.5, count)])


def cars(street: Street, seed: int, density: float) -> list[Car]:
    """Return the parked cars along both kerbs and the moving cars."""
    rng = generator(seed, "cars", *street.key)
    return [*_parked(street, rng, density), *_moving(street, rng, density)]


def _parked(street: Street, rng: np.random.Generator, density: float) -> list[Car]:
    parked = []
    for side in (-1, 1):
        # The occupancy differs between kerbs.
        share = np.clip(street.stratum.parked * rng.uniform(0.2, 1.8), 0, 1) * density
        slots = np.arange(street.start + CORNER_M, street.end - CORNER_M, SLOT_M)
        for slot in slots[rng.random(slots.size) < share]:
            van = rng.random() < 0.12
            half_width = 1.0 if van else 0.9
            lateral = side * (street.half_width_m - half_width - rng.uniform(0.1, 0.3))
            length, height = (5.4, 2.2) if van else (rng.uniform(3.9, 4.7), rng.uniform(1.4, 1.65))
            parked.append(_car(street, slot, lateral, length, half_width, height, moving=False))
    return parked


def _moving(street: Street, rng: np.random.Generator, density: float) -> list[Car]:
    moving = []
    for _ in range(rng.poisson(street.stratum.moving * density)):
        along, side = rng.uniform(street.start, street.end), rng.choice((-1, 1))
        truck = rng.random() < 0.1
        # A scan distorts moving cars: they appear longer, or shorter and lower.
        length, height = (10.0, 3.4) if truck else (4.4 * rng.uniform(0.6, 1.8), rng.uniform(0.8, 1.6))
        half_width = 1.25 if truck else 0.9
        moving.append(_car(street, along, side * street.half_width_m * 0.4, length, half_width, height, True))
    return moving


def _car(
    street: Street,
    along: float,
    lateral: float,
    length: float,
    half_width: float,
    height: float,
    moving: bool,
) -> Car:
    x, y = street.point(along, lateral)
    heading = float(street.heading(along))
    return Car(float(x), float(y), heading, length / 2, half_width, height, moving)


def spots(street: Street, seed: int, density: float) -> list[Spot]:
    """Return holes in the mask of the street and false patches beside it (drives, yards, parts of roofs)."""
    rng = generator(seed, "spots", *street.key)
    length = street.end - street.start
    holes = rng.poisson(density * length / 90)
    drives = rng.poisson(density * length / 60)
    yards = rng.poisson(density * length / 120)
    lateral = np.concatenate(
        [
            rng.uniform(-1, 1, holes) * street.half_width_m,
            rng.choice((-1, 1), drives) * (street.half_width_m + rng.uniform(0, 3, drives)),
            rng.choice((-1, 1), yards) * (street.half_width_m + rng.uniform(6, GARDEN_M, yards)),
        ]
    )
    along = rng.uniform(street.start, street.end, lateral.size)
    radius = rng.uniform(1.0, 3.2, lateral.size)
    x, y = street.point(along, lateral)
    return [
        Spot(float(a), float(b), float(r), k >= holes)
        for k, (a, b, r) in enumerate(zip(x, y, radius, strict=True))
    ]


def towers(streets: Sequence[Street], seed: int, ground_at: GroundAt, mean: float) -> tuple[House, ...]:
    """Return towers, ``mean`` per street on average, but not on a road or in a stream."""
    planned = [house for street in streets for house in _planned(street, seed, mean)] if mean > 0 else []
    if not planned:
        return ()
    x, y = (np.array([getattr(house, axis) for house in planned]) for axis in ("x", "y"))
    under = ground_at(x, y)
    reach: Floats = np.array([np.hypot(house.half_length, house.half_depth) for house in planned])
    return _standing(planned, (under.edge > reach + 1) & (under.trough == 0), under.bare, 1.0)


def _planned(street: Street, seed: int, mean: float) -> list[House]:
    rng = generator(seed, "towers", *street.key)
    planned = []
    for _ in range(rng.poisson(mean)):
        along = rng.uniform(street.start, street.end)
        lateral = rng.choice((-1, 1)) * (street.half_width_m + rng.uniform(*SETBACK_M))
        x, y = (float(c) for c in street.point(along, lateral))
        half, height = rng.uniform(*HALF_SIDE_M), rng.uniform(*HEIGHT_M)
        rise = 0.0 if rng.random() < 0.6 else half * 2
        planned.append(House(x, y, float(street.heading(along)), half, half, height, rise))
    return planned


@dataclass(frozen=True)
class Roof:
    """The roof of a house in the orthophoto."""

    house: House
    shift: tuple[float, float]
    """Displacement in the plan's frame (m)."""
    facade_as_road: bool
    """Whether the segmentation mistakes the visible facades for road."""


def roofs_seen(
    houses: Sequence[House], seed: int, ground_at: GroundAt, lean: float, facades: float
) -> tuple[Roof, ...]:
    """Return the roofs of all houses.

    - `lean`: displacement per height above the ground, at the edge of an image.
    - `facades`: fraction of the houses whose facades are mistaken for road.
    """
    if not houses:
        return ()
    x, y = (np.array([getattr(house, axis) for house in houses]) for axis in ("x", "y"))
    height = np.array([house.eaves for house in houses]) - ground_at(x, y).bare
    shift = lean * height * from_middle(seed, x, y)
    places = [(int(house.x // 1), int(house.y // 1)) for house in houses]
    return tuple(
        Roof(house, (float(east), float(north)), bool(generator(seed, "facade", *place).random() < facades))
        for house, east, north, place in zip(houses, *shift, places, strict=True)
    )


def from_middle(seed: int, x: Floats, y: Floats) -> Floats:
    """Return the places of points in their images, ``(2, N)``: 0 in the middle, -1 and 1 at the edges."""
    phase = generator(seed, "images").uniform(0, IMAGE_M, 2)
    return np.stack(
        [2 * ((axis + start) / IMAGE_M % 1) - 1 for axis, start in zip((x, y), phase, strict=True)]
    )
