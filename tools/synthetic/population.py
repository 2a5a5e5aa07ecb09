"""All objects and mask errors near one tile, among them paved and bare areas, guard rails and overhead lines.

A segmentation mistakes paved and bare areas off the road for road: car parks, fields, yards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.types import Floats
from flexroad.tools.synthetic.network import Street
from flexroad.tools.synthetic.objects import (
    CORNER_M,
    Car,
    Crown,
    GroundAt,
    House,
    Roof,
    Spot,
    cars,
    crowns,
    houses,
    roofs_seen,
    spots,
    towers,
)
from flexroad.tools.synthetic.world import SceneOptions, generator

KERB_REACH_M = 2.5
"""Greatest distance of a parked car's centre from the kerb (m); cars farther away are on a roundabout."""
BAY_M, AISLE_M = 2.6, 16.0
"""Width of a parking bay, and distance between the middles of double rows (m)."""
OCCUPIED = 0.55
"""Fraction of the bays with a car."""
MISTAKEN = 0.6
"""Fraction of these areas that the segmentation mistakes for road."""
SIZES = {
    "car parks": ((9, 17), (8, 13), (2, 5)),
    "fields": ((10, 20), (5, 14), (1.5, 4)),
    "paved yards": ((3, 10), (3, 9), (1.2, 2.5)),
}
"""Kinds of areas: ranges of half length, half width and distance from the road (m)."""
CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0)])
STEP_M = 0.25
"""Distance between the points of a line (m)."""
RAIL_M, RAIL_OFFSET_M = 0.8, 0.4
"""Height of a rail over the ground, and its distance from the carriageway's edge (m)."""
POLE_SPACING_M, WIRE_M, SAG_M = 40.0, 7.5, 0.8
"""Overhead lines: distance between poles, height over the ground at a pole, and sag (m)."""
SERVICE_M = 12.0
"""Distance from the centre line to the house at the end of a connection, across the street (m)."""


@dataclass(frozen=True)
class Objects:
    """The objects near a tile; an object in several tiles is the same in each."""

    houses: tuple[House, ...]
    crowns: tuple[Crown, ...]
    cars: tuple[Car, ...]
    spots: tuple[Spot, ...]
    car_parks: tuple[Area, ...]
    fields: tuple[Area, ...]
    false_roofs: tuple[Area, ...]
    """Roofs, or parts of them, that the segmentation mistakes for road."""
    rails: Floats
    """Points along guard rails in the plan's frame, ``(3, N)``, m; the same for overhead lines."""
    wires: Floats
    yards: tuple[Area, ...] = ()
    roofs: tuple[Roof, ...] = ()
    """Roofs as the photograph shows them; empty if no error of the mask depends on them."""


def populate(
    streets: Sequence[Street],
    farther: Sequence[Street],
    seed: int,
    ground_at: GroundAt,
    options: SceneOptions,
) -> Objects:
    """Return the objects of some streets.

    - `farther`: these and more streets; no house is on their car parks and fields.
    - `ground_at`: returns the ground at points, with all streets nearby.
    """
    density, errors = options.density, options.mask_errors
    parks = _beside(farther, seed, "car parks", ground_at, options.car_parks * density)
    bare = _beside(farther, seed, "fields", ground_at, options.fields * errors)
    built = houses(streets, seed, ground_at, density * options.built, options.storeys)
    built += towers(streets, seed, ground_at, options.towers * density)
    built = tuple(house for house in built if not any(_overlap(house, area) for area in (*parks, *bare)))
    roofs = roofs_seen(built, seed, ground_at, options.lean * errors, options.facades)
    trees = crowns(streets, seed, ground_at, built, density, options.trees)
    vehicles = [car for street in streets for car in cars(street, seed, density)]
    if options.roundabouts:
        vehicles = _off_roundabouts(vehicles, ground_at)
    vehicles += [car for park in parks for car in parked(park, seed)]
    return Objects(
        built,
        trees,
        tuple(vehicles),
        tuple(spot for street in streets for spot in spots(street, seed, errors)),
        parks,
        bare,
        _false_roofs(roofs, seed, options.false_roofs * errors),
        rails(streets, seed, ground_at, options.rails * density),
        wires(streets, seed, ground_at, options.wires * density),
        _beside(farther, seed, "paved yards", ground_at, options.yards * errors),
        roofs if options.lean or options.verge_m or options.yards or options.open_ground else (),
    )


def _off_roundabouts(vehicles: Sequence[Car], ground_at: GroundAt) -> list[Car]:
    """Return the cars without cars parked in a roundabout's lanes or on its island."""
    if not vehicles:
        return []
    under = ground_at(np.array([car.x for car in vehicles]), np.array([car.y for car in vehicles]))
    fits = [
        (edge < 0) & (car.moving | (edge > -KERB_REACH_M))
        for car, edge in zip(vehicles, under.edge, strict=True)
    ]
    return [car for car, fit in zip(vehicles, fits, strict=True) if fit]


