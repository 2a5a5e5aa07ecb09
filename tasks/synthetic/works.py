"""What changed between two surveys: new road surfaces, new kerbs, excavations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.synthetic.network import Street
from flexroad.tasks.synthetic.noise import generator
from flexroad.tasks.types import Floats

KINDS = ("surface", "kerb", "excavation")
LENGTH_M = {"surface": (30.0, 100.0), "kerb": (8.0, 30.0), "excavation": (4.0, 20.0)}
RISE_M = {"surface": (0.02, 0.06), "kerb": (0.10, 0.15), "excavation": (-2.0, -0.6)}
PAVEMENT_M = 2.2
"""Width of the carriageway's edge that a new kerb takes (m)."""
TRENCH_M = (1.5, 4.0)
"""Width of an excavation (m)."""
BESIDE_M = 3.0
"""Greatest distance of an excavation's middle from the carriageway (m)."""


@dataclass(frozen=True)
class Change:
    """A stretch of a street whose height changed; lengths in m along and across the centre line."""

    street: Street
    start: float
    end: float
    left: float
    right: float
    rise: float
    """Height of the later survey over the earlier one."""


def changes(streets: Sequence[Street], seed: int, mean: float) -> tuple[Change, ...]:
    """Return the changes of some streets, ``mean`` per street on average."""
    return tuple(change for street in streets for change in _of(street, seed, mean)) if mean > 0 else ()


def _of(street: Street, seed: int, mean: float) -> list[Change]:
    rng = generator(seed, "works", *street.key)
    return [_drawn(street, str(rng.choice(KINDS)), rng) for _ in range(rng.poisson(mean))]


def _drawn(street: Street, kind: str, rng: np.random.Generator) -> Change:
    half, side = street.half_width_m, rng.choice((-1, 1))
    length, rise = rng.uniform(*LENGTH_M[kind]), rng.uniform(*RISE_M[kind])
    start = rng.uniform(street.start, max(street.end - length, street.start))
    if kind == "surface":
        left, right = -half, half
    elif kind == "kerb":
        left, right = sorted((side * (half - PAVEMENT_M), side * half))
    else:
        middle, width = rng.uniform(-1, 1) * (half + BESIDE_M), rng.uniform(*TRENCH_M)
        left, right = middle - width / 2, middle + width / 2
    return Change(street, start, min(start + length, street.end), left, right, rise)


def rise(found: Sequence[Change], x: Floats, y: Floats) -> Floats:
    """Return by how much the later survey's ground is higher at points in the plan's frame (m)."""
    total = np.zeros(np.shape(x))
    for change in found:
        along, _ = change.street.foot(x, y)
        lateral = change.street.lateral(x, y, along)
        inside = (along >= change.start) & (along <= change.end)
        inside &= (lateral >= change.left) & (lateral <= change.right)
        # Beyond a street's ends the foot stays at the end.
        inside &= (along > change.street.start) & (along < change.street.end)
        total[inside] = change.rise
    return total
