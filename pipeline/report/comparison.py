"""The paper's Tables I and II with ours beside them: what the pages of `flexroad tables` show."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from pipeline.errors import ConfigError
from pipeline.report.bootstrap import LEVEL, RESAMPLES, Means, bootstrap
from pipeline.report.claims import (
    CLAIMS,
    HELD,
    NOT_HELD,
    NOT_TESTED,
    STRONGER,
    WEAKER,
    Verdict,
    check,
    percent,
)
from pipeline.report.content import FIGURES
from pipeline.report.evidence import Evidence
from pipeline.report.published import BASE, DSC3D, GEROD, TABLE_I, TABLE_I_DSC3D, TABLE_II, Row

GROUPS = (("l2_road_m", "l2_terrain_m"), ("mad_road_deg", "mad_terrain_deg"), ("triangles",))
"""Figures that stand side by side; all five with three numbers each are wider than a page."""
MASKS = {"segmented": "segmented mask", "reference": "true mask"}


@dataclass(frozen=True, eq=False)
class Section:
    """One table of the page, its cells as they are printed."""

    title: str
    table: pd.DataFrame


@dataclass(frozen=True, eq=False)
class Comparison:
    """Ours beside the paper's."""

    line: str
    """What data ours came from."""
    notes: tuple[str, ...]
    """How to read the tables."""
    sections: tuple[Section, ...]
    numbers: pd.DataFrame
    """Every number of the tables, one a row, unrounded."""
    claims: pd.DataFrame
    """Every claim with its verdict."""


def compare(evidence: Evidence) -> Comparison:
    """Lay the figures of a run beside the paper's.

    Raises
    ------
    ConfigError
        If there is nothing to compare FlexRoad with.
    """
    paper = DSC3D if evidence.dataset == DSC3D else GEROD
    tables = {"Table I": TABLE_I_DSC3D} if paper == DSC3D else {"Table I": TABLE_I, "Table II": TABLE_II}
    means = {classes: bootstrap(evidence.part(classes)) for classes in evidence.classes}
    head = means[evidence.classes[0]]
    tables = {
        name: tuple(row for row in rows if row.variant in head.variants) for name, rows in tables.items()
    }
    # A table of the full pipeline alone would say nothing that Table I does not.
    tables = {name: rows for name, rows in tables.items() if {row.variant for row in rows} - {BASE}}
    if not tables:
        raise ConfigError("the run has none of the variants FlexRoad is compared with; use --config ablation")
    verdicts = {classes: [check(claim, made, paper) for claim in CLAIMS] for classes, made in means.items()}
    claims = _claims(verdicts)
    sections = [
        *(section for name, rows in tables.items() for section in _beside(name, rows, head)),
        *([_relative(tables["Table II"], head)] if BASE in head.variants and "Table II" in tables else []),
        Section("What the paper claims", claims),
        *_other_masks(_union(tables), means),
        *_per_stratum(_union(tables), evidence),
    ]
    numbers = pd.concat([_numbers(tables, classes, made) for classes, made in means.items()])
    return Comparison(
        evidence.line, tuple(_notes(evidence, paper, verdicts)), tuple(sections), numbers, claims
    )


def _notes(evidence: Evidence, paper: str, verdicts: dict[str, list[Verdict]]) -> Iterator[str]:
    classes = evidence.classes[0]
    if evidence.dataset != paper:
        yield (
            f"The paper's figures are on {paper}, ours are not: orders and ratios can be compared, metres "
            "and degrees only as far as the data are alike."
        )
    yield (
        f"Means over tiles; in brackets {LEVEL}% intervals from {RESAMPLES} resamples of the tiles. "
        f"Road is told from terrain by the {MASKS[classes]}."
    )
    kinds = (HELD, WEAKER, STRONGER, NOT_HELD, NOT_TESTED)
    counts = [f"{sum(v.verdict == kind for v in verdicts[classes])} {kind}" for kind in kinds]
    yield (
        f"The paper's {len(CLAIMS)} claims: {', '.join(counts)}. An order holds if the means are so ordered. "
        "A change holds if it goes the paper's way and its ratio, as a logarithm, is between half and twice "
        "that of the paper's tables; beyond it is weaker or stronger. What other data or variants would have "
        "to show is not tested."
    )


def _union(tables: dict[str, tuple[Row, ...]]) -> tuple[Row, ...]:
    """Return the rows of all tables, each variant once under its last name."""
    return tuple({row.variant: row for rows in tables.values() for row in rows}.values())


