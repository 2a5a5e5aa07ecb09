"""The second column of the tables: the paper read literally (configs/literal.yaml), and how close each is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
import pandas as pd

from flexroad.catalog.text import count
from flexroad.pipeline.reproduce.bootstrap import Means, bootstrap
from flexroad.pipeline.reproduce.metrics_data import MetricsData
from flexroad.pipeline.reproduce.published import BASE, Row
from flexroad.pipeline.reproduce.score import FIGURES_SCORED
from flexroad.pipeline.reproduce.sections import Section, numbers


def literal_column(data: MetricsData) -> dict[str, Means]:
    """Return the means of the literal run by the name of its column; empty without such a run."""
    return {_name(data): _means(data.literal)} if data.literal else {}


def literal_notes(data: MetricsData) -> Iterator[str]:
    """Yield the note that explains the second column, if there is one."""
    if data.literal:
        yield (
            f"The column “{_name(data)}” has the paper read literally: the points S(u, v) lie in space where "
            "the weights move them, weights are positive without bounds, and the last step of the fit is its "
            f"result (configs/literal.yaml). {data.literal.line} It was not tuned."
        )


def literal_numbers(tables: Mapping[str, tuple[Row, ...]], data: MetricsData) -> list[pd.DataFrame]:
    """Return every number of the second column, a table each; see `sections.numbers`."""
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
    """Yield the factors between the paper's figures and those of both columns, on the tiles of both."""
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
    yield Section(
        "Table II: factors from the paper",
        table,
        f"Typical factor between the paper and us over L2 and MAD of road and terrain, on "
        f"{count(len(tiles), 'tile')}: the exponential of the mean absolute logarithm of the ratio, 1 if "
        "equal. Figures: of the row itself. Changes: of the row relative to the full pipeline.",
    )


def distances_of(rows: tuple[Row, ...], means: Means, relative: bool) -> np.ndarray:
    """Return the absolute logarithms of the ratios of our figures to the paper's, ``(rows, 4)``.

    Parameters
    ----------
    rows : tuple of Row
        Rows of Table II with the full pipeline.
    means : Means
        Our means.
    relative : bool
        Whether to compare the ratios to the full pipeline in place of the figures.
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


def _name(data: MetricsData) -> str:
    if not data.literal:
        raise ValueError("no literal run")
    tiles, all_tiles = (int(part.tiles.complete.sum()) for part in (data.literal, data))
    return "literal" if tiles == all_tiles else f"literal ({tiles} tiles)"
