"""Low growth off the road: hedges, brambles and crops, which no scan sees through."""

from __future__ import annotations

import numpy as np

from flexroad.tasks.synthetic.noise import generator, waves
from flexroad.tasks.types import Bools, Floats

THICKET_M = (6.0, 60.0)
"""Shortest and longest wave of the thickets."""
CLEAR_M = 1.5
"""Beside a carriageway nothing is let grow."""


def growth(
    seed: int, x: Floats, y: Floats, edge: Floats, height_m: float, rng: np.random.Generator
) -> Floats:
    """Return the height of low growth (m), 0 where there is none.

    Parameters
    ----------
    seed : int
        The world.
    x, y, edge : (H, W) array
        Places in the plan's frame, and their distance to the nearest carriageway (m).
    height_m : float
        Mean height inside a thicket (m).
    rng : numpy.random.Generator
        Draws where in a cell the highest leaf is.
    """
    lengths = np.geomspace(*THICKET_M, 18)
    thick = waves(generator(seed, "thickets"), lengths, np.sqrt(2 / lengths.size))(x, y)
    here: Bools = (thick > 0) & (edge > CLEAR_M)
    # Half the cells' highest leaf is below the mean, a few are far above it: growth is ragged.
    ragged: Floats = rng.gamma(2.0, 0.5, x.shape)
    return np.where(here, height_m * np.minimum(thick, 1) * ragged, 0.0)
