"""How far a mean over tiles would move with other tiles: the bootstrap.

Tiles are drawn with replacement, the same ones for every variant, so that differences and ratios of variants
are as certain as their pairing makes them (Efron & Tibshirani, An Introduction to the Bootstrap, 1993).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from flexroad.tasks.types import Floats

RESAMPLES = 2000
SEED = 0
LEVEL = 95
"""Percent of the resamples that an interval holds."""


@dataclass(frozen=True, eq=False)
class Means:
    """Means over tiles, and what they would be over resampled tiles."""

    mean: dict[tuple[str, str], float]
    """By variant and figure; NaN where no tile has one."""
    resampled: dict[tuple[str, str], Floats]
    """The same, ``(RESAMPLES,)``."""

    @property
    def variants(self) -> frozenset[str]:
        """Variants there are figures of."""
        return frozenset(variant for variant, _ in self.mean)

    def interval(self, variant: str, figure: str) -> tuple[float, float]:
        """Return the percentile interval of a mean."""
        return interval(self.resampled[variant, figure])

    def ratio(self, variant: str, base: str, figure: str) -> tuple[float, Floats]:
        """Return the ratio of two variants' means, and its resamples; NaN or infinite over nothing."""
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.divide(self.mean[variant, figure], self.mean[base, figure])
            return float(over), self.resampled[variant, figure] / self.resampled[base, figure]


def interval(values: Floats) -> tuple[float, float]:
    """Return the percentile interval of resampled values; NaN if there are none."""
    known = values[np.isfinite(values)]
    if not known.size:
        return float("nan"), float("nan")
    tail = (100 - LEVEL) / 2
    low, high = np.percentile(known, [tail, 100 - tail])
    return float(low), float(high)


def bootstrap(figures: pd.DataFrame) -> Means:
    """Average the figures over tiles, and over tiles drawn with replacement.

    Parameters
    ----------
    figures : DataFrame
        ``(tile, variant)`` -> figures, every tile with every variant; a tile without a figure (no road in
        it) counts for nothing in that figure's mean.
    """
    table = figures.reset_index().pivot(index="tile_id", columns="variant", values=list(figures))
    values = table.to_numpy(dtype=np.float64)
    known = np.isfinite(values)
    draws = _draws(len(values))
    with np.errstate(invalid="ignore"):
        means = np.where(known, values, 0).sum(axis=0) / known.sum(axis=0)
        resampled = (draws @ np.where(known, values, 0)) / (draws @ known)
    names = [(str(pair[1]), str(pair[0])) for pair in table.columns.to_list()]
    return Means(dict(zip(names, means.tolist(), strict=True)), dict(zip(names, resampled.T, strict=True)))


def _draws(tiles: int) -> NDArray[np.float64]:
    """Return how often each tile is drawn, ``(RESAMPLES, tiles)``."""
    rng = np.random.default_rng(SEED)
    return rng.multinomial(tiles, np.full(tiles, 1 / tiles), size=RESAMPLES).astype(np.float64)
