"""Quality of a road mask: counts of cells against the truth, and distances between edges in metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats

STEPS = 100
"""Number of threshold steps of the precision-recall curve: every hundredth."""


@dataclass(frozen=True, eq=False)
class Quality:
    """Counts of cells of one or more tiles; counts of tiles can be added."""

    right: int
    """True positives: cells that are road in mask and truth."""
    wrong: int
    """False positives: cells that are road in the mask only."""
    missed: int
    """False negatives: cells that are road in the truth only."""
    ground: int
    """True negatives: cells that are road in neither."""
    road_by_probability: NDArray[np.int64]
    """True road cells per hundredth of probability, ``(101,)``; zeros without probabilities."""
    ground_by_probability: NDArray[np.int64]
    """Other cells of the truth per hundredth of probability, ``(101,)``."""
    edge_m: Floats
    """Distances from edge points of the mask to the nearest of the truth, and vice versa, ``(n,)``, m."""

    @property
    def iou(self) -> float:
        """Intersection over union of the road; NaN without road."""
        return _ratio(self.right, self.right + self.wrong + self.missed)

    @property
    def precision(self) -> float:
        """Share of the mask's road cells that are road in the truth."""
        return _ratio(self.right, self.right + self.wrong)

    @property
    def recall(self) -> float:
        """Share of the true road cells that are in the mask."""
        return _ratio(self.right, self.right + self.missed)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return _ratio(2 * self.right, 2 * self.right + self.wrong + self.missed)

    @property
    def edge_mean_m(self) -> float:
        """Mean distance between the edges, in both directions; NaN if mask or truth has no edge."""
        return float(self.edge_m.mean()) if self.edge_m.size else float("nan")

    @property
    def edge_p95_m(self) -> float:
        """95th percentile of that distance."""
        return float(np.percentile(self.edge_m, 95)) if self.edge_m.size else float("nan")

    def curve(self) -> tuple[Floats, Floats, Floats]:
        """Return thresholds, precision and recall, ``(101,)`` each; road is probability >= threshold."""
        right, wrong = (
            np.cumsum(counts[::-1])[::-1] for counts in (self.road_by_probability, self.ground_by_probability)
        )
        with np.errstate(invalid="ignore"):
            return np.arange(STEPS + 1) / STEPS, right / (right + wrong), right / right[0]


def judge(
    mask: Bools, probability: Floats | NDArray[np.float32] | None, truth: Bools, valid: Bools, grid: Grid
) -> Quality:
    """Compare a mask with the truth.

    - `mask`, `truth`: road cells, ``(H, W)``.
    - `probability`: probability of road, ``(H, W)``, 0 to 1.
    - `valid`: cells to compare, ``(H, W)``; an edge is used if both its cells are valid.
    """
    none = np.zeros(STEPS + 1, np.int64)
    road = ground = none
    if probability is not None:
        share = np.nan_to_num(np.asarray(probability, np.float64))
        level = np.floor(share * STEPS + 1e-4).astype(np.intp).clip(0, STEPS)
        road = np.bincount(level[valid & truth], minlength=STEPS + 1)
        ground = np.bincount(level[valid & ~truth], minlength=STEPS + 1)
    return Quality(
        right=int(np.count_nonzero(valid & mask & truth)),
        wrong=int(np.count_nonzero(valid & mask & ~truth)),
        missed=int(np.count_nonzero(valid & ~mask & truth)),
        ground=int(np.count_nonzero(valid & ~mask & ~truth)),
        road_by_probability=road,
        ground_by_probability=ground,
        edge_m=_between(edges(mask, valid), edges(truth, valid)) * grid.cell,
    )


def together(parts: Iterable[Quality]) -> Quality:
    """Return the sum of the counts of several tiles, at least one."""
    tiles = [vars(tile) for tile in parts]
    edge_m = np.concatenate([tile["edge_m"] for tile in tiles])
    summed = {name: sum(tile[name] for tile in tiles) for name in tiles[0] if name != "edge_m"}
    return Quality(**summed, edge_m=edge_m)


def edges(mask: Bools, valid: Bools) -> Floats:
    """Return the middles of the sides between road and no road, ``(n, 2)``: row and column in cells."""
    upright = (mask[:, 1:] != mask[:, :-1]) & valid[:, 1:] & valid[:, :-1]
    level = (mask[1:] != mask[:-1]) & valid[1:] & valid[:-1]
    beside, below = np.array([0.0, 0.5]), np.array([0.5, 0.0])
    return np.concatenate([np.argwhere(upright) + beside, np.argwhere(level) + below])


def _between(a: Floats, b: Floats) -> Floats:
    """Return the distances from each point to the nearest point of the other set; empty if a set is empty."""
    if not (len(a) and len(b)):
        return np.zeros(0)
    return np.concatenate([cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]])


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
