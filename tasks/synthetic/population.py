"""All objects and mask errors near one tile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.synthetic import areas, linework
from flexroad.tasks.synthetic.areas import Area
from flexroad.tasks.synthetic.linework import Trace
from flexroad.tasks.synthetic.network import Street
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import Car, Crown, GroundAt, House, Spot, cars, crowns, houses, spots
from flexroad.tasks.synthetic.options import SceneOptions
from flexroad.tasks.synthetic.roofs import Roof, roofs_seen
from flexroad.tasks.synthetic.towers import towers

KERB_REACH_M = 2.5
"""Greatest distance of a parked car's centre from the kerb (m); farther ones are in a roundabout's lane."""


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
    rails: Trace
    wires: Trace
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

    Parameters
    ----------
    streets : sequence of Street
        Streets whose objects are returned.
    farther : sequence of Street
        These and more streets; houses do not stand on their car parks and fields.
    seed : int
        Seed of the world.
    ground_at : callable
        Returns the ground at points, with all streets nearby.
    options : SceneOptions
        Amounts of each kind of object.
    """
    density, errors = options.density, options.mask_errors
    car_parks = areas.car_parks(farther, seed, ground_at, options.car_parks * density)
    bare = areas.fields(farther, seed, ground_at, options.fields * errors)
    built = houses(streets, seed, ground_at, density * options.built, options.storeys)
    built += towers(streets, seed, ground_at, options.towers * density)
    built = areas.houses_off(built, (*car_parks, *bare))
    roofs = roofs_seen(built, seed, ground_at, options.lean * errors, options.facades)
    trees = crowns(streets, seed, ground_at, built, density, options.trees)
    vehicles = [car for street in streets for car in cars(street, seed, density)]
    if options.roundabouts:
        vehicles = _off_roundabouts(vehicles, ground_at)
    vehicles += [car for park in car_parks for car in areas.parked(park, seed)]
    return Objects(
        built,
        trees,
        tuple(vehicles),
        tuple(spot for street in streets for spot in spots(street, seed, errors)),
        car_parks,
        bare,
        _false_roofs(roofs, seed, options.false_roofs * errors),
        linework.rails(streets, seed, ground_at, options.rails * density),
        linework.wires(streets, seed, ground_at, options.wires * density),
        areas.yards(farther, seed, ground_at, options.yards * errors),
        roofs if options.lean or options.verge_m or options.yards or options.open_ground else (),
    )


def _off_roundabouts(vehicles: Sequence[Car], ground_at: GroundAt) -> list[Car]:
    """Return the cars without those parked in a roundabout's lanes or standing on its island."""
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
