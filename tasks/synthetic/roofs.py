"""Roofs as an orthophoto shows them: displaced away from the place over which the picture was taken.

The orthophoto of a survey is corrected with the terrain model, so whatever stands on the terrain leans
outwards in it. On the side that leans away, the picture has the facade where the surface model has the roof.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import GroundAt, House
from flexroad.tasks.types import Floats

IMAGE_M = 700.0
"""Side of the part of the orthophoto that is taken from one image (m)."""


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

    Parameters
    ----------
    houses : sequence of House
        The houses.
    seed : int
        Seed of the world.
    ground_at : callable
        Returns the ground at points.
    lean : float
        Displacement per height above the ground, at the edge of an image.
    facades : float
        Fraction of the houses whose facades are mistaken for road.
    """
    if not houses:
        return ()
    x, y = (np.array([getattr(house, axis) for house in houses]) for axis in ("x", "y"))
    height = np.array([house.eaves for house in houses]) - ground_at(x, y).bare
    phase = generator(seed, "images").uniform(0, IMAGE_M, 2)
    shift = lean * height * np.stack([_from_middle(x + phase[0]), _from_middle(y + phase[1])])
    return tuple(
        Roof(house, (float(east), float(north)), _drawn(house, seed) < facades)
        for house, east, north in zip(houses, *shift, strict=True)
    )


def _from_middle(coordinate: Floats) -> Floats:
    """Return the place in an image, from -1 at its one edge to 1 at the other."""
    return 2 * (coordinate / IMAGE_M % 1) - 1


def _drawn(house: House, seed: int) -> float:
    return float(generator(seed, "facade", int(house.x // 1), int(house.y // 1)).random())
