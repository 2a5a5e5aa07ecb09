"""What a reconstruction from photographs makes of a surface: melted, bumpy, with holes.

Photographs show no wall twice from the side and no point of a plain surface twice at all. So edges run out
into slopes, cars and trees stand on the ground like drops of wax, asphalt is uneven, and what was never
seen is bridged by a smooth sheet or left open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from scipy.stats import norm

from flexroad.catalog.grid import Grid
from flexroad.tasks import options as base
from flexroad.tasks.synthetic.noise import generator, waves
from flexroad.tasks.synthetic.scene import Scene
from flexroad.tasks.synthetic.spoilers import Kind
from flexroad.tasks.types import Bools, Floats

BUMP_M = (1.5, 15.0)
"""Shortest and longest bump."""
BLANK_M = (4.0, 20.0)
"""Shortest and longest wave of the field that says where a surface is blank."""
PLAIN = (Kind.GROUND, Kind.DECK, Kind.PAVED, Kind.BUILDING)
"""What can look alike all over: asphalt, where it is road, and flat roofs."""
OVERHEAD_M, ALLEY_M = 4.0, 2.0
"""Ground is out of sight within this distance of what stands so much higher."""
GHOST = 0.25
"""Part of its height that is left of what moved between the photographs."""


class Faults(base.Options):
    """How badly a surface is reconstructed."""

    melt_m: float = Field(0.6, ge=0, le=3, description="Gaussian smoothing of all edges (m)")
    bumps_m: float = Field(0.04, ge=0, le=1, description="root mean square height of bumps (m)")
    blank: float = Field(0.04, ge=0, lt=1, description="part of the plain surfaces without a match")
    hidden: float = Field(0.3, ge=0, lt=1, description="part of the ground at walls that no photograph shows")
    bridged_m2: float = Field(8.0, ge=0, description="smaller holes are always bridged (m2)")
    open: float = Field(0.3, ge=0, le=1, description="part of the larger holes that stays open")
    fragments: int = Field(8, ge=0, description="pieces of surface that float in the air")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A surface as photographs give it, on the lattice of the scene it was made of."""

    grid: Grid
    height: Floats
    """``(H, W)``, m; defined in open holes, too."""
    bridged: Bools
    """Holes under a smooth sheet, ``(H, W)``."""
    open: Bools
    """Holes without a surface, ``(H, W)``."""


def reconstruct(scene: Scene, seed: int, faults: Faults) -> Reconstruction:
    """Return a scene's surface with the faults of a reconstruction.

    Parameters
    ----------
    scene : Scene
        Without noise of its own; cells of half a metre show cars and walls.
    seed : int
        The world; bumps and blanks are functions of it and of the place.
    faults : Faults
        How bad it is.
    """
    grid = scene.grid
    melted = ndimage.gaussian_filter(_seen(scene), faults.melt_m / grid.cell, mode="nearest")
    uneven = melted + _bumps(grid, seed, faults.bumps_m)
    lost = _blank(scene, seed, faults.blank) | _hidden(scene, seed, faults.hidden)
    opened = _left_open(lost, grid, seed, faults)
    bridged = lost & ~opened
    return Reconstruction(grid, _bridge(uneven, bridged), bridged, opened)


def _seen(scene: Scene) -> Floats:
    """Return the surface that stood still; leaves are seen as one hull."""
    moved = scene.kind == Kind.MOVING_CAR
    ghost = scene.reference + GHOST * (scene.dsm - scene.reference)
    surface = np.where(moved, ghost, scene.dsm)
    leaves = np.isin(scene.kind, (Kind.CROWN, Kind.PLANTS))
    # Gaps between leaves are cells of other kinds, and closed from above.
    hull = ndimage.median_filter(ndimage.grey_closing(surface, 3), 3)
    hulled: Floats = np.where(ndimage.binary_closing(leaves, iterations=1) | leaves, hull, surface)
    return hulled


def _bumps(grid: Grid, seed: int, rms_m: float) -> Floats:
    """Return bumps of mean square ``rms_m``, in some places twice as high as in others."""
    x, y = np.meshgrid(grid.eastings, grid.northings)
    lengths = np.geomspace(*BUMP_M, 40)
    bumps = waves(generator(seed, "bumps"), lengths, np.sqrt(2 / lengths.size))(x, y)
    patchy = np.exp(waves(generator(seed, "matching"), np.geomspace(15, 80, 9), 0.15)(x, y))
    uneven: Floats = rms_m * patchy / np.sqrt(np.mean(patchy**2)) * bumps
    return uneven


def _blank(scene: Scene, seed: int, share: float) -> Bools:
    """Return where asphalt and flat roofs have nothing to match."""
    south, east = np.gradient(scene.dsm, scene.grid.cell)
    plain = np.isin(scene.kind, PLAIN) & (np.hypot(south, east) < 0.3)
    plain &= scene.reference_road | np.isin(scene.kind, (Kind.PAVED, Kind.BUILDING))
    blank: Bools = plain & _patches(scene.grid, seed, "blank", share)
    return blank


def _hidden(scene: Scene, seed: int, share: float) -> Bools:
    """Return the ground at walls and under eaves that no camera looked at."""
    reach = 2 * round(ALLEY_M / scene.grid.cell) + 1
    beside = ndimage.maximum_filter(scene.dsm, reach) - scene.dsm > OVERHEAD_M
    low = scene.dsm - scene.reference < 1
    hidden: Bools = beside & low & _patches(scene.grid, seed, "hidden", share)
    return hidden


def _patches(grid: Grid, seed: int, purpose: str, share: float) -> Bools:
    """Return patches that cover about the share of the ground."""
    x, y = np.meshgrid(grid.eastings, grid.northings)
    lengths = np.geomspace(*BLANK_M, 24)
    field = waves(generator(seed, purpose), lengths, np.sqrt(2 / lengths.size))(x, y)
    covered: Bools = field > norm.isf(share)
    return covered


def _left_open(lost: Bools, grid: Grid, seed: int, faults: Faults) -> Bools:
    """Return the holes that are not bridged: a part of the large ones."""
    numbers: NDArray[np.int32]
    numbers, count = ndimage.label(lost)
    area = np.bincount(numbers.ravel(), minlength=count + 1) * grid.cell**2
    drawn = generator(seed, "open", *map(int, grid.origin)).random(count + 1) < faults.open
    left = drawn & (area > faults.bridged_m2)
    left[0] = False
    opened: Bools = left[numbers]
    return opened


def _bridge(height: Floats, holes: Bools) -> Floats:
    """Return the heights with a smooth sheet over holes, spanned from their rims."""
    from rasterio.fill import fillnodata

    span = float(np.hypot(*height.shape))
    # float32 is good for millimetres only near zero.
    base_m = float(height.mean())
    filled = fillnodata((height - base_m).astype(np.float32), ~holes, span, smoothing_iterations=2)
    return np.where(holes, filled + base_m, height)