def _false_roofs(roofs: Sequence[Roof], seed: int, share: float) -> tuple[Area, ...]:
    false = []
    for roof in roofs if share > 0 else ():
        house = roof.house
        rng = generator(seed, "roof", int(house.x // 1), int(house.y // 1))
        if rng.random() < share:
            length = house.half_length * rng.uniform(0.4, 1)
            x, y = house.x + roof.shift[0], house.y + roof.shift[1]
            false.append(Area(x, y, house.heading, length, house.half_depth, as_road=True))
    return tuple(false)


@dataclass(frozen=True)
class Area:
    """A rectangle beside a street, in the plan's frame; lengths in m, heading in rad."""

    x: float
    y: float
    heading: float
    half_length: float
    half_width: float
    as_road: bool
    """Whether the segmentation mistakes it for road."""

    def at(self, part: Floats) -> tuple[Floats, Floats]:
        """Return x and y of points given as fractions of the half sides, ``(N, 2)``."""
        u, v = (part * (self.half_length, self.half_width)).T
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        return self.x + cos * u - sin * v, self.y + sin * u + cos * v


def _beside(
    streets: Sequence[Street],
    seed: int,
    kind: str,
    ground_at: GroundAt,
    mean: float,
) -> tuple[Area, ...]:
    """Return areas of a kind of `SIZES`, ``mean`` per street on average; houses may be on yards."""
    planned = [
        area
        for street in streets
        for area in _planned(street, generator(seed, kind, *street.key), mean, SIZES[kind])
    ]
    if not planned:
        return ()
    xy = np.array([area.at(CORNERS) for area in planned])
    under = ground_at(xy[:, 0], xy[:, 1])
    free = ((under.edge > 1) & (under.trough == 0)).all(axis=1)
    return tuple(area for area, ok in zip(planned, free, strict=True) if ok)


def _planned(
    street: Street, rng: np.random.Generator, mean: float, sizes: tuple[tuple[float, float], ...]
) -> list[Area]:
    planned = []
    for _ in range(rng.poisson(mean)):
        length, width, away = (rng.uniform(*size) for size in sizes)
        along = rng.uniform(street.start, street.end)
        lateral = rng.choice((-1, 1)) * (street.half_width_m + away + width)
        x, y = (float(c) for c in street.point(along, lateral))
        planned.append(Area(x, y, float(street.heading(along)), length, width, bool(rng.random() < MISTAKEN)))
    return planned


def _overlap(house: House, area: Area) -> bool:
    dx, dy = house.x - area.x, house.y - area.y
    cos, sin = np.cos(area.heading), np.sin(area.heading)
    u, v = abs(cos * dx + sin * dy), abs(cos * dy - sin * dx)
    reach = max(house.half_length, house.half_depth)
    return bool(u < area.half_length + reach and v < area.half_width + reach)


def parked(area: Area, seed: int) -> tuple[Car, ...]:
    """Return the cars on a car park, in double rows."""
    rng = generator(seed, "bays", int(np.floor(area.x)), int(np.floor(area.y)))
    cars = []
    for row in np.arange(-area.half_width + 3, area.half_width - 2, AISLE_M / 2):
        for bay in np.arange(-area.half_length + 2, area.half_length - 2, BAY_M):
            if rng.random() < OCCUPIED:
                part = np.array([[bay / area.half_length, row / area.half_width]])
                (x,), (y,) = area.at(part)
                length, height = rng.uniform(3.9, 4.7), rng.uniform(1.4, 1.75)
                across = area.heading + np.pi / 2
                cars.append(Car(float(x), float(y), across, length / 2, 0.9, height, moving=False))
    return tuple(cars)


def rails(streets: Sequence[Street], seed: int, ground_at: GroundAt, share: float) -> Floats:
    """Return guard rails along a fraction of the street sides, and parapets on all bridges."""
    sides = [
        side for street in streets for side in _sides(street, generator(seed, "rails", *street.key), share)
    ]
    if share <= 0 or not sides:
        return np.zeros((3, 0))
    x, y, railed = np.concatenate(sides, axis=1)
    under = ground_at(x, y)
    # A rail ends where another street joins.
    kept = (under.deck | (railed > 0)) & (under.over > RAIL_OFFSET_M / 2)
    return np.stack([x, y, under.height + RAIL_M])[:, kept]


def _sides(street: Street, rng: np.random.Generator, share: float) -> list[Floats]:
    """Return x, y and whether there is a rail along both sides of a street, ``(3, N)`` each."""
    along = np.arange(street.start, street.end, STEP_M)
    sides = []
    for side in (-1, 1):
        x, y = street.point(along, side * (street.half_width_m + RAIL_OFFSET_M))
        sides.append(np.stack([x, y, np.full(x.shape, rng.random() < share)]))
    return sides


def wires(streets: Sequence[Street], seed: int, ground_at: GroundAt, share: float) -> Floats:
    """Return overhead lines along a fraction of the streets, with connections to houses across the street."""
    lines = [
        _line(street, rng)
        for street in streets
        if (rng := generator(seed, "wires", *street.key)).random() < share
    ]
    if not lines:
        return np.zeros((3, 0))
    x, y, sag = np.concatenate(lines, axis=1)
    return np.stack([x, y, ground_at(x, y).bare + WIRE_M - sag])


def _line(street: Street, rng: np.random.Generator) -> Floats:
    """Return x, y and sag of the wires of one street, ``(3, N)``."""
    offset = rng.choice((-1, 1)) * (street.half_width_m + 1.2)
    along = np.arange(street.start + CORNER_M, street.end - CORNER_M, STEP_M)
    spans = (along - street.start) / POLE_SPACING_M % 1
    crossing = np.arange(-np.sign(offset) * SERVICE_M, offset, np.sign(offset) * STEP_M)
    poles = np.arange(street.start + POLE_SPACING_M, street.end - CORNER_M, POLE_SPACING_M)
    lines = [street.point(along, offset), *(street.point(np.full(crossing.size, p), crossing) for p in poles)]
    sag = np.concatenate([4 * SAG_M * spans * (1 - spans), np.zeros(poles.size * crossing.size)])
    x, y = (np.concatenate(c) for c in zip(*lines, strict=True))
    return np.stack([x, y, sag])
