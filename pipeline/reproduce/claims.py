"""The claims that the paper's text makes about its tables, and their test on a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from flexroad.pipeline.reproduce.bootstrap import LEVEL, Means, interval
from flexroad.pipeline.reproduce.published import BASE, DSC3D, GEROD, published
from flexroad.tasks.types import Floats

HELD, WEAKER, STRONGER, NOT_HELD = "held", "weaker", "stronger", "not held"
NOT_DECIDED, NOT_TESTED = "not decided", "not tested"
REACH = 2.0
"""A change is stronger if its log ratio is more than `REACH` times the paper's, weaker below 1 / `REACH`."""


@dataclass(frozen=True)
class Order:
    """A claim that variants are in ascending order of a figure."""

    text: str
    where: str
    """Section of the paper that makes the claim."""
    figure: str
    ascending: tuple[str, ...]
    slack: float = 0.0
    """Relative amount by which a value may exceed the next (for claims such as "without loss")."""
    dataset: str = GEROD


@dataclass(frozen=True)
class Change:
    """A claim about a figure's relative change from `base` to `variant`."""

    text: str
    where: str
    figure: str
    variant: str
    quoted: float
    """Change in percent, as quoted in the paper's text."""
    base: str = BASE
    dataset: str = GEROD


Claim = Order | Change

RESULTS, ABLATION, CONCLUSION = "Comparative Analysis", "Ablation Study", "Conclusion"
ROAD, TERRAIN, MAD_ROAD, MAD_TERRAIN, T = (
    "l2_road_m",
    "l2_terrain_m",
    "mad_road_deg",
    "mad_terrain_deg",
    "triangles",
)

CLAIMS: tuple[Claim, ...] = (
    Order("RGT is the most accurate on roads, a plane the least", RESULTS, ROAD, ("rgt", BASE, "plane")),
    Order(
        "FlexRoad is the most accurate on terrain, a plane the least",
        RESULTS,
        TERRAIN,
        (BASE, "rgt", "plane"),
    ),
    Order("A plane is the smoothest road, RGT the roughest", RESULTS, MAD_ROAD, ("plane", BASE, "rgt")),
    Order("A plane is the smoothest terrain, RGT the roughest", RESULTS, MAD_TERRAIN, ("plane", BASE, "rgt")),
    Order("A plane has the fewest triangles, RGT the most", RESULTS, T, ("plane", BASE, "rgt")),
    Change("On terrain, L2 is 81% below RGT's", RESULTS, TERRAIN, BASE, -81, base="rgt"),
    Change("Terrain MAD falls from RGT's 22.191° to 3.019°", RESULTS, MAD_TERRAIN, BASE, -86, base="rgt"),
    Change("Road L2 is only 16% above RGT's", RESULTS, ROAD, BASE, 16, base="rgt"),
    Change("Road MAD is 93% below RGT's", RESULTS, MAD_ROAD, BASE, -93, base="rgt"),
    Change("Triangles are 73% fewer than RGT's", RESULTS, T, BASE, -73, base="rgt"),
    Change("Road L2 is 76% below a plane's", CONCLUSION, ROAD, BASE, -76, base="plane"),
    Order(
        "DSC3D: FlexRoad is the most accurate on roads", RESULTS, ROAD, (BASE, "rgt", "plane"), dataset=DSC3D
    ),
    Order(
        "DSC3D: FlexRoad is the most accurate on terrain",
        RESULTS,
        TERRAIN,
        (BASE, "plane", "rgt"),
        dataset=DSC3D,
    ),
    Change(
        "DSC3D: roads are 94% smoother than RGT's", RESULTS, MAD_ROAD, BASE, -94, base="rgt", dataset=DSC3D
    ),
    Change(
        "DSC3D: triangles are 11% fewer than RGT's (40K, 45K)",
        RESULTS,
        T,
        BASE,
        -11,
        base="rgt",
        dataset=DSC3D,
    ),
    Change("w/o ECSRC, road L2 rises by 111%", ABLATION, ROAD, "wo_ecsrc", 111),
    Change("w/o ECSRC, road MAD rises by 135%", ABLATION, MAD_ROAD, "wo_ecsrc", 135),
    Change("w/o DTM support, terrain L2 rises by 786%", ABLATION, TERRAIN, "wo_dtm", 786),
    Change("w/o NURBS, road MAD rises by 1507%", ABLATION, MAD_ROAD, "wo_nurbs", 1507),
    Change("w/o NURBS, triangles rise by 271%", ABLATION, T, "wo_nurbs", 271),
    Change("Dynamic sampling removes 73% of the triangles", ABLATION, T, BASE, -73, base="wo_dynamic"),
    Order(
        "Dynamic sampling keeps the road's accuracy (within 5%)",
        ABLATION,
        ROAD,
        (BASE, "wo_dynamic"),
        slack=0.05,
    ),
    Order(
        "Dynamic sampling keeps the terrain's accuracy (within 5%)",
        ABLATION,
        TERRAIN,
        (BASE, "wo_dynamic"),
        slack=0.05,
    ),
    Change("θz = 0.1 m lowers road L2 by 4%", ABLATION, ROAD, "theta_z_0_1", -4),
    Change("θz = 0.1 m lowers road MAD by 19%", ABLATION, MAD_ROAD, "theta_z_0_1", -19),
    Change("Degree 2 lowers road L2 by 18%", ABLATION, ROAD, "degree_2", -18),
    Order("Degree 2 is rougher on roads than 3", ABLATION, MAD_ROAD, (BASE, "degree_2")),
    Order(
        "Higher degrees are less accurate on roads than 3", ABLATION, ROAD, (BASE, "degree_5", "degree_10")
    ),
    Order("Higher degrees are smoother on roads than 3", ABLATION, MAD_ROAD, ("degree_10", "degree_5", BASE)),
    Change("55 × 55 points lower road L2 by 19%", ABLATION, ROAD, "grid_55", -19),
    Change("55 × 55 points raise road MAD by 55%", ABLATION, MAD_ROAD, "grid_55", 55),
    Order(
        "More control points are more accurate on roads",
        ABLATION,
        ROAD,
        ("grid_55", "grid_45", BASE, "grid_25", "grid_15"),
    ),
    Order(
        "More control points are rougher on roads: the trade-off",
        ABLATION,
        MAD_ROAD,
        ("grid_15", "grid_25", BASE, "grid_45", "grid_55"),
    ),
    Change("Sampling at 0.5 m / 5 m lowers road MAD by 49%", ABLATION, MAD_ROAD, "sampling_0_5", -49),
    Change(
        "Sampling at 0.5 m / 5 m doubles the triangles (four times in Table II)",
        ABLATION,
        T,
        "sampling_0_5",
        100,
    ),
    Change("Sampling at 2 m / 20 m removes 75% of the triangles", ABLATION, T, "sampling_2", -75),
    Change("Sampling at 2 m / 20 m doubles the road's MAD", ABLATION, MAD_ROAD, "sampling_2", 100),
    Order("ECSRC contributes: road L2", CONCLUSION, ROAD, (BASE, "wo_ecsrc")),
    Order("DTM support contributes: terrain L2", CONCLUSION, TERRAIN, (BASE, "wo_dtm")),
    Order("NURBS contributes: road MAD", CONCLUSION, MAD_ROAD, (BASE, "wo_nurbs")),
)


