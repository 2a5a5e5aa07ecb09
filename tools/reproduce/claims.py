"""The test of the paper's claims on a run, and the bootstrap confidence intervals for it.

Tiles are drawn with replacement, the same tiles for every variant. So intervals of differences and ratios
between variants use the pairing (Efron & Tibshirani, An Introduction to the Bootstrap, 1993).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd

from flexroad.tasks.types import Floats
from flexroad.tools.reproduce.published import GEROD, Claim, T, published

HELD, WEAKER, STRONGER, NOT_HELD = "held", "weaker", "stronger", "not held"
NOT_DECIDED, NOT_TESTED = "not decided", "not tested"
REACH = 2.0
"""A change is stronger if its log ratio is more than `REACH` times the paper's, weaker below 1 / `REACH`."""
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
    """Return the percentile interval of resampled values; NaN if all are infinite or NaN."""
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
    # Number of times that each resample contains each tile.
    draws = np.random.default_rng(SEED).multinomial(
        len(values), np.full(len(values), 1 / len(values)), size=RESAMPLES
    )
    draws = draws.astype(np.float64)
    with np.errstate(invalid="ignore"):
        means = np.where(valid, values, 0).sum(axis=0) / valid.sum(axis=0)
        resampled = (draws @ np.where(valid, values, 0)) / (draws @ valid)
    names = [(str(pair[1]), str(pair[0])) for pair in table.columns.to_list()]
    return Means(dict(zip(names, means.tolist(), strict=True)), dict(zip(names, resampled.T, strict=True)))


@dataclass(frozen=True)
class Verdict:
    """A claim with the paper's figures, a run's figures and the result of the test."""

    claim: Claim
    paper: str
    """The paper's figures, from its tables."""
    ours: str
    """The run's figures; "–" if not tested."""
    certainty: str
    """Share of resamples with the same order; or interval of the change, and share with the same verdict."""
    verdict: str


def check(claim: Claim, means: Means, dataset: str = GEROD) -> Verdict:
    """Test a claim on a run.

    An order is "held" if the means over tiles are in that order. A change is "held" if it has the paper's
    sign and the logarithm of its ratio is between half and twice the value in the paper's tables; below that
    range it is weaker, above it stronger. If fewer than `LEVEL` percent of the resamples give the same
    verdict, it is replaced by "not decided".

    - `dataset`: the paper's dataset that the run is compared with; claims about other datasets are not
      tested.
    """
    paper = [published(name, claim.dataset).value(claim.figure) for name in claim.variants]
    if claim.dataset != dataset or not means.variants.issuperset(claim.variants):
        printed = _ordered(claim.figure, paper) if claim.quoted is None else percent(paper[1] / paper[0])
        return Verdict(claim, printed, "–", "–", NOT_TESTED)
    if claim.quoted is None:
        return _check_order(claim, paper, means)
    return _check_change(claim, paper[1] / paper[0], means)


def percent(ratio: float) -> str:
    """Return a ratio as a change in percent: 2.11 is +111%."""
    change = 100 * (ratio - 1)
    if not math.isfinite(change):
        return "–"
    # Adding 0 turns -0.0 into 0.0.
    return f"{change:+.0f}%" if abs(change) >= 10 else f"{round(change, 1) + 0:+.1f}%"


def _check_order(claim: Claim, paper: list[float], means: Means) -> Verdict:
    ours = [means.mean[name, claim.figure] for name in claim.variants]
    resampled = np.array([means.resampled[name, claim.figure] for name in claim.variants])
    within = 1 + claim.slack
    holds = all(a <= b * within for a, b in pairwise(ours))
    share = float((resampled[:-1] <= resampled[1:] * within).all(axis=0).mean())
    return Verdict(
        claim,
        _ordered(claim.figure, paper),
        _ordered(claim.figure, ours),
        f"{100 * share:.0f}% of resamples",
        _if_certain(HELD if holds else NOT_HELD, share if holds else 1 - share),
    )


def _check_change(claim: Claim, paper: float, means: Means) -> Verdict:
    base, variant = claim.variants
    ratio, resampled = means.ratio(variant, base, claim.figure)
    low, high = interval(resampled)
    verdict = strength(ratio, paper)
    share = _share(verdict, paper, resampled)
    certainty = f"{percent(low)} to {percent(high)}, {100 * share:.0f}% of resamples"
    return Verdict(claim, percent(paper), percent(ratio), certainty, _if_certain(verdict, share))


def strength(ratio: float, paper: float) -> str:
    """Compare our ratio with the paper's: held, weaker, stronger, not held or not tested."""
    if not (math.isfinite(ratio) and ratio > 0):
        return NOT_TESTED
    relative = math.log(ratio) / math.log(paper)
    if relative <= 0:
        return NOT_HELD
    return STRONGER if relative > REACH else WEAKER if relative < 1 / REACH else HELD


def decided(verdict: str, paper: float, resampled: Floats) -> bool:
    """Return whether enough resampled ratios give the same verdict."""
    return _if_certain(verdict, _share(verdict, paper, resampled)) == verdict


def _share(verdict: str, paper: float, resampled: Floats) -> float:
    """Return the share of resampled ratios with this verdict."""
    return float(np.mean([strength(float(ratio), paper) == verdict for ratio in resampled]))


def _if_certain(verdict: str, share: float) -> str:
    return verdict if verdict == NOT_TESTED or 100 * share >= LEVEL else NOT_DECIDED


def _ordered(figure: str, values: list[float]) -> str:
    """Return the values with "<", "=" or ">" between neighbours."""
    texts = [f"{value:,.0f}" if figure == T else f"{value:.3f}" for value in values]
    signs = ["<" if a < b else "=" if a == b else ">" for a, b in pairwise(values)]
    return " ".join([texts[0], *(part for pair in zip(signs, texts[1:], strict=True) for part in pair)])
