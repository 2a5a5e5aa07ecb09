"""Scars of a terrain model: where a house was cut out, the ground was guessed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import House
from flexroad.tasks.synthetic.spoilers import Canvas
from flexroad.tasks.types import Floats

RIM_M = 1.5
"""How far beyond the walls the ground was lost with the house."""
TILT = 0.5
"""Part of a scar's depth by which it may be off at its ends on top."""


def scars(canvas: Canvas, houses: Sequence[House], seed: int, depth_m: float) -> Floats:
    """Return by how much the terrain model is off where houses stand, ``(H, W)``, m.

    Under each house lies one tilted plane, as an interpolation across a hole leaves it.
    """
    off = np.zeros(canvas.x.shape)
    for house in houses if depth_m > 0 else ():
        window = canvas.around(house.x, house.y, float(np.hypot(house.half_length, house.half_depth)) + RIM_M)
        u, v = canvas.local(window, house.x, house.y, house.heading)
        inside = (np.abs(u) <= house.half_length + RIM_M) & (np.abs(v) <= house.half_depth + RIM_M)
        level, tilt = generator(seed, "scar", int(house.x // 1), int(house.y // 1)).normal(0, depth_m, 2)
        plane = level + TILT * tilt * u / house.half_length
        off[window] = np.where(inside, plane, off[window])
    return off
