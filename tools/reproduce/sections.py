"""The tables of the comparison with the paper, with cells formatted as text."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from flexroad.catalog.text import count
from flexroad.tools.report.content import FIGURES
from flexroad.tools.report.pages import Section
from flexroad.tools.reproduce.claims import (
    HELD,
    LEVEL,
    NOT_DECIDED,
    NOT_HELD,
    NOT_TESTED,
    STRONGER,
    WEAKER,
    Means,
    Verdict,
    bootstrap,
    decided,
    percent,
    strength,
)
from flexroad.tools.reproduce.metrics_data import MetricsData
from flexroad.tools.reproduce.published import BASE, Row

GROUPS = (("l2_road_m", "l2_terrain_m"), ("mad_road_deg", "mad_terrain_deg"), ("triangles",))
"""Figures that share a table; all five in one table would be wider than a page."""
ROAD_L2 = "l2_road_m"
FIGURES_SCORED = ("l2_road_m", "l2_terrain_m", "mad_road_deg", "mad_terrain_deg")
"""All figures but T: it depends only on the mask and the sampling."""
LEAST = 0.05
"""Smaller changes in the paper are not scored: their sign has no meaning."""
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


def side_by_side(
    name: str, rows: tuple[Row, ...], ours: Mapping[str, Means], line: str = ""
) -> Iterator[Section]:
    """Yield a table of the paper with our figures beside it, one section per group of figures.

    - `name`: name of the table, the first part of the titles.
    - `rows`: the paper's rows; every variant is in `ours`.
    - `ours`: our means by column name; a single column is followed by the difference from the paper. A
      variant that a column lacks has a dash there.
    - `line`: the data of the table, if not the page's main data.
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
        yield f"{name}: {label_without_unit(figures[0]).split()[0]}", table, line


def numbers(name: str, rows: tuple[Row, ...], classes: str, means: Means, data: str) -> pd.DataFrame:
    """Return every number of a table, one per row, not rounded."""
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
        [(v.claim.text, v.claim.where, v.paper, v.ours, v.certainty, v.verdict) for v in first],
        columns=["claim", "section", "paper", "ours", "certainty", "verdict"],
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


def score_sections(rows: tuple[Row, ...], means: Means) -> tuple[Section, ...]:
    """Return the counts of the changes by figure, and the list of opposite or flat changes."""
    scored, opposite = _changes(rows, means)
    if not scored:
        return ()
    labels = [label_without_unit(figure) for figure in FIGURES_SCORED]
    parts = {label: [change for change in scored if change[0] == label] for label in labels}
    counts = pd.DataFrame([_counts(name, part) for name, part in (parts | {"all": scored}).items()])
    verdicts = Counter(verdict for _, verdict, _ in scored)
    kinds = ", ".join(f"{verdicts[kind]} {name}" for kind, name in KINDS.items())
    line = (
        f"{len(scored)} changes of L2 and MAD by more than {LEAST:.0%} in the paper: {kinds}. Within: the "
        "logarithm of our ratio is between half and twice the paper's value; weaker: below; stronger: "
        "above; opposite or flat: no change or one of the other sign. Not decided: of these, the changes for "
        f"which fewer than {LEVEL}% of the resamples give the same answer."
    )
    sections = [("Table II: how close the changes are", counts, line)]
    if opposite:
        sections.append(("Table II: changes that are opposite or flat", pd.DataFrame(opposite), ""))
    return tuple(sections)


def _changes(rows: tuple[Row, ...], means: Means) -> tuple[list[tuple[str, str, bool]], list[dict[str, str]]]:
    """Return the changes that exceed `LEAST` in the paper, and the rows of the table of opposite changes.

    A change is the figure's label, the verdict by the rule for claims, and whether enough resamples of the
    tiles give the same verdict.
    """
    base = next(row for row in rows if row.variant == BASE)
    scored, opposite = [], []
    for row in rows:
        for figure in FIGURES_SCORED:
            label, paper = label_without_unit(figure), row.value(figure) / base.value(figure)
            if row is base or abs(paper - 1) <= LEAST:
                continue
            ours, resampled = means.ratio(row.variant, BASE, figure)
            verdict = strength(ours, paper)
            if verdict != NOT_TESTED:
                scored.append((label, verdict, decided(verdict, paper, resampled)))
            if verdict == NOT_HELD:
                reason = REASONS.get((row.variant, figure), "–")
                cells = {
                    "variant": row.label,
                    "figure": label,
                    "paper": percent(paper),
                    "ours": percent(ours),
                }
                opposite.append(cells | {"reason": reason})
    return scored, opposite


def _counts(name: str, scored: list[tuple[str, str, bool]]) -> dict[str, str]:
    verdicts = Counter(verdict for _, verdict, _ in scored)
    undecided = sum(not certain for _, _, certain in scored)
    cells = {"figure": name, "changes": len(scored)}
    cells |= {column: verdicts[kind] for kind, column in KINDS.items()} | {NOT_DECIDED: undecided}
    return {column: str(value) for column, value in cells.items()}


