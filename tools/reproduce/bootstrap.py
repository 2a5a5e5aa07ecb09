"""Bootstrap confidence intervals of means over tiles.

Tiles are drawn with replacement, the same tiles for every variant, so that intervals of differences and
ratios between variants use the pairing (Efron & Tibshirani, An Introduction to the Bootstrap, 1993).
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
"""Confidence level of the intervals (percent)."""


@dataclass(frozen=True, eq=False)
class Means:
    """Means over tiles and over resampled tiles."""

    mean: dict[tuple[str, str], float]
    """By (variant, figure); NaN if no tile has the figure."""
    resampled: dict[tuple[str, str], Floats]
    """Means of the resamples by (variant, figure), ``(RESAMPLES,)``."""

    @property
    def variants(self) -> frozenset[str]:
        """Names of the variants."""
        return frozenset(variant for variant, _ in self.mean)

    def interval(self, variant: str, figure: str) -> tuple[float, float]:
        """Return the percentile interval of a mean."""
        return interval(self.resampled[variant, figure])

    def ratio(self, variant: str, base: str, figure: str) -> tuple[float, Floats]:
        """Return the ratio of two variants' means and its resamples; NaN or infinite if `base` is 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            mean_ratio = np.divide(self.mean[variant, figure], self.mean[base, figure])
            return float(mean_ratio), self.resampled[variant, figure] / self.resampled[base, figure]


def interval(values: Floats) -> tuple[float, float]:
    """Return the percentile interval of resampled values; NaN if none is finite."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return float("nan"), float("nan")
    tail = (100 - LEVEL) / 2
    low, high = np.percentile(finite, [tail, 100 - tail])
    return float(low), float(high)


def bootstrap(figures: pd.DataFrame) -> Means:
    """Average the figures over the tiles and over resamples of the tiles.

    - `figures`: one row per ``(tile_id, variant)``, every tile with every variant. NaN figures (a tile
      without road) are left out of the mean.
    """
    table = figures.reset_index().pivot(index="tile_id", columns="variant", values=list(figures))
    values = table.to_numpy(dtype=np.float64)
    valid = np.isfinite(values)
    draws = _draws(len(values))
    with np.errstate(invalid="ignore"):
        means = np.where(valid, values, 0).sum(axis=0) / valid.sum(axis=0)
        resampled = (draws @ np.where(valid, values, 0)) / (draws @ valid)
    names = [(str(pair[1]), str(pair[0])) for pair in table.columns.to_list()]
    return Means(dict(zip(names, means.tolist(), strict=True)), dict(zip(names, resampled.T, strict=True)))


def _draws(tiles: int) -> NDArray[np.float64]:
    """Return how often each resample contains each tile, ``(RESAMPLES, tiles)``."""
    rng = np.random.default_rng(SEED)
    return rng.multinomial(tiles, np.full(tiles, 1 / tiles), size=RESAMPLES).astype(np.float64)
