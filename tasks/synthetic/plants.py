"""Low vegetation off the road: hedges, brambles and crops, which a scan does not penetrate."""

from __future__ import annotations

import numpy as np

from flexroad.tasks.synthetic.noise import generator, waves
from flexroad.tasks.types import Bools, Floats

THICKET_M = (6.0, 60.0)
"""Shortest and longest wave of the thickets (m)."""
CLEAR_M = 1.5
"""Width of the strip beside a carriageway without vegetation (m)."""


def growth(
    seed: int, x: Floats, y: Floats, edge: Floats, height_m: float, rng: np.random.Generator
) -> Floats:
    """Return the height of low vegetation, ``(H, W)``, m; 0 where there is none.

    Parameters
    ----------
    seed : int
        Seed of the world.
    x, y, edge : (H, W) array
        Coordinates in the plan's frame, and distance to the nearest carriageway (m).
    height_m : float
        Mean height inside a thicket (m).
    rng : numpy.random.Generator
        Draws the height of each cell relative to the mean.
    """
    lengths = np.geomspace(*THICKET_M, 18)
    thick = waves(generator(seed, "thickets"), lengths, np.sqrt(2 / lengths.size))(x, y)
    covered: Bools = (thick > 0) & (edge > CLEAR_M)
    # A skewed distribution of mean 1: most cells are lower than the mean, a few are far higher.
    ragged: Floats = rng.gamma(2.0, 0.5, x.shape)
    return np.where(covered, height_m * np.minimum(thick, 1) * ragged, 0.0)
