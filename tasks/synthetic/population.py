"""Everything that stands between a survey and the truth, near one tile."""

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
from flexroad.tasks.synthetic.towers import towers

UNDER_WAY_M = 2.5
"""A car parked farther than this from the kerb stands in a roundabout's lane."""


@dataclass(frozen=True)
class Objects:
    """What there is, each thing the same for all tiles it reaches into."""

    houses: tuple[House, ...]
    crowns: tuple[Crown, ...]
    cars: tuple[Car, ...]
    spots: tuple[Spot, ...]
    car_parks: tuple[Area, ...]
    fields: tuple[Area, ...]
    false_roofs: tuple[Area, ...]
    """Roofs, or parts of them, that the segmentation takes for road."""
    rails: Trace
    wires: Trace


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
        Whose objects are wanted.
    farther : sequence of Street
        These and more, whose areas houses keep off.
    seed : int
        The world.
    ground_at : callable
        The ground with all streets that are near.
    options : SceneOptions
        How much of each there is.
    """
    density, errors = options.density, options.mask_errors
    car_parks = areas.car_parks(farther, seed, ground_at, options.car_parks * density)
    bare = areas.fields(farther, seed, ground_at, options.fields * errors)
    built = houses(streets, seed, ground_at, density * options.built, options.storeys)
    built += towers(streets, seed, ground_at, options.towers * density)
    built = areas.off(built, (*car_parks, *bare))
    grown = crowns(streets, seed, ground_at, built, density, options.trees)
    driven = [car for street in streets for car in cars(street, seed, density)]
    if options.roundabouts:
        driven = _clear(driven, ground_at)
    driven += [car for park in car_parks for car in areas.parked(park, seed)]
    return Objects(
        built,
        grown,
        tuple(driven),
        tuple(spot for street in streets for spot in spots(street, seed, errors)),
        car_parks,
        bare,
        _false_roofs(built, seed, options.false_roofs * errors),
        linework.rails(streets, seed, ground_at, options.rails * density),
        linework.wires(streets, seed, ground_at, options.wires * density),
    )


def _clear(driven: Sequence[Car], ground_at: GroundAt) -> list[Car]:
    """Leave out the cars that a roundabout has put into its lanes or onto its island."""
    if not driven:
        return []
    under = ground_at(np.array([car.x for car in driven]), np.array([car.y for car in driven]))
    fits = [
        (edge < 0) & (car.moving | (edge > -UNDER_WAY_M))
        for car, edge in zip(driven, under.edge, strict=True)
    ]
    return [car for car, fit in zip(driven, fits, strict=True) if fit]


def _false_roofs(built: Sequence[House], seed: int, share: float) -> tuple[Area, ...]:
    found = []
    for house in built if share > 0 else ():
        rng = generator(seed, "roof", int(house.x // 1), int(house.y // 1))
        if rng.random() < share:
            length = house.half_length * rng.uniform(0.4, 1)
            found.append(Area(house.x, house.y, house.heading, length, house.half_depth, as_road=True))
    return tuple(found)
