"""Mixed cells: at an edge or a wall, the measured height lies anywhere between top and foot."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from flexroad.tasks.types import Bools, Floats

WALL_M = 1.5
"""Least height step to a neighbouring cell that counts as a wall (m)."""


def mixed(dsm: Floats, truth: Floats, share: float, rng: np.random.Generator) -> tuple[Floats, Bools]:
    """Return the surface model with a fraction of the cells at walls mixed (m), and the mask of those cells.

    A mixed cell is never below the true ground.
    """
    low, high = minimum_filter(dsm, 3), maximum_filter(dsm, 3)
    chosen = (high - low > WALL_M) & (rng.random(dsm.shape) < share)
    between = np.maximum(low + rng.random(dsm.shape) * (high - low), truth)
    return np.where(chosen, between, dsm), chosen
