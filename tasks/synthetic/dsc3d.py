"""The stand-in for the paper's dataset DSC3D: five urban scenes, from level to steep.

The paper tells of five scenes with meshes of 35 to 101 thousand triangles, and differences in height from
4.5 m to 33.9 m. Its table gives RGT 45 thousand triangles, which is a square of 150 m in cells of a metre.
What the numbers were held against, and what not, is told in ``docs/decisions.md`` ("the stand-in").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import count

import numpy as np
from scipy.optimize import brentq

from flexroad.catalog.grid import Grid
from flexroad.tasks.synthetic.layout import SOUTH_M, WEST_M
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.synthetic.options import SceneOptions
from flexroad.tasks.synthetic.reconstruction import Faults
from flexroad.tasks.synthetic.scene import make_scene

CRS = "EPSG:32632"
"""UTM as such, which is what DSC3D's own meshes are placed by."""
SIZE_M = 150
APART_M = 3000
"""Between scenes, as in the benchmark: farther than the hills' longest wave."""
STEEPEST = 0.2
"""Greatest root mean square slope of a scene's hills."""
HUMPS, BANKS = 0.1, 0.05
"""Root mean square height of a scene's humps and of its embankments, of its rise."""
COARSE_M = 3.0
"""Cells in which a place is looked at before a scene is laid there."""


@dataclass(frozen=True)
class Site:
    """What one of the scenes is like, wherever it lies."""

    name: str
    stratum: str
    rise_m: float
    """Height difference of its true ground."""
    triangles: int
    """Of its mesh."""
    options: SceneOptions
    """Slope, humps, embankments and direction follow from the rise and the place."""
    faults: Faults


TOWN = SceneOptions(
    block_m=75,
    density=0.7,
    stream_share=0.0,
    dsm_noise_m=(0.0, 0.0),
    cross_slope=0.02,
    curb_m=0.12,
    built=0.8,
    storeys=0.8,
    overhang_m=0.4,
    trees=1.5,
    growth_m=0.7,
    car_parks=0.1,
)
SUBURB = TOWN.model_copy(update={"block_m": 80, "built": 1.0, "storeys": 1.0})

SITES = (
    Site("boulevard", "urban", 4.5, 101_000, TOWN.model_copy(update={"block_m": 90.0}), Faults()),
    Site("courtyards", "urban", 8.0, 78_000, TOWN.model_copy(update={"built": 1.0}), Faults(hidden=0.45)),
    Site("garden_suburb", "suburban", 14.0, 35_000, SUBURB, Faults()),
    Site("hillside", "suburban", 23.0, 46_000, SUBURB, Faults()),
    Site("steep_quarter", "urban", 33.9, 60_000, TOWN, Faults(blank=0.06)),
)
"""Ends of the ranges are the paper's; what lies between, and which scene is what, are guesses."""


@dataclass(frozen=True)
class Place:
    """One of the scenes in a world."""

    site: Site
    grid: Grid
    """Its cells of a metre."""
    options: SceneOptions


def survey(scenes: int = len(SITES), seed: int = 0) -> list[Place]:
    """Return where the first of the scenes lie in a world.

    A scene lies at the first place of its row where hills that are not too steep rise as much as it asks
    for; how steep they must be follows.

    Parameters
    ----------
    scenes : int
        How many of `SITES`.
    seed : int
        The world.
    """
    return [_settle(row, site, seed) for row, site in enumerate(SITES[:scenes])]


def _settle(row: int, site: Site, seed: int) -> Place:
    for number in count():
        west, south = WEST_M + number * APART_M, SOUTH_M - (row + 1) * APART_M
        turn = generator(seed, "dsc3d", row, number).uniform(0, 90)
        turned = _with(
            site.options, turn_deg=turn, roughness_m=HUMPS * site.rise_m, embankment_m=BANKS * site.rise_m
        )
        excess = partial(_excess, site, turned, _square(west, south, COARSE_M), seed)
        if excess(0.0) < 0 < excess(STEEPEST):
            slope = brentq(excess, 0.0, STEEPEST, xtol=1e-4)
            return Place(site, _square(west, south, 1.0), _with(turned, slope=slope))
    raise AssertionError("places go on for ever")


def _excess(site: Site, options: SceneOptions, grid: Grid, seed: int, slope: float) -> float:
    """Return by how much the ground of a place rises more than asked for (m), hills being so steep."""
    empty = _with(options, slope=slope, density=0.0)
    return float(np.ptp(make_scene(grid, seed, site.stratum, empty).reference)) - site.rise_m


def _square(west: float, south: float, cell: float) -> Grid:
    cells = round(SIZE_M / cell)
    return Grid(CRS, west, south + SIZE_M, cell, cells, cells)


def _with(options: SceneOptions, **changed: float) -> SceneOptions:
    return SceneOptions(**options.model_dump() | changed)
