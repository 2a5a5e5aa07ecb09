"""A laser scan of a scene: points on its surface with a scanner's noise."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from flexroad.tasks.acquire.points.binning import bins
from flexroad.tasks.acquire.types import Points
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.scene import Scene
from flexroad.tasks.synthetic.spoilers import BARE

GROUND, DECK, OTHER = 2, 17, 1
"""Classes by ASPRS LAS 1.4; what is neither ground nor deck is unclassified."""
DECK_M = 0.5
"""The true surface is a deck where it is this much above the terrain model (m)."""


def scan(scene: Scene, per_m2: float, noise_m: float, seed: int = 0) -> Points:
    """Return points on a scene's surface, at random positions.

    Heights are those of the true ground, linear between cell centres, plus what stands on the point's cell.

    Parameters
    ----------
    scene : Scene
        A scene without noise of its own (`SceneOptions.dsm_noise_m`).
    per_m2 : float
        Number of points per m2.
    noise_m : float
        Standard deviation of their heights (m).
    seed : int
        Seed of positions and noise.
    """
    grid, rng = scene.grid, generator(seed, "scan", *map(int, scene.grid.origin))
    west, south, east, north = grid.bounds
    number = round(per_m2 * (east - west) * (north - south))
    easting, northing = rng.uniform(west, east, number), rng.uniform(south, north, number)
    at = (north - northing) / grid.cell - 0.5, (easting - west) / grid.cell - 0.5
    ground = map_coordinates(scene.reference, at, order=1, mode="nearest")
    cells = bins(easting, northing, grid)
    bare = np.isin(scene.kind, BARE)
    above = np.where(bare, 0.0, scene.dsm - scene.reference).ravel()[cells]
    deck = bare & (scene.reference - scene.dtm > DECK_M)
    kind = np.where(deck, DECK, np.where(bare, GROUND, OTHER)).astype(np.uint8).ravel()[cells]
    return Points(easting, northing, ground + above + noise_m * rng.standard_normal(number), kind)
