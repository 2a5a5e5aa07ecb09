"""A synthetic world: its options, its tiles, and random fields that depend only on seed and location."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.tasks.options import Options
from flexroad.tasks.types import Floats

WEST_M, SOUTH_M = 500_000, 5_600_000
"""South-west corner of a block: on the central meridian of EPSG:25832, a multiple of common tile sizes."""
KEY_OFFSET = 2**31
"""Added to lattice indices, because seeds must not be negative."""


class SceneOptions(Options):
    """Contents of the synthetic world; objects with a default of 0 are absent by default."""

    block_m: float = Field(100.0, ge=20, description="mean distance of parallel streets (m)")
    turn_deg: float | None = Field(
        None, ge=0, le=90, description="direction of the streets' lattice; null: drawn from the seed"
    )
    slope: float = Field(0.05, ge=0, le=0.25, description="root mean square slope of the hills")
    roughness_m: float = Field(
        0.6, ge=0, description="root mean square height of the terrain's small humps (m)"
    )
    datum_m: float = Field(160.0, ge=-400, le=8000, description="mean height of the world (m)")
    stream_share: float = Field(
        0.12, ge=0, le=1, description="fraction of the gaps between streets with a stream"
    )
    density: float = Field(1.0, ge=0, le=1, description="fraction of houses, trees and cars that exist")
    mask_errors: float = Field(1.0, ge=0, description="size of the road mask's errors; 0: a perfect mask")
    wobble_m: float = Field(0.5, ge=0, description="root mean square offset of the road mask's edges (m)")
    dsm_noise_m: tuple[float, float] = Field(
        (0.03, 0.1), description="least and greatest noise of a tile's DSM (standard deviation, m)"
    )
    dtm_noise_m: float = Field(0.04, ge=0, description="noise of the DTM (standard deviation, m)")

    embankment_m: float = Field(
        0.0, ge=0, le=5, description="root mean square height of streets above or below the hills (m)"
    )
    cross_slope: float = Field(0.0, ge=0, le=0.08, description="greatest one-sided slope of a street")
    curb_m: float = Field(0.0, ge=0, le=0.3, description="height of pavements over the carriageway (m)")
    medians: float = Field(
        0.0, ge=0, le=1, description="fraction of the main streets that are dual carriageways"
    )
    roundabouts: float = Field(
        0.0, ge=0, le=1, description="fraction of the crossings of main streets that are roundabouts"
    )
    sunken_share: float = Field(
        0.0, ge=0, le=1, description="fraction of the other gaps with a sunken road under bridges"
    )

    built: float = Field(1.0, ge=0, le=1, description="fraction of the stratum's houses that exist")
    storeys: float = Field(1.0, gt=0, le=3, description="height of the eaves, as a factor on the stratum's")
    towers: float = Field(0.0, ge=0, le=2, description="towers, chimneys and high-rises per street")
    overhang_m: float = Field(0.0, ge=0, le=1.5, description="distance that roofs reach beyond the walls (m)")
    trees: float = Field(
        1.0, ge=0, le=20, description="number of trees away from the kerb, as a factor on the stratum's"
    )
    growth_m: float = Field(0.0, ge=0, le=2, description="mean height of hedges, brambles and crops (m)")
    rails: float = Field(0.0, ge=0, le=1, description="fraction of the street sides with a guard rail")
    wires: float = Field(0.0, ge=0, le=1, description="fraction of the streets with an overhead line")
    mixed: float = Field(
        0.0, ge=0, le=1, description="fraction of the cells at walls whose height lies between top and foot"
    )

    voids: float = Field(
        0.0,
        ge=0,
        le=1,
        description="length of the ground hidden beside a crown, per its height, at the edge of an image; "
        "above 0, hidden ground and water have no height in the DSM",
    )

    car_parks: float = Field(0.0, ge=0, le=5, description="car parks per street")
    fields: float = Field(
        0.0, ge=0, le=5, description="bare fields per street that the mask may show as road"
    )
    false_roofs: float = Field(
        0.0, ge=0, le=1, description="fraction of the roofs that the mask shows as road"
    )
    scars_m: float = Field(0.0, ge=0, le=2, description="depth of the DTM's errors under houses (m)")

    patch_m: float = Field(
        0.0, ge=0, le=5, description="side of the image patches that the mask consists of (m); 0: the cells"
    )
    verge_m: float = Field(
        0.0,
        ge=0,
        le=10,
        description="width of the strip beside streets that the mask shows as road, roofs excepted (m)",
    )
    verge_share: float = Field(
        0.5, ge=0, le=1, description="fraction of the streets' length with such a strip"
    )
    open_ground: float = Field(
        0.0,
        ge=0,
        le=1,
        description="fraction of all ground that the mask shows as road, roofs and crowns excepted",
    )
    yards: float = Field(
        0.0, ge=0, le=10, description="paved yards per street that the mask may show as road"
    )
    lean: float = Field(
        0.0, ge=0, le=0.6, description="greatest displacement of roofs in the photograph, per height"
    )
    facades: float = Field(
        0.0, ge=0, le=1, description="fraction of the facades in the photograph that the mask shows as road"
    )
    works: float = Field(
        0.0, ge=0, le=5, description="places per street that changed from the DTM's survey to the DSM's"
    )
    flight_offset_m: float = Field(
        0.0, ge=0, le=1, description="root mean square offset of the DTM from the DSM's survey (m)"
    )


DEFAULTS = SceneOptions()


def block(tiles: int, size_m: int = 250) -> list[tuple[str, Grid]]:
    """Return the ids and grids of a near-square block of neighbouring tiles; the last row may be partial."""
    columns = math.ceil(math.sqrt(tiles))
    rows = math.ceil(tiles / max(columns, 1))
    west, south = WEST_M // size_m * size_m, SOUTH_M // size_m * size_m
    bounds = (west, south, west + columns * size_m, south + rows * size_m)
    return list(islice(Grid.covering("EPSG:25832", bounds, 1.0).tiles(size_m), tiles)) if tiles > 0 else []


def generator(seed: int, purpose: str, *key: int) -> np.random.Generator:
    """Return the random generator of one object of the world; it is the same for every tile."""
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), *(k + KEY_OFFSET for k in key)])


Waves = Callable[[Floats, Floats], Floats]
"""A smooth field (m) at points x and y (m), in their broadcast shape: a sum of plane waves.

It is defined everywhere, so tiles that are evaluated separately join without a step.
"""


def field(seed: int, purpose: str, span_m: tuple[float, float], number: int, rms_m: float = 1.0) -> Waves:
    """Return a field of a root mean square: waves of equal amplitude from the shortest to the longest."""
    lengths = np.geomspace(*span_m, number)
    return waves(generator(seed, purpose), lengths, rms_m * np.sqrt(2 / number))


def waves(rng: np.random.Generator, lengths_m: ArrayLike, amplitudes_m: ArrayLike) -> Waves:
    """Return waves of the given lengths and amplitudes with random directions and phases."""
    lengths, amplitudes = np.broadcast_arrays(
        np.asarray(lengths_m, np.float64), np.asarray(amplitudes_m, np.float64)
    )
    heading = rng.uniform(0, 2 * np.pi, lengths.size)
    wavevectors = (2 * np.pi / lengths)[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    phases = rng.uniform(0, 2 * np.pi, lengths.size)

    def at(x: Floats, y: Floats) -> Floats:
        total = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
        for (kx, ky), phase, amplitude in zip(wavevectors, phases, amplitudes, strict=True):
            total += amplitude * np.sin(kx * x + ky * y + phase)
        return total

    return at
