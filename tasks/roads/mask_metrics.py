"""How good a mask is: counts of cells against the truth, and distances between edges in metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats

STEPS = 100
"""Thresholds of the precision-recall curve: every hundredth."""


@dataclass(frozen=True, eq=False)
class Quality:
    """What was counted on some cells; adds up over tiles."""

    right: int
    """Road that was found."""
    wrong: int
    """Found, but no road."""
    missed: int
    """Road that was not found."""
    ground: int
    """No road, and none found."""
    road_by_probability: NDArray[np.int64]
    """Road cells with a probability in each hundredth, ``(101,)``; zeros where there was none."""
    ground_by_probability: NDArray[np.int64]
    edge_m: Floats
    """From each piece of the found edge to the nearest of the true one and the other way round (m)."""

    @property
    def iou(self) -> float:
        """Intersection over union of the road; NaN where there is none."""
        return _ratio(self.right, self.right + self.wrong + self.missed)

    @property
    def precision(self) -> float:
        """Share of what was found that is road."""
        return _ratio(self.right, self.right + self.wrong)

    @property
    def recall(self) -> float:
        """Share of the road that was found."""
        return _ratio(self.right, self.right + self.missed)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return _ratio(2 * self.right, 2 * self.right + self.wrong + self.missed)

    @property
    def edge_mean_m(self) -> float:
        """Mean distance between the edges, both ways; NaN where one mask has none."""
        return float(self.edge_m.mean()) if self.edge_m.size else float("nan")

    @property
    def edge_p95_m(self) -> float:
        """95th percentile of that distance."""
        return float(np.percentile(self.edge_m, 95)) if self.edge_m.size else float("nan")

    def curve(self) -> tuple[Floats, Floats, Floats]:
        """Return thresholds, precision and recall, ``(101,)`` each, for masks of what reaches a threshold."""
        right, wrong = (
            np.cumsum(counts[::-1])[::-1] for counts in (self.road_by_probability, self.ground_by_probability)
        )
        with np.errstate(invalid="ignore"):
            return np.arange(STEPS + 1) / STEPS, right / (right + wrong), right / right[0]


def judge(
    found: Bools, probability: Floats | NDArray[np.float32] | None, truth: Bools, known: Bools, grid: Grid
) -> Quality:
    """Hold a mask against the truth.

    Parameters
    ----------
    found, truth : Bools
        Road cells, ``(H, W)``.
    probability : array, optional
        Of road, ``(H, W)``, 0 to 1.
    known : Bools
        Cells that count, ``(H, W)``; edges count between two of them.
    grid : Grid
        The cells.
    """
    none = np.zeros(STEPS + 1, np.int64)
    road = ground = none
    if probability is not None:
        share = np.nan_to_num(np.asarray(probability, np.float64))
        level = np.floor(share * STEPS + 1e-4).astype(np.intp).clip(0, STEPS)
        road = np.bincount(level[known & truth], minlength=STEPS + 1)
        ground = np.bincount(level[known & ~truth], minlength=STEPS + 1)
    return Quality(
        right=int(np.count_nonzero(known & found & truth)),
        wrong=int(np.count_nonzero(known & found & ~truth)),
        missed=int(np.count_nonzero(known & ~found & truth)),
        ground=int(np.count_nonzero(known & ~found & ~truth)),
        road_by_probability=road,
        ground_by_probability=ground,
        edge_m=_between(edges(found, known), edges(truth, known)) * grid.cell,
    )


def together(parts: Iterable[Quality]) -> Quality:
    """Return what was counted on several tiles, at least one, as one."""
    of = list(parts)
    return Quality(
        right=sum(part.right for part in of),
        wrong=sum(part.wrong for part in of),
        missed=sum(part.missed for part in of),
        ground=sum(part.ground for part in of),
        road_by_probability=np.sum([part.road_by_probability for part in of], axis=0),
        ground_by_probability=np.sum([part.ground_by_probability for part in of], axis=0),
        edge_m=np.concatenate([part.edge_m for part in of]),
    )


def edges(mask: Bools, known: Bools) -> Floats:
    """Return the middles of the sides between road and no road, ``(n, 2)``: row and column in cells."""
    upright = (mask[:, 1:] != mask[:, :-1]) & known[:, 1:] & known[:, :-1]
    level = (mask[1:] != mask[:-1]) & known[1:] & known[:-1]
    beside, below = np.array([0.0, 0.5]), np.array([0.5, 0.0])
    return np.concatenate([np.argwhere(upright) + beside, np.argwhere(level) + below])


def _between(a: Floats, b: Floats) -> Floats:
    """Return the distance from each point to the nearest of the others, both ways; empty if one is."""
    if not (len(a) and len(b)):
        return np.zeros(0)
    there, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return np.concatenate([there, back])


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
