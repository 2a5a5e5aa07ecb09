"""Faults of a photogrammetric reconstruction: smoothed edges, bumps and holes.

Walls are seen at flat angles only, and uniform surfaces give no matching points. So edges become slopes, cars
and trees become smooth bumps, asphalt becomes uneven, and areas without matches are bridged by a smooth
surface or left open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage
from scipy.special import ndtri

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks import options as base
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.synthetic.noise import generator, waves
from flexroad.tools.synthetic.scene import Scene
from flexroad.tools.synthetic.spoilers import Kind

rasterio = lazy("rasterio")

BUMP_M = (1.5, 15.0)
"""Shortest and longest wave of the bumps (m)."""
BLANK_M = (4.0, 20.0)
"""Shortest and longest wave of the random field that places areas without matches (m)."""
TEXTURELESS = (Kind.GROUND, Kind.DECK, Kind.PAVED, Kind.BUILDING)
"""Kinds that may have no texture: asphalt (on roads and car parks) and flat roofs."""
OVERHEAD_M, ALLEY_M = 4.0, 2.0
"""Ground may be hidden within `ALLEY_M` of a surface that is `OVERHEAD_M` higher (m)."""
GHOST = 0.25
"""Fraction of the height of moving objects that remains."""


class Faults(base.Options):
    """Size of the faults of a reconstruction."""

    melt_m: float = Field(0.6, ge=0, le=3, description="Gaussian smoothing of all edges (m)")
    bumps_m: float = Field(0.04, ge=0, le=1, description="root mean square height of bumps (m)")
    blank: float = Field(
        0.04, ge=0, lt=1, description="fraction of the surfaces without texture that have no matches"
    )
    # RGT on roads, 0.195 m: ground bridged at walls is too high, and the mask covers it.
    hidden: float = Field(
        0.1, ge=0, lt=1, description="fraction of the ground at walls that no photograph shows"
    )
    bridged_m2: float = Field(8.0, ge=0, description="area up to which holes are always bridged (m2)")
    open: float = Field(0.3, ge=0, le=1, description="fraction of the larger holes that stay open")
    fragments: int = Field(8, ge=0, description="number of floating pieces of surface")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed surface, on the lattice of its scene."""

    grid: Grid
    height: Floats
    """``(H, W)``, m; also defined in open holes."""
    bridged: Bools
    """Holes filled by a smooth surface, ``(H, W)``."""
    open: Bools
    """Holes without a surface, ``(H, W)``."""


def reconstruct(scene: Scene, seed: int, faults: Faults) -> Reconstruction:
    """Return a scene's surface with the faults of a reconstruction.

    - `scene`: a scene without noise; cells of 0.5 m resolve cars and walls.
    - `seed`: seed of the world; bumps and holes are functions of seed and coordinates.
    """
    grid = scene.grid
    smoothed = ndimage.gaussian_filter(_static_surface(scene), faults.melt_m / grid.cell, mode="nearest")
    uneven = smoothed + _bumps(grid, seed, faults.bumps_m)
    holes = _textureless(scene, seed, faults.blank) | _hidden(scene, seed, faults.hidden)
    still_open = _open_holes(holes, grid, seed, faults)
    bridged = holes & ~still_open
    return Reconstruction(grid, _bridge(uneven, bridged), bridged, still_open)


def _static_surface(scene: Scene) -> Floats:
    """Return the surface with moving cars lowered and tree crowns closed to a hull."""
    moved = scene.kind == Kind.MOVING_CAR
    ghost = scene.reference + GHOST * (scene.dsm - scene.reference)
    surface = np.where(moved, ghost, scene.dsm)
    leaves = np.isin(scene.kind, (Kind.CROWN, Kind.PLANTS))
    # Gaps between leaves are cells of other kinds; they are closed from above.
    hull = ndimage.median_filter(ndimage.grey_closing(surface, 3), 3)
    hulled: Floats = np.where(ndimage.binary_closing(leaves, iterations=1) | leaves, hull, surface)
    return hulled


def _bumps(grid: Grid, seed: int, rms_m: float) -> Floats:
    """Return bumps of root mean square ``rms_m`` (m), higher in some areas than in others."""
    x, y = np.meshgrid(grid.eastings, grid.northings)
    lengths = np.geomspace(*BUMP_M, 40)
    bumps = waves(generator(seed, "bumps"), lengths, np.sqrt(2 / lengths.size))(x, y)
    patchy = np.exp(waves(generator(seed, "matching"), np.geomspace(15, 80, 9), 0.15)(x, y))
    uneven: Floats = rms_m * patchy / np.sqrt(np.mean(patchy**2)) * bumps
    return uneven


def _textureless(scene: Scene, seed: int, share: float) -> Bools:
    """Return the cells of asphalt and flat roofs without matches, ``(H, W)``."""
    south, east = np.gradient(scene.dsm, scene.grid.cell)
    plain = np.isin(scene.kind, TEXTURELESS) & (np.hypot(south, east) < 0.3)
    plain &= scene.reference_road | np.isin(scene.kind, (Kind.PAVED, Kind.BUILDING))
    blank: Bools = plain & _patches(scene.grid, seed, "blank", share)
    return blank


def _hidden(scene: Scene, seed: int, share: float) -> Bools:
    """Return the cells of ground at walls and under eaves that no photograph shows, ``(H, W)``."""
    reach = 2 * round(ALLEY_M / scene.grid.cell) + 1
    near_wall = ndimage.maximum_filter(scene.dsm, reach) - scene.dsm > OVERHEAD_M
    low = scene.dsm - scene.reference < 1
    hidden: Bools = near_wall & low & _patches(scene.grid, seed, "hidden", share)
    return hidden


def _patches(grid: Grid, seed: int, purpose: str, share: float) -> Bools:
    """Return random patches that cover about a fraction ``share`` of the grid, ``(H, W)``."""
    x, y = np.meshgrid(grid.eastings, grid.northings)
    lengths = np.geomspace(*BLANK_M, 24)
    field = waves(generator(seed, purpose), lengths, np.sqrt(2 / lengths.size))(x, y)
    covered: Bools = field > -ndtri(share)
    return covered


def _open_holes(holes: Bools, grid: Grid, seed: int, faults: Faults) -> Bools:
    """Return the holes that stay open: a fraction of the large ones, ``(H, W)``."""
    numbers: NDArray[np.int32]
    numbers, count = ndimage.label(holes)
    area = np.bincount(numbers.ravel(), minlength=count + 1) * grid.cell**2
    drawn = generator(seed, "open", *map(int, grid.origin)).random(count + 1) < faults.open
    stays_open = drawn & (area > faults.bridged_m2)
    stays_open[0] = False
    cells: Bools = stays_open[numbers]
    return cells


def _bridge(height: Floats, holes: Bools) -> Floats:
    """Return the heights with a smooth surface in the holes, interpolated from their rims."""
    span = float(np.hypot(*height.shape))
    # float32 resolves millimetres only near 0.
    base_m = float(height.mean())
    filled = rasterio.fill.fillnodata(
        (height - base_m).astype(np.float32), ~holes, span, smoothing_iterations=2
    )
    return np.where(holes, filled + base_m, height)
