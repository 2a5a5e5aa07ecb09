"""The paper's Tables I and II with ours beside them: what the pages of `flexroad tables` show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.report.content import FIGURES
from flexroad.pipeline.reproduce.bootstrap import LEVEL, RESAMPLES, Means, bootstrap
from flexroad.pipeline.reproduce.claims import (
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
from flexroad.pipeline.reproduce.dsc3d import of_dsc3d
from flexroad.pipeline.reproduce.metrics_data import MetricsData
from flexroad.pipeline.reproduce.published import BASE, DSC3D, GEROD, TABLE_I, TABLE_I_DSC3D, TABLE_II, Row
from flexroad.pipeline.reproduce.sections import Section, beside, numbers, short, shown, verdicts_table

MASKS = {"segmented": "segmented mask", "reference": "true mask"}


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
    """Every claim with its verdict; those about DSC3D once for each reference."""


def compare(data: MetricsData) -> Comparison:
    """Lay the figures of a run beside the paper's.

    Raises
    ------
    ConfigError
        If there is nothing to compare FlexRoad with.
    """
    paper = DSC3D if data.dataset == DSC3D else GEROD
    tables = {"Table I": TABLE_I_DSC3D} if paper == DSC3D else {"Table I": TABLE_I, "Table II": TABLE_II}
    means = {classes: bootstrap(data.part(classes)) for classes in data.classes}
    head = means[data.classes[0]]
    tables = {
        name: tuple(row for row in rows if row.variant in head.variants) for name, rows in tables.items()
    }
    # A table of the full pipeline alone would say nothing that Table I does not.
    tables = {name: rows for name, rows in tables.items() if {row.variant for row in rows} - {BASE}}
    if not tables:
        raise ConfigError("the run has none of the variants FlexRoad is compared with; use --config ablation")
    other = of_dsc3d(data.dsc3d)
    # Claims about DSC3D have a table of their own where there is something to test them on.
    asked = [claim for claim in CLAIMS if claim.dataset == paper or not data.dsc3d]
    verdicts = {classes: [check(claim, made, paper) for claim in asked] for classes, made in means.items()}
    claims = verdicts_table({MASKS[classes]: found for classes, found in verdicts.items()})
    sections = [
        *(section for name, rows in tables.items() for section in beside(name, rows, {"ours": head})),
        *([_relative(tables["Table II"], head)] if BASE in head.variants and "Table II" in tables else []),
        Section("What the paper claims", claims),
        *other.sections,
        *_other_masks(_union(tables), means),
        *_per_stratum(_union(tables), data),
    ]
    found = [
        numbers(name, rows, classes, made, data.dataset)
        for classes, made in means.items()
        for name, rows in tables.items()
    ]
    return Comparison(
        data.line,
        (*_notes(data, paper, verdicts[data.classes[0]]), *other.notes),
        tuple(sections),
        pd.concat([*found, *other.numbers], ignore_index=True),
        pd.concat([claims.assign(data=data.dataset), *other.claims], ignore_index=True),
    )


def _notes(data: MetricsData, paper: str, verdicts: list[Verdict]) -> Iterator[str]:
    classes = data.classes[0]
    if data.dataset != paper:
        yield (
            f"The paper's figures are on {paper}, ours are not: orders and ratios can be compared, metres "
            "and degrees only as far as the data are alike."
        )
    yield (
        f"Means over tiles; in brackets {LEVEL}% intervals from {RESAMPLES} resamples of the tiles. "
        f"Road is told from terrain by the {MASKS[classes]}."
    )
    kinds = (HELD, WEAKER, STRONGER, NOT_HELD, NOT_TESTED)
    counts = [f"{sum(v.verdict == kind for v in verdicts)} {kind}" for kind in kinds]
    about = f" about {paper}" if len(verdicts) < len(CLAIMS) else ""
    yield (
        f"The paper's {len(verdicts)} claims{about}: {', '.join(counts)}. An order holds if the means are so "
        "ordered. A change holds if it goes the paper's way and its ratio, as a logarithm, is between half "
        "and twice that of the paper's tables; beyond it is weaker or stronger. What other data or variants "
        "would have to show is not tested."
    )


def _union(tables: dict[str, tuple[Row, ...]]) -> tuple[Row, ...]:
    """Return the rows of all tables, each variant once under its last name."""
    return tuple({row.variant: row for rows in tables.values() for row in rows}.values())


def _relative(rows: tuple[Row, ...], means: Means) -> Section:
    base = next(row for row in rows if row.variant == BASE)
    others = [row for row in rows if row is not base]
    table = pd.DataFrame({"variant": [row.label for row in others]})
    for figure in FIGURES:
        table[f"{short(figure)}, paper"] = [percent(row.value(figure) / base.value(figure)) for row in others]
        table[f"{short(figure)}, ours"] = [
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
            values = [shown(made.mean[row.variant, figure], figure) for row in rows]
            table[f"{FIGURES[figure]}, {MASKS[classes]}"] = values
    yield Section("Ours by the segmented and by the true mask", table)


def _per_stratum(rows: tuple[Row, ...], data: MetricsData) -> Iterator[Section]:
    part = data.part(data.classes[0])
    strata = data.tiles.stratum
    for stratum in sorted(set(strata) - {""}):
        chosen = part[part.index.get_level_values("tile_id").isin(strata.index[strata == stratum])]
        if chosen.empty:
            continue
        means = chosen.groupby("variant").mean().to_dict("index")
        table = pd.DataFrame({"variant": [row.label for row in rows]})
        for figure, label in FIGURES.items():
            table[label] = [shown(means[row.variant][figure], figure) for row in rows]
        tiles = len(chosen.index.unique("tile_id"))
        yield Section(f"Ours, {stratum}: {tiles} tile{'s' * (tiles != 1)}", table)
