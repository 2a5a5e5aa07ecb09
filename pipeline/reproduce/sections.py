"""Tables of the comparison with the paper, with cells formatted as text."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pandas as pd

from flexroad.pipeline.report.content import FIGURES
from flexroad.pipeline.reproduce.bootstrap import Means
from flexroad.pipeline.reproduce.claims import Verdict
from flexroad.pipeline.reproduce.published import Row

GROUPS = (("l2_road_m", "l2_terrain_m"), ("mad_road_deg", "mad_terrain_deg"), ("triangles",))
"""Figures that share a table; all five in one table would be wider than a page."""


@dataclass(frozen=True, eq=False)
class Section:
    """One table of the page with its heading."""

    title: str
    table: pd.DataFrame
    line: str = ""
    """The data of the table, if not the page's main data."""


def side_by_side(
    name: str, rows: tuple[Row, ...], ours: Mapping[str, Means], line: str = ""
) -> Iterator[Section]:
    """Yield a table of the paper with our figures beside it, one section per group of figures.

    Parameters
    ----------
    name : str
        Name of the table, the first part of the titles.
    rows : tuple of Row
        The paper's rows; every variant is in `ours`.
    ours : Mapping[str, Means]
        Our means by column name; the difference from the paper is added if there is only one. A variant that
        a column lacks has a dash there.
    line : str
        The data of the table, if not the page's main data.
    """
    for figures in GROUPS:
        table = pd.DataFrame({"variant": [row.label for row in rows]})
        for figure in figures:
            label, paper = FIGURES[figure], [row.value(figure) for row in rows]
            table[f"{label}, paper"] = [format_figure(value, figure) for value in paper]
            for column, means in ours.items():
                table[f"{label}, {column}"] = [_with_interval(means, row.variant, figure) for row in rows]
            if len(ours) == 1:
                (means,) = ours.values()
                values = [means.mean[row.variant, figure] for row in rows]
                table[f"{label}, difference"] = [
                    format_difference(a - b, figure) for a, b in zip(values, paper, strict=True)
                ]
        yield Section(f"{name}: {label_without_unit(figures[0]).split()[0]}", table, line)


def numbers(name: str, rows: tuple[Row, ...], classes: str, means: Means, data: str) -> pd.DataFrame:
    """Return every number of a table, one per row, unrounded."""
    records = []
    for row in rows:
        for figure in FIGURES:
            paper, ours = row.value(figure), means.mean[row.variant, figure]
            low, high = means.interval(row.variant, figure)
            records.append(
                (name, row.label, row.variant, classes, figure, paper, ours, low, high, ours - paper, data)
            )
    columns = "table label variant classes figure paper ours low high difference data".split()
    return pd.DataFrame(records, columns=columns)


def verdicts_table(verdicts: Mapping[str, list[Verdict]]) -> pd.DataFrame:
    """Return claims with their verdicts: all columns for the first run, two columns for each other run."""
    first, *others = verdicts.values()
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
    for name, other in zip(list(verdicts)[1:], others, strict=True):
        table[f"ours, {name}"] = [v.ours for v in other]
        table[f"verdict, {name}"] = [v.verdict for v in other]
    return table


def label_without_unit(figure: str) -> str:
    """Return a figure's label without the unit."""
    return FIGURES[figure].split(" (")[0]


def format_figure(value: float, figure: str) -> str:
    """Return a figure as text."""
    if not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if figure == "triangles" else f"{value:.3f}"


def format_difference(value: float, figure: str) -> str:
    """Return a difference as text, with its sign."""
    if not math.isfinite(value):
        return "–"
    # Adding 0 turns -0.0 into 0.0.
    return f"{value:+,.0f}" if figure == "triangles" else f"{round(value, 3) + 0:+.3f}"


def _with_interval(means: Means, variant: str, figure: str) -> str:
    if variant not in means.variants:
        return "–"
    low, high = means.interval(variant, figure)
    mean, low_text, high_text = (
        format_figure(value, figure) for value in (means.mean[variant, figure], low, high)
    )
    return f"{mean} [{low_text}, {high_text}]"
