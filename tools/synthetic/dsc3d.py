"""The stand-in for the paper's dataset DSC3D: five urban scenes, from level to steep.

The paper describes five scenes with meshes of 35 to 101 thousand triangles and height differences of 4.5 m to
33.9 m. Its table gives RGT 45 thousand triangles: a square of 150 m with cells of 1 m. ``docs/decisions.md``
("the stand-in") lists which numbers were checked, and against what.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import count

import numpy as np
from scipy.optimize import brentq

from flexroad.catalog.grid import Grid
from flexroad.tools.synthetic.layout import SOUTH_M, WEST_M
from flexroad.tools.synthetic.noise import generator
from flexroad.tools.synthetic.options import SceneOptions
from flexroad.tools.synthetic.reconstruction import Faults
from flexroad.tools.synthetic.scene import true_height

CRS = "EPSG:32632"
"""UTM zone 32 on WGS 84, as for DSC3D's own meshes."""
SIZE_M = 150
APART_M = 3000
"""Distance between scenes (m), as in the benchmark: more than the longest wave of the hills."""
STEEPEST = 0.2
"""Greatest root mean square slope of a scene's hills."""
HUMPS, BANKS = 0.1, 0.05
"""Root mean square height of a scene's humps and embankments, as fractions of its rise."""
COARSE_M = 3.0
"""Cell size used to check whether a location suits a scene (m)."""


@dataclass(frozen=True)
class Site:
    """Properties of one scene, independent of its location."""

    name: str
    stratum: str
    rise_m: float
    """Height difference of its true ground (m)."""
    triangles: int
    """Number of triangles of its mesh."""
    options: SceneOptions
    """Slope, humps, embankments and direction are set from the rise and the location."""
    faults: Faults


TOWN = SceneOptions(
    block_m=75,
    density=0.7,
    stream_share=0.0,
    dsm_noise_m=(0.0, 0.0),
    cross_slope=0.02,
    curb_m=0.12,
    # T = 40K of RGT's 45K: the mask covers 89%, so it is all ground between roofs and crowns.
    open_ground=1.0,
    built=0.45,
    trees=0.6,
    # RGT on terrain, 15.411 m: what is no road are roofs and crowns alone.
    storeys=1.5,
    overhang_m=0.4,
    # RGT's road MAD, now that lawns count as road.
    growth_m=0.1,
    car_parks=0.1,
)
SUBURB = TOWN.model_copy(update={"block_m": 80, "storeys": 2.2})

SITES = (
    Site("boulevard", "urban", 4.5, 101_000, TOWN.model_copy(update={"block_m": 90.0}), Faults()),
    Site("courtyards", "urban", 8.0, 78_000, TOWN.model_copy(update={"built": 0.5}), Faults(hidden=0.2)),
    Site("garden_suburb", "suburban", 14.0, 35_000, SUBURB, Faults()),
    Site("hillside", "suburban", 23.0, 46_000, SUBURB, Faults()),
    Site("steep_quarter", "urban", 33.9, 60_000, TOWN, Faults(blank=0.06)),
)
"""The ends of the ranges are the paper's; the values between them and their order are assumptions."""


@dataclass(frozen=True)
class Place:
    """A scene at its location in a world."""

    site: Site
    grid: Grid
    """Its grid with cells of 1 m."""
    options: SceneOptions


def survey(scenes: int = len(SITES), seed: int = 0) -> list[Place]:
    """Return the locations of the first ``scenes`` scenes in a world.

    A scene takes the first location of its row where hills of at most slope `STEEPEST` give its rise. The
    slope is then set so that they give exactly its rise.

    - `scenes`: number of scenes, the first of `SITES`.
    """
    return [_locate(row, site, seed) for row, site in enumerate(SITES[:scenes])]


def _locate(row: int, site: Site, seed: int) -> Place:
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
    raise AssertionError("unreachable: the loop has no end")


def _excess(site: Site, options: SceneOptions, grid: Grid, seed: int, slope: float) -> float:
    """Return the rise of the ground at a location minus the rise of the site (m), for a slope."""
    empty = _with(options, slope=slope, density=0.0)
    return float(np.ptp(true_height(grid, seed, site.stratum, empty))) - site.rise_m


def _square(west: float, south: float, cell: float) -> Grid:
    cells = round(SIZE_M / cell)
    return Grid(CRS, west, south + SIZE_M, cell, cells, cells)


def _with(options: SceneOptions, **changed: float) -> SceneOptions:
    return SceneOptions(**options.model_dump() | changed)
