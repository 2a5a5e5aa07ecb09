"""Errors of a terrain model under houses, where the ground was interpolated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.objects import House
from flexroad.tasks.synthetic.spoilers import Canvas
from flexroad.tasks.types import Floats

RIM_M = 1.5
"""Distance beyond the walls to which the ground was removed with the house (m)."""
TILT = 0.5
"""Tilt of a scar, as a fraction of its depth."""


def scars(canvas: Canvas, houses: Sequence[House], seed: int, depth_m: float) -> Floats:
    """Return the error of the terrain model under houses, ``(H, W)``, m; 0 elsewhere.

    The error under a house is a tilted plane, as interpolation across a hole would give.
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
