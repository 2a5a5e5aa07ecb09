"""Paved and bare areas off the road, which a segmentation mistakes for road: car parks, fields, yards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.synthetic.network import Street
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import Car, GroundAt, House
from flexroad.tasks.types import Floats

BAY_M, AISLE_M = 2.6, 16.0
"""Width of a parking bay, and distance between the middles of double rows (m)."""
OCCUPIED = 0.55
"""Fraction of the bays with a car."""
MISTAKEN = 0.6
"""Fraction of these areas that the segmentation mistakes for road."""
CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0)])


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


def car_parks(streets: Sequence[Street], seed: int, ground_at: GroundAt, mean: float) -> tuple[Area, ...]:
    """Return car parks, ``mean`` per street on average."""
    return _beside(streets, seed, "car parks", ground_at, mean, ((9, 17), (8, 13), (2, 5)))


def fields(streets: Sequence[Street], seed: int, ground_at: GroundAt, mean: float) -> tuple[Area, ...]:
    """Return bare fields, ``mean`` per street on average."""
    return _beside(streets, seed, "fields", ground_at, mean, ((10, 20), (5, 14), (1.5, 4)))


def yards(streets: Sequence[Street], seed: int, ground_at: GroundAt, mean: float) -> tuple[Area, ...]:
    """Return paved yards next to the pavement, ``mean`` per street on average; houses may stand on them."""
    return _beside(streets, seed, "paved yards", ground_at, mean, ((3, 10), (3, 9), (1.2, 2.5)))


def _beside(
    streets: Sequence[Street],
    seed: int,
    purpose: str,
    ground_at: GroundAt,
    mean: float,
    sizes: tuple[tuple[float, float], ...],
) -> tuple[Area, ...]:
    """Return rectangles; ``sizes``: ranges of half length, half width and distance from the road (m)."""
    planned = [
        area
        for street in streets
        for area in _planned(street, generator(seed, purpose, *street.key), mean, sizes)
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


def houses_off(houses: Sequence[House], areas: Sequence[Area]) -> tuple[House, ...]:
    """Return the houses that overlap none of the areas."""
    return tuple(house for house in houses if not any(_overlap(house, area) for area in areas))


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
