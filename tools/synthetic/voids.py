"""Cells in which a survey finds no height: ground that crowns hide, and water.

The survey sees a crown from one image, so that the ground at its far side is hidden, the farther the nearer
the crown is to the image's edge. Water gives no echo, and nothing that two images have in common.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.network import Stream
from flexroad.tools.synthetic.noise import generator
from flexroad.tools.synthetic.objects import Crown, from_middle
from flexroad.tools.synthetic.spoilers import Canvas
from flexroad.tools.synthetic.surfaces import BED_M

SPREAD = 0.5
"""Greatest deviation of the length of a crown's hidden ground, relative: crowns are not equally dense."""


def hidden(canvas: Canvas, dsm: Floats, crowns: Sequence[Crown], seed: int, length: float) -> Bools:
    """Return the cells that crowns hide, ``(H, W)``: beside a crown, and below the middle of its height.

    - `dsm`: surface model (m).
    - `length`: mean length of the hidden ground at the edge of an image, per height of the crown.
    """
    found = np.zeros(dsm.shape, np.bool_)
    if length <= 0 or not crowns:
        return found
    x, y = (np.array([getattr(crown, axis) for crown in crowns]) for axis in ("x", "y"))
    for crown, away in zip(crowns, from_middle(seed, x, y).T, strict=True):
        rng = generator(seed, "hidden", int(crown.x // 1), int(crown.y // 1))
        east, north = away * length * crown.height * rng.uniform(1 - SPREAD, 1 + SPREAD)
        window = canvas.around(crown.x, crown.y, crown.radius + float(np.hypot(east, north)))
        dx, dy = canvas.x[window] - crown.x, canvas.y[window] - crown.y
        # The crown moved along its shift: the nearest of its middles to each cell.
        part = np.clip((dx * east + dy * north) / (east**2 + north**2), 0, 1)
        covered = np.hypot(dx - part * east, dy - part * north) < crown.radius
        beside = np.hypot(dx, dy) > crown.radius
        found[window] |= covered & beside & (dsm[window] < crown.top - crown.height / 2)
    return found


def water(canvas: Canvas, streams: Iterable[Stream]) -> Bools:
    """Return the cells in the beds of streams, ``(H, W)``, also those below bridges."""
    wet = np.zeros(canvas.x.shape, np.bool_)
    for stream in streams:
        if not stream.paved:
            wet |= stream.distance(canvas.x, canvas.y) < BED_M
    return wet
