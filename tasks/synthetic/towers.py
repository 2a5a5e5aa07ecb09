"""Tall buildings: church towers, chimneys and high-rises."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexroad.tasks.synthetic.network import Street
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import GroundAt, House
from flexroad.tasks.types import Floats

HALF_SIDE_M, HEIGHT_M = (1.5, 7.0), (22.0, 48.0)
"""Ranges of half the side and of the height over the ground (m)."""
SETBACK_M = (10.0, 24.0)
"""Distance from the carriageway's edge to the middle of a tower (m)."""


def towers(streets: Sequence[Street], seed: int, ground_at: GroundAt, mean: float) -> tuple[House, ...]:
    """Return towers, ``mean`` per street on average, none of them on a road or in a stream."""
    planned = [house for street in streets for house in _planned(street, seed, mean)] if mean > 0 else []
    if not planned:
        return ()
    x, y = (np.array([getattr(house, axis) for house in planned]) for axis in ("x", "y"))
    under = ground_at(x, y)
    reach: Floats = np.array([np.hypot(house.half_length, house.half_depth) for house in planned])
    free = (under.edge > reach + 1) & (under.trough == 0)
    return tuple(
        House(h.x, h.y, h.heading, h.half_length, h.half_depth, float(base) + h.eaves, h.rise)
        for h, base, ok in zip(planned, under.bare, free, strict=True)
        if ok
    )


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
