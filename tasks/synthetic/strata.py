"""The strata urban, suburban and rural, and the districts they are assigned to."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.errors import TaskError
from flexroad.tasks.synthetic.noise import generator

Range = tuple[float, float]

DISTRICT_M = 250
"""Side of a district, a square of one stratum (m): a tile of the usual size lies in one."""


@dataclass(frozen=True)
class Stratum:
    """Density of buildings, traffic and vegetation in an area."""

    name: str
    share: float
    """Fraction of the districts."""
    side_streets: float
    """Fraction of the possible side streets that exist; main streets always exist."""
    main_width_m: Range
    side_width_m: Range
    lot_m: Range
    """Street front of a lot (m)."""
    built: float
    """Fraction of the lots with a house."""
    gap_m: Range
    """Gap between neighbouring houses (m); 0 for terraced houses."""
    setback_m: Range
    """Distance from the carriageway's edge to the facade (m)."""
    depth_m: Range
    eaves_m: Range
    """Height of the eaves over the ground (m)."""
    flat_roofs: float
    """Fraction of the houses with a flat roof."""
    parked: float
    """Fraction of the parking slots with a car."""
    moving: float
    """Moving cars per street."""
    avenues: float
    """Fraction of the street sides with a row of trees."""
    garden_trees: float
    """Trees per street away from the kerb."""


STRATA = {
    stratum.name: stratum
    for stratum in (
        Stratum("urban", 0.7, 0.85, (12, 16), (8, 11), (13, 22), 0.88, (0, 0), (1.2, 4), (10, 13), (9, 19),
                0.35, 0.5, 1.5, 0.5, 8),
        Stratum("suburban", 0.1, 0.7, (9, 12), (6.5, 8), (17, 24), 0.85, (5, 10), (4, 8), (9, 12), (4, 7),
                0.1, 0.25, 0.6, 0.35, 12),
        Stratum("rural", 0.2, 0.2, (8, 11), (5, 6.5), (25, 45), 0.2, (8, 20), (5, 14), (9, 16), (3.5, 7),
                0.05, 0.02, 0.4, 0.4, 6),
    )
}  # fmt: skip
"""Strata by name; the fractions are those of the paper's 168, 23 and 49 tiles."""


def find_stratum(name: str) -> Stratum:
    """Return the stratum with a name.

    Raises
    ------
    TaskError
        If the name is unknown.
    """
    if name not in STRATA:
        raise TaskError(f"no stratum {name!r}; there are {', '.join(STRATA)}")
    return STRATA[name]


def stratum_at(seed: int, easting: float, northing: float) -> Stratum:
    """Return the stratum of the district at a point."""
    key = math.floor(easting / DISTRICT_M), math.floor(northing / DISTRICT_M)
    shares = np.cumsum([stratum.share for stratum in STRATA.values()])
    index = int(np.searchsorted(shares, generator(seed, "stratum", *key).random(), side="right"))
    return list(STRATA.values())[min(index, len(STRATA) - 1)]