@dataclass(frozen=True)
class Verdict:
    """A claim with the paper's figures, a run's figures and the result of the test."""

    claim: Claim
    paper: str
    """The paper's figures, from its tables."""
    ours: str
    """The run's figures; "–" if not tested."""
    certainty: str
    """Share of resamples with the order; or interval of the change, and share with the means' verdict."""
    verdict: str


def check(claim: Claim, means: Means, dataset: str = GEROD) -> Verdict:
    """Test a claim on a run.

    An order holds if the means over tiles are in that order. A change holds if it has the paper's sign and
    the logarithm of its ratio is between half and twice that of the paper's tables; below that range it is
    weaker, above it stronger. Whatever the verdict, it is "not decided" if fewer than `LEVEL` percent of the
    resamples give it.

    Parameters
    ----------
    claim : Claim
        A claim of the paper.
    means : Means
        Means of the run.
    dataset : str
        The paper's dataset that the run is compared with; claims about other datasets are not tested.
    """
    names = claim.ascending if isinstance(claim, Order) else (claim.base, claim.variant)
    paper = [_paper(claim, name) for name in names]
    if claim.dataset != dataset or not means.variants.issuperset(names):
        quoted = _ordered(claim.figure, paper) if isinstance(claim, Order) else percent(paper[1] / paper[0])
        return Verdict(claim, quoted, "–", "–", NOT_TESTED)
    if isinstance(claim, Order):
        return _check_order(claim, paper, means)
    return _check_change(claim, paper[1] / paper[0], means)


def percent(ratio: float) -> str:
    """Return a ratio as a change in percent: 2.11 is +111%."""
    change = 100 * (ratio - 1)
    if not math.isfinite(change):
        return "–"
    # Adding 0 turns -0.0 into 0.0.
    return f"{change:+.0f}%" if abs(change) >= 10 else f"{round(change, 1) + 0:+.1f}%"


def _check_order(claim: Order, paper: list[float], means: Means) -> Verdict:
    ours = [means.mean[name, claim.figure] for name in claim.ascending]
    resampled = np.array([means.resampled[name, claim.figure] for name in claim.ascending])
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


def _check_change(claim: Change, paper: float, means: Means) -> Verdict:
    ratio, resampled = means.ratio(claim.variant, claim.base, claim.figure)
    low, high = interval(resampled)
    verdict = strength(ratio, paper)
    share = _share(verdict, paper, resampled)
    certainty = f"{percent(low)} to {percent(high)}, {100 * share:.0f}% of resamples"
    return Verdict(claim, percent(paper), percent(ratio), certainty, _if_certain(verdict, share))


def strength(ratio: float, paper: float) -> str:
    """Return how our ratio compares with the paper's: held, weaker, stronger, not held or not tested."""
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


def _paper(claim: Claim, variant: str) -> float:
    row = published(variant, claim.dataset)
    if row is None:
        raise KeyError(variant)
    return row.value(claim.figure)


def _ordered(figure: str, values: list[float]) -> str:
    """Return the values with "<", "=" or ">" between neighbours."""
    texts = [f"{value:,.0f}" if figure == T else f"{value:.3f}" for value in values]
    signs = ["<" if a < b else "=" if a == b else ">" for a, b in pairwise(values)]
    return " ".join([texts[0], *(part for pair in zip(signs, texts[1:], strict=True) for part in pair)])
