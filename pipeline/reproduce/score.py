"""How close the changes of Table II are to the paper's, cell by cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import pandas as pd

from flexroad.pipeline.reproduce.bootstrap import LEVEL, Means
from flexroad.pipeline.reproduce.claims import (
    HELD,
    NOT_DECIDED,
    NOT_HELD,
    NOT_TESTED,
    STRONGER,
    WEAKER,
    decided,
    percent,
    strength,
)
from flexroad.pipeline.reproduce.published import BASE, Row
from flexroad.pipeline.reproduce.sections import Section, label_without_unit

FIGURES_SCORED = ("l2_road_m", "l2_terrain_m", "mad_road_deg", "mad_terrain_deg")
"""Without T, which depends on the mask and the sampling alone."""
LEAST = 0.05
"""Changes of the paper up to this size are not scored: their sign is no statement."""
KINDS = {HELD: "within", WEAKER: "weaker", STRONGER: "stronger", NOT_HELD: "opposite or flat"}
REASONS = {
    ("wo_dynamic", "l2_road_m"): "The same surface, sampled at the same points on roads.",
    ("wo_dynamic", "l2_terrain_m"): "The same surface, sampled at 1 m instead of 10 m: it is followed more "
    "closely. That it becomes less accurate does not follow from the paper's text.",
    ("wo_nurbs", "mad_terrain_deg"): "The DTM at 1 m against triangles of 10 m: the DTM of the benchmark is "
    "smooth, so the triangles meet at larger angles.",
    ("wo_dtm", "mad_terrain_deg"): "Without the DTM the regulariser alone shapes the terrain: it is flatter. "
    "The paper does not say what shapes it there.",
}
"""Why a change of the benchmark has another sign than the paper's, by variant and figure."""


@dataclass(frozen=True)
class Change:
    """One cell of Table II as a change from the full pipeline, and ours."""

    row: Row
    figure: str
    paper: float
    """The paper's ratio to the full pipeline."""
    ours: float
    verdict: str
    """`HELD`, `WEAKER`, `STRONGER` or `NOT_HELD`, by the rule for claims."""
    certain: bool
    """Whether enough resamples of the tiles give this verdict."""


def changes(rows: tuple[Row, ...], means: Means) -> list[Change]:
    """Return the changes of Table II that exceed `LEAST` in the paper."""
    base = next(row for row in rows if row.variant == BASE)
    scored = []
    for row in rows:
        for figure in FIGURES_SCORED:
            paper = row.value(figure) / base.value(figure)
            if row is base or abs(paper - 1) <= LEAST:
                continue
            ours, resampled = means.ratio(row.variant, BASE, figure)
            verdict = strength(ours, paper)
            if verdict != NOT_TESTED:
                certain = decided(verdict, paper, resampled)
                scored.append(Change(row, figure, paper, ours, verdict, certain))
    return scored


def score_sections(rows: tuple[Row, ...], means: Means) -> tuple[Section, ...]:
    """Return the counts of the changes by figure, and the list of those that are opposite or flat."""
    scored = changes(rows, means)
    if not scored:
        return ()
    counts = pd.DataFrame([_counts(f"{label_without_unit(f)}", [c for c in scored if c.figure == f])
                           for f in FIGURES_SCORED] + [_counts("all", scored)])  # fmt: skip
    verdicts = Counter(change.verdict for change in scored)
    kinds = ", ".join(f"{verdicts[kind]} {name}" for kind, name in KINDS.items())
    line = (
        f"{len(scored)} changes of L2 and MAD by more than {LEAST:.0%} in the paper: {kinds}. Within: the "
        "logarithm of our ratio is between half and twice that of the paper's; weaker: below; stronger: "
        "above; opposite or flat: no change or one of the other sign. Not decided: of these, the changes for "
        f"which fewer than {LEVEL}% of the resamples give the same answer."
    )
    sections = [Section("Table II: how close the changes are", counts, line)]
    opposite = [change for change in scored if change.verdict == NOT_HELD]
    if opposite:
        table = pd.DataFrame([_opposite(change) for change in opposite])
        sections.append(Section("Table II: changes that are opposite or flat", table))
    return tuple(sections)


def _counts(name: str, scored: list[Change]) -> dict[str, str]:
    verdicts = Counter(change.verdict for change in scored)
    undecided = sum(not change.certain for change in scored)
    cells = {"figure": name, "changes": len(scored)}
    cells |= {column: verdicts[kind] for kind, column in KINDS.items()} | {NOT_DECIDED: undecided}
    return {column: str(value) for column, value in cells.items()}


def _opposite(change: Change) -> dict[str, str]:
    return {
        "variant": change.row.label,
        "figure": label_without_unit(change.figure),
        "paper": percent(change.paper),
        "ours": percent(change.ours),
        "reason": REASONS.get((change.row.variant, change.figure), "–"),
    }