def _beside(name: str, rows: tuple[Row, ...], means: Means) -> Iterator[Section]:
    for figures in GROUPS:
        table = pd.DataFrame({"variant": [row.label for row in rows]})
        for figure in figures:
            label = FIGURES[figure]
            ours = [means.mean[row.variant, figure] for row in rows]
            intervals = [means.interval(row.variant, figure) for row in rows]
            paper = [row.value(figure) for row in rows]
            table[f"{label}, paper"] = [_shown(v, figure) for v in paper]
            table[f"{label}, ours"] = [
                f"{_shown(v, figure)} [{_shown(low, figure)}, {_shown(high, figure)}]"
                for v, (low, high) in zip(ours, intervals, strict=True)
            ]
            table[f"{label}, difference"] = [_signed(a - b, figure) for a, b in zip(ours, paper, strict=True)]
        yield Section(f"{name}: {_short(figures[0]).split()[0]}", table)


def _relative(rows: tuple[Row, ...], means: Means) -> Section:
    base = next(row for row in rows if row.variant == BASE)
    others = [row for row in rows if row is not base]
    table = pd.DataFrame({"variant": [row.label for row in others]})
    for figure in FIGURES:
        table[f"{_short(figure)}, paper"] = [
            percent(row.value(figure) / base.value(figure)) for row in others
        ]
        table[f"{_short(figure)}, ours"] = [
            percent(means.ratio(row.variant, BASE, figure)[0]) for row in others
        ]
    return Section("Table II: changes from the full pipeline", table)


def _other_masks(rows: tuple[Row, ...], means: dict[str, Means]) -> Iterator[Section]:
    if len(means) < 2:
        return
    table = pd.DataFrame({"variant": [row.label for row in rows]})
    for figure in FIGURES:
        if figure == "triangles":
            continue
        for classes, made in means.items():
            values = [_shown(made.mean[row.variant, figure], figure) for row in rows]
            table[f"{FIGURES[figure]}, {MASKS[classes]}"] = values
    yield Section("Ours by the segmented and by the true mask", table)


def _per_stratum(rows: tuple[Row, ...], evidence: Evidence) -> Iterator[Section]:
    part = evidence.part(evidence.classes[0])
    strata = evidence.tiles.stratum
    for stratum in sorted(set(strata) - {""}):
        chosen = part[part.index.get_level_values("tile_id").isin(strata.index[strata == stratum])]
        if chosen.empty:
            continue
        means = chosen.groupby("variant").mean().to_dict("index")
        table = pd.DataFrame({"variant": [row.label for row in rows]})
        for figure, label in FIGURES.items():
            table[label] = [_shown(means[row.variant][figure], figure) for row in rows]
        tiles = len(chosen.index.unique("tile_id"))
        yield Section(f"Ours, {stratum}: {tiles} tile{'s' * (tiles != 1)}", table)


def _numbers(tables: dict[str, tuple[Row, ...]], classes: str, means: Means) -> pd.DataFrame:
    found = []
    for name, rows in tables.items():
        for row in rows:
            for figure in FIGURES:
                paper, ours = row.value(figure), means.mean[row.variant, figure]
                low, high = means.interval(row.variant, figure)
                found.append(
                    (name, row.label, row.variant, classes, figure, paper, ours, low, high, ours - paper)
                )
    columns = "table label variant classes figure paper ours low high difference".split()
    return pd.DataFrame(found, columns=columns)


def _claims(verdicts: dict[str, list[Verdict]]) -> pd.DataFrame:
    head, *others = verdicts
    first = verdicts[head]
    table = pd.DataFrame(
        {
            "claim": [v.claim.text for v in first],
            "section": [v.claim.where for v in first],
            "paper": [v.paper for v in first],
            "ours": [v.ours for v in first],
            "certainty": [v.certainty for v in first],
            "verdict": [v.verdict for v in first],
        }
    )
    for classes in others:
        table[f"ours, {MASKS[classes]}"] = [v.ours for v in verdicts[classes]]
        table[f"verdict, {MASKS[classes]}"] = [v.verdict for v in verdicts[classes]]
    return table


def _short(figure: str) -> str:
    """Return a figure's name without its unit."""
    return FIGURES[figure].split(" (")[0]


def _shown(value: float, figure: str) -> str:
    if not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if figure == "triangles" else f"{value:.3f}"


def _signed(value: float, figure: str) -> str:
    if not math.isfinite(value):
        return "–"
    # Adding 0 makes a rounded -0.0 plain 0.0.
    return f"{value:+,.0f}" if figure == "triangles" else f"{round(value, 3) + 0:+.3f}"
