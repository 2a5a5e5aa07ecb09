"""The benchmark: independent tiles in the strata of the paper's dataset GeRoD, with the errors of real tiles.

``docs/results/causes.md``, section 7, compares the numbers with the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flexroad.catalog.grid import Grid
from flexroad.tools.synthetic.world import SOUTH_M, WEST_M, SceneOptions, generator

STRATA = {"urban": 168, "suburban": 23, "rural": 49}
"""Tiles of the complete benchmark, as in the paper."""
TILES = sum(STRATA.values())
SIZE_M = 250
APART_M = 3000
"""Distance between tile corners (m): more than the longest wave of the hills, so tiles are independent."""
COLUMNS = 16
VARIED = {"block_m": 0.2, "slope": 0.4, "roughness_m": 0.3, "built": 0.3, "trees": 0.4, "growth_m": 0.3}
"""Variation of tiles within a stratum: greatest relative deviation from its options."""

_SHARED: Mapping[str, Any] = {
    "slope": 0.122,
    "dsm_noise_m": (0.04, 0.1),
    "towers": 0.2,
    "mixed": 0.25,
    "scars_m": 0.25,
}
_WORLDS: Mapping[str, SceneOptions] = {
    "urban": SceneOptions(
        **_SHARED,
        block_m=102,
        density=0.9,
        roughness_m=0.6,
        stream_share=0.06,
        embankment_m=0.2,
        cross_slope=0.02,
        curb_m=0.12,
        medians=0.2,
        roundabouts=0.08,
        sunken_share=0.06,
        built=0.43,
        storeys=0.6,
        overhang_m=0.4,
        growth_m=0.7,
        rails=0.03,
        wires=0.1,
        car_parks=0.12,
    ),
    "suburban": SceneOptions(
        **_SHARED,
        block_m=95,
        density=0.85,
        roughness_m=0.7,
        stream_share=0.08,
        embankment_m=0.3,
        cross_slope=0.025,
        curb_m=0.1,
        medians=0.05,
        roundabouts=0.1,
        sunken_share=0.03,
        built=0.53,
        overhang_m=0.5,
        trees=1.2,
        growth_m=0.75,
        rails=0.03,
        wires=0.3,
        car_parks=0.06,
        fields=0.03,
    ),
    "rural": SceneOptions(
        **_SHARED,
        block_m=110,
        density=0.9,
        roughness_m=1.0,
        stream_share=0.15,
        embankment_m=0.8,
        cross_slope=0.04,
        medians=0.1,
        roundabouts=0.06,
        sunken_share=0.06,
        built=0.63,
        overhang_m=0.5,
        trees=2.5,
        growth_m=0.85,
        rails=0.15,
        wires=0.25,
        car_parks=0.02,
        fields=0.15,
    ),
}
"""Mean contents of the tiles of each stratum.

``built`` was fitted to RGT on terrain, 1.773 m; ``docs/results/causes.md``, section 7, explains the others.
"""

ERRORS: Mapping[str, float] = {
    # A patch of DINOv2 has 14 pixels; a pixel of the orthophotos of Geobasis NRW has 0.1 m.
    "patch_m": 1.4,
    # The pavement of these scenes is 2.2 m wide. Its share in the mask follows from T, with the yards.
    "verge_m": 2.2,
    "verge_share": 0.9,
    # T = 33,447, which needs a mask of 26%.
    "yards": 4.0,
    # Roofs are displaced by 1 to 2 m: a field of view of 28 degrees. The paper has no figure for it.
    "lean": 0.25,
    # RGT on roads, L2 and MAD: high objects that the mask wrongly shows as road.
    "facades": 0.04,
    "false_roofs": 0.005,
    # Assumed: a new surface every 20 years, and surveys 5 years apart. The paper has no figure for it.
    "works": 0.25,
    # The paper's 10 cm of error of its height models, taken as two standard deviations.
    "flight_offset_m": 0.05,
    # The published DSM has 14.482 of 15.0 million cells: 3.5% have no height.
    "voids": 0.4,
}
"""Errors of the masks and of the DTM, the same in all strata, with the figure to which each was fitted.

RGT and Plane, T and the mask's share depend only on the data and the mask. FlexRoad's accuracy was not used.
"""

PRESET: Mapping[str, SceneOptions] = {
    stratum: options.model_copy(update=ERRORS) for stratum, options in _WORLDS.items()
}
"""Mean options of the tiles of each stratum."""


def survey(tiles: int = TILES, seed: int = 0) -> list[tuple[str, Grid, str, SceneOptions]]:
    """Return id, grid, stratum and options of the benchmark's tiles, in the paper's shares of the strata.

    The tiles of a smaller survey are a subset of the tiles of a larger survey. They lie on the absolute grid,
    3 km apart.

    - `tiles`: number of tiles; 240 as in the paper.
    """
    return [
        _place(row, stratum, number, seed)
        for row, (stratum, count) in enumerate(zip(STRATA, _counts(tiles), strict=True))
        for number in range(count)
    ]


def _counts(tiles: int) -> list[int]:
    """Return the number of tiles of each stratum, by the largest remainder method."""
    exact = [tiles * share / TILES for share in STRATA.values()]
    counts = [int(number) for number in exact]
    by_rest = sorted(range(len(exact)), key=lambda i: counts[i] - exact[i])
    for i in by_rest[: tiles - sum(counts)]:
        counts[i] += 1
    return counts


def _place(row: int, stratum: str, number: int, seed: int) -> tuple[str, Grid, str, SceneOptions]:
    down, along = divmod(number, COLUMNS)
    west = WEST_M + along * APART_M
    south = SOUTH_M + (down * len(STRATA) + row) * APART_M
    grid = Grid("EPSG:25832", west, south + SIZE_M, 1.0, SIZE_M, SIZE_M)
    options, rng = PRESET[stratum].model_dump(), generator(seed, "gerod", row, number)
    for name, spread in VARIED.items():
        options[name] *= 1 + rng.uniform(-spread, spread)
    options["turn_deg"] = rng.uniform(0, 90)
    return f"{west}_{south}", grid, stratum, SceneOptions(**options)