def literal_column(data: MetricsData) -> dict[str, Means]:
    """Return the means of the literal run by the name of its column; empty without such a run."""
    return {_name(data, data.literal): _means(data.literal)} if data.literal else {}


def literal_notes(data: MetricsData) -> Iterator[str]:
    """Yield the note on the second column, if the column exists."""
    if data.literal:
        yield (
            f"The column “{_name(data, data.literal)}” has the paper read literally: the points S(u, v) lie "
            "in space where the weights move them, weights are positive without bounds, and the last step "
            f"of the fit is its result (configs/literal.yaml). {data.literal.line} It was not tuned."
        )


def literal_numbers(tables: Mapping[str, tuple[Row, ...]], data: MetricsData) -> list[pd.DataFrame]:
    """Return every number of the second column for each table; see `numbers`."""
    if not data.literal:
        return []
    means, run = _means(data.literal), data.literal
    named = {
        name: tuple(row for row in rows if row.variant in means.variants) for name, rows in tables.items()
    }
    return [
        numbers(name, rows, run.classes[0], means, f"{run.dataset}; read literally")
        for name, rows in named.items()
    ]


def literal_sections(rows: tuple[Row, ...], data: MetricsData) -> Iterator[Section]:
    """Yield the factors between the paper's figures and both columns, on the tiles of both columns."""
    if not data.literal or not rows:
        return
    literal = _means(data.literal)
    tiles = data.literal.tiles.index[data.literal.tiles.complete]
    part = replace(data, rows=data.rows[data.rows.tile_id.isin(tiles)])
    columns = {"ours": _means(part), "literal": literal}
    rows = tuple(row for row in rows if row.variant in literal.variants)
    table = pd.DataFrame({"variant": [*(row.label for row in rows), "all"]})
    for kind in ("figures", "changes"):
        for name, means in columns.items():
            distances = distances_of(rows, means, relative=kind == "changes")
            table[f"{kind}, {name}"] = [_factor(row) for row in (*distances, distances.ravel())]
    yield (
        "Table II: factors from the paper",
        table,
        f"Typical factor between the paper and us over L2 and MAD of road and terrain, on "
        f"{count(len(tiles), 'tile')}: the exponential of the mean absolute logarithm of the ratio, 1 if "
        "equal. Figures: of the row itself. Changes: of the row relative to the full pipeline.",
    )


def road_sections(rows: tuple[Row, ...], means: Means, data: MetricsData) -> Iterator[Section]:
    """Yield L2 on roads against the reference and against the DSM, if a run with the DSM is given."""
    if not data.dsm:
        return
    table = pd.DataFrame({"variant": [row.label for row in rows]})
    table[f"{FIGURES[ROAD_L2]}, paper"] = [format_figure(row.value(ROAD_L2), ROAD_L2) for row in rows]
    for name, column in (("reference", means), ("DSM", _means(data.dsm))):
        table[f"{FIGURES[ROAD_L2]}, ours by the {name}"] = [
            _with_interval(column, row.variant, ROAD_L2) for row in rows
        ]
    yield (
        "L2 on roads by the reference and by the DSM",
        table,
        "The same meshes and the same road mask, measured against the reference, and against the DSM where "
        "it has a height.",
    )


def road_numbers(rows: tuple[Row, ...], data: MetricsData) -> list[pd.DataFrame]:
    """Return L2 on roads against the DSM as rows of `numbers`, if a run with the DSM is given."""
    if not data.dsm:
        return []
    name = f"{data.dsm.dataset}; against the DSM"
    table = numbers("L2 on roads by the DSM", rows, data.dsm.classes[0], _means(data.dsm), name)
    return [table[table.figure == ROAD_L2]]


def distances_of(rows: tuple[Row, ...], means: Means, relative: bool) -> np.ndarray:
    """Return the absolute logarithms of the ratios of our figures to the paper's, ``(rows, 4)``.

    - `rows`: rows of Table II with the full pipeline.
    - `relative`: whether to compare the ratios to the full pipeline instead of the figures.
    """
    paper = np.array([[row.value(figure) for figure in FIGURES_SCORED] for row in rows])
    ours = np.array([[means.mean[row.variant, figure] for figure in FIGURES_SCORED] for row in rows])
    logs = np.log(ours / paper)
    base = next(number for number, row in enumerate(rows) if row.variant == BASE)
    return np.asarray(np.abs(logs - logs[base] if relative else logs))


def _factor(distances: np.ndarray) -> str:
    factor = math.exp(float(np.mean(distances)))
    return f"{factor:.2f}" if factor < 100 else f"{factor:.0f}"


def _means(data: MetricsData) -> Means:
    return bootstrap(data.part(data.classes[0]))


def _name(data: MetricsData, literal: MetricsData) -> str:
    tiles, all_tiles = (int(part.tiles.complete.sum()) for part in (literal, data))
    return "literal" if tiles == all_tiles else f"literal ({tiles} tiles)"
