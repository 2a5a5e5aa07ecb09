"""Long, thin objects: guard rails, parapets of bridges, and overhead lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.synthetic.network import Street
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import CORNER_M, GroundAt
from flexroad.tasks.types import Floats

STEP_M = 0.25
"""Distance between the points of a line (m)."""
RAIL_M, RAIL_OFFSET_M = 0.8, 0.4
"""Height of a rail over the ground, and its distance from the carriageway's edge (m)."""
POLE_SPACING_M, WIRE_M, SAG_M = 40.0, 7.5, 0.8
"""Overhead lines: distance between poles, height over the ground at a pole, and sag (m)."""
SERVICE_M = 12.0
"""Distance from the centre line to the house at the end of a connection, across the street (m)."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Points along thin objects, ``(N,)`` each, in the plan's frame (m)."""

    x: Floats
    y: Floats
    z: Floats

    @classmethod
    def none(cls) -> Trace:
        """Return a trace without points."""
        return cls(*np.zeros((3, 0)))


def rails(streets: Sequence[Street], seed: int, ground_at: GroundAt, share: float) -> Trace:
    """Return guard rails along a fraction of the street sides, and parapets on all bridges."""
    sides = [
        side for street in streets for side in _sides(street, generator(seed, "rails", *street.key), share)
    ]
    if share <= 0 or not sides:
        return Trace.none()
    x, y, railed = np.concatenate(sides, axis=1)
    under = ground_at(x, y)
    # A rail ends where another street joins.
    kept = (under.deck | (railed > 0)) & (under.over > RAIL_OFFSET_M / 2)
    return Trace(x[kept], y[kept], under.height[kept] + RAIL_M)


def _sides(street: Street, rng: np.random.Generator, share: float) -> list[Floats]:
    """Return x, y and whether there is a rail along both sides of a street, ``(3, N)`` each."""
    along = np.arange(street.start, street.end, STEP_M)
    sides = []
    for side in (-1, 1):
        x, y = street.point(along, side * (street.half_width_m + RAIL_OFFSET_M))
        sides.append(np.stack([x, y, np.full(x.shape, rng.random() < share)]))
    return sides


def wires(streets: Sequence[Street], seed: int, ground_at: GroundAt, share: float) -> Trace:
    """Return overhead lines along a fraction of the streets, with connections to houses across the street."""
    lines = [
        _line(street, rng)
        for street in streets
        if (rng := generator(seed, "wires", *street.key)).random() < share
    ]
    if not lines:
        return Trace.none()
    x, y, sag = np.concatenate(lines, axis=1)
    return Trace(x, y, ground_at(x, y).bare + WIRE_M - sag)


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
