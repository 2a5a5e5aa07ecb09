"""One table of a comparison with the paper, its cells as they are printed."""

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
"""Figures that stand side by side; all five with three numbers each are wider than a page."""


@dataclass(frozen=True, eq=False)
class Section:
    """One table of the page."""

    title: str
    table: pd.DataFrame
    line: str = ""
    """What data it is about, where that is not the page's."""


def beside(name: str, rows: tuple[Row, ...], ours: Mapping[str, Means], line: str = "") -> Iterator[Section]:
    """Yield a table of the paper with ours beside it, by kind of figure.

    Parameters
    ----------
    name : str
        The table's.
    rows : tuple of Row
        The paper's, each with a variant of ours.
    ours : Mapping[str, Means]
        Ours by what the columns call it; the difference is told if there is one only.
    line : str
        What data it is about, where that is not the page's.
    """
    for figures in GROUPS:
        table = pd.DataFrame({"variant": [row.label for row in rows]})
        for figure in figures:
            label, paper = FIGURES[figure], [row.value(figure) for row in rows]
            table[f"{label}, paper"] = [shown(value, figure) for value in paper]
            for called, means in ours.items():
                table[f"{label}, {called}"] = [_with_interval(means, row.variant, figure) for row in rows]
            if len(ours) == 1:
                (means,) = ours.values()
                found = [means.mean[row.variant, figure] for row in rows]
                table[f"{label}, difference"] = [
                    signed(a - b, figure) for a, b in zip(found, paper, strict=True)
                ]
        yield Section(f"{name}: {short(figures[0]).split()[0]}", table, line)


def numbers(name: str, rows: tuple[Row, ...], classes: str, means: Means, data: str) -> pd.DataFrame:
    """Return every number of a table, one a row, unrounded."""
    found = []
    for row in rows:
        for figure in FIGURES:
            paper, ours = row.value(figure), means.mean[row.variant, figure]
            low, high = means.interval(row.variant, figure)
            found.append(
                (name, row.label, row.variant, classes, figure, paper, ours, low, high, ours - paper, data)
            )
    columns = "table label variant classes figure paper ours low high difference data".split()
    return pd.DataFrame(found, columns=columns)


def verdicts_table(verdicts: Mapping[str, list[Verdict]]) -> pd.DataFrame:
    """Return claims with their verdicts: of the first run in full, of others by what they are called."""
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
    for called, other in zip(list(verdicts)[1:], others, strict=True):
        table[f"ours, {called}"] = [v.ours for v in other]
        table[f"verdict, {called}"] = [v.verdict for v in other]
    return table


def short(figure: str) -> str:
    """Return a figure's name without its unit."""
    return FIGURES[figure].split(" (")[0]


def shown(value: float, figure: str) -> str:
    """Return a figure as it is printed."""
    if not math.isfinite(value):
        return "–"
    return f"{value:,.0f}" if figure == "triangles" else f"{value:.3f}"


def signed(value: float, figure: str) -> str:
    """Return a difference as it is printed."""
    if not math.isfinite(value):
        return "–"
    # Adding 0 makes a rounded -0.0 plain 0.0.
    return f"{value:+,.0f}" if figure == "triangles" else f"{round(value, 3) + 0:+.3f}"


def _with_interval(means: Means, variant: str, figure: str) -> str:
    low, high = means.interval(variant, figure)
    return f"{shown(means.mean[variant, figure], figure)} [{shown(low, figure)}, {shown(high, figure)}]"
