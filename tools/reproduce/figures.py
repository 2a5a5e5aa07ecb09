"""The paper's figures, drawn from a run, as PDF, PNG and WebP files with a page of captions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from flexroad.catalog.storage.paths import write
from flexroad.pipeline.config.models import Chain, Config
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.reproduce import tile_figures
from flexroad.tools.reproduce.layout import FLEXROAD, PATH, STRATA, STYLE, TRUTH, Captioned, new_figure, save
from flexroad.tools.reproduce.metrics_data import collect
from flexroad.tools.reproduce.tile_view import changes, read_tile_view, roles_of, typical_tile

SWEEPS: dict[str, tuple[str, ...]] = {
    "Control grid": ("fit.control_points",),
    "Degree p = q": ("fit.degree",),
    "Sampling, road / terrain (m)": ("sample.road_m", "sample.terrain_m"),
}
"""The options that are varied, by panel title."""
BINS = 12


def write_figures(run: Run, folder: Path, tile_id: str | None = None) -> list[str]:
    """Draw every figure whose variants are in the run, and write ``figures.md`` with the captions.

    - `folder`: folder for NAME.pdf, NAME.png, NAME.webp and figures.md.
    - `tile_id`: the tile of the maps, renders and profile; by default the tile with the median road L2.
    - result: one line per figure that could not be drawn, with the reason.
    """
    roles = roles_of(run.config)
    full = roles["full"]
    data = collect(run)
    rows = read_metrics(run.path)
    # As in the tables: only tiles with every variant.
    done = rows[rows.tile_id.isin(data.tiles.index[data.tiles.complete])]
    page, missing = [data.line, "# Figures"], []
    with rc_context(STYLE):
        view = read_tile_view(run, tile_id or typical_tile(done, full), roles)
        drawn = {
            "road_profile": tile_figures.road_profile(view),
            "error_and_smoothness": tile_figures.error_maps(view),
            "ablation_renders": tile_figures.ablation_renders(view),
            "trade_off": trade_off(run.config, full, done),
            "dataset": dataset(statistics(run, full, done)),
        }
        for name, (caption, figure) in drawn.items():
            if isinstance(figure, str):
                missing.append(f"no figure {name}: {figure}")
                page.append(f"No figure `{name}`: {figure}")
            else:
                save(figure, folder, name)
                page.append(f"![{name}]({name}.png)\n\n{caption}")
    write(folder / "figures.md", ("\n\n".join(page) + "\n").encode())
    return missing


def trade_off(config: Config, full: str, done: pd.DataFrame) -> Captioned:
    """Make the figure: road L2 over road MAD, mean over tiles, for each sweep in the run."""
    sweeps = {title: sweep(config.chains, full, options) for title, options in SWEEPS.items()}
    sweeps = {title: labels for title, labels in sweeps.items() if len(labels) > 1}
    caption = (
        "Accuracy against smoothness on roads, mean over tiles. Each dot is a variant that changes only the "
        "control grid, the degree or the sampling; the red dot is the full pipeline. Left is smoother, "
        "lower is more accurate."
    )
    if not sweeps:
        return caption, (
            "no variant changes only the control grid, the degree or the sampling; `--config ablation` has "
            "such variants"
        )
    means = done.groupby("variant")[["mad_road_deg", "l2_road_m"]].mean()
    return caption, draw_trade_off(means, sweeps, full)


def sweep(chains: Mapping[str, Chain], full: str, options: tuple[str, ...]) -> dict[str, str]:
    """Return the variants that differ from the full pipeline only in these options, and the full pipeline.

    - result: label by variant, ordered by the options' values; empty if the methods of the full pipeline lack
      one of the options.
    """
    split = [option.split(".") for option in options]
    if not all(hasattr(chains[full][stage], name) for stage, name in split):
        return {}
    values = {
        variant: tuple(getattr(chain[stage], name) for stage, name in split)
        for variant, chain in chains.items()
        if changes(chain, chains[full]) <= set(options)
    }
    # A variant with the same values as the full pipeline is left out.
    distinct = {variant: v for variant, v in values.items() if variant == full or v != values[full]}
    return {
        variant: " / ".join(map(_text, distinct[variant]))
        for variant in sorted(distinct, key=distinct.__getitem__)
    }


def _text(value: Any) -> str:
    return "×".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}"


def draw_trade_off(means: pd.DataFrame, sweeps: Mapping[str, Mapping[str, str]], full: str) -> Figure:
    """Draw one panel per sweep.

    - `means`: ``mad_road_deg`` and ``l2_road_m`` by variant.
    - `sweeps`: for each title, the labels by variant.
    - `full`: the full pipeline, part of every sweep.
    """
    figure = new_figure(2.4)
    axes = figure.subplots(1, len(sweeps), sharey=True, squeeze=False)[0]
    for panel, (title, labels) in zip(axes, sweeps.items(), strict=True):
        _panel(panel, means.reindex(list(labels)), labels, full)
        panel.set_title(title)
        panel.set_xlabel("road MAD (°)")
    axes[0].set_ylabel("road L2 (m)")
    axes[0].set_ylim(bottom=0)
    return figure


def _panel(axes: Axes, means: pd.DataFrame, labels: Mapping[str, str], full: str) -> None:
    axes.plot(means.mad_road_deg, means.l2_road_m, color=TRUTH, linewidth=0.8)
    for i, (variant, x, y) in enumerate(means.itertuples(name=None)):
        colour = PATH if variant == full else FLEXROAD
        axes.plot(x, y, "o", color=colour, markersize=4, zorder=3)
        # Labels are alternately above and below, so that close neighbours do not overlap.
        up = bool(i % 2)
        axes.annotate(
            labels[variant],
            (x, y),
            (0, 5 if up else -5),
            textcoords="offset points",
            ha="center",
            va="bottom" if up else "top",
            fontsize=6.5,
        )
    axes.margins(x=0.25, y=0.1)
    axes.set_xlim(left=0)


def statistics(run: Run, full: str, done: pd.DataFrame) -> pd.DataFrame:
    """Return ``tile_id, stratum, road_percent, height_range_m`` of the finished tiles.

    The road share is from the run's table; heights are from the DSM, with houses and trees.
    """
    table = done.loc[done.variant == full, ["tile_id", "stratum", "road_fraction"]].copy()
    wanted = set(table.tile_id)
    ranges: dict[str, float] = {}
    for status in peek_statuses(run, [tile for tile in run.catalog.tiles if tile.id in wanted]):
        tile = FinishedTile.of(run, status, full)
        data = tile.data
        dsm = data.dsm[data.grid.window(data.core)]
        ranges[tile.id] = float(np.nanmax(dsm) - np.nanmin(dsm))
    table["road_percent"] = 100 * table.pop("road_fraction")
    table["height_range_m"] = table.tile_id.map(ranges)
    return table.reset_index(drop=True)


def dataset(table: pd.DataFrame) -> Captioned:
    """Make the figure: tiles per stratum, and histograms of road share and height range."""
    caption = (
        f"The {len(table)} tiles: number per stratum, road share by the evaluation mask, and height range "
        "of the DSM, houses and trees included. Dashed: the means, "
        f"{table.road_percent.mean():.1f}% and {table.height_range_m.mean():.1f} m."
    )
    return caption, draw_dataset(table)


def draw_dataset(table: pd.DataFrame) -> Figure:
    """Draw a table as returned by `statistics`."""
    figure = new_figure(2.1)
    bars, roads, heights = figure.subplots(1, 3, width_ratios=[1, 1.5, 1.5])
    named = {str(name): part for name, part in table.groupby("stratum")}
    order = [*STRATA, *sorted(set(named) - set(STRATA))]
    groups = {name or "tiles": named[name] for name in order if name in named}
    rectangles = bars.bar(
        list(groups),
        [len(part) for part in groups.values()],
        color=[STRATA.get(name, STRATA[""]) for name in groups],
    )
    bars.bar_label(rectangles, fontsize=7)
    bars.set_ylabel("tiles")
    bars.yaxis.set_major_locator(MaxNLocator(integer=True))
    _histogram(roads, table, groups, "road_percent", "share of road (%)")
    _histogram(heights, table, groups, "height_range_m", "range of heights (m)")
    if len(groups) > 1:
        roads.legend(loc="upper right", handlelength=1)
    return figure


def _histogram(
    axes: Axes, table: pd.DataFrame, groups: dict[str, pd.DataFrame], column: str, label: str
) -> None:
    edges = list(np.histogram_bin_edges(table[column].dropna(), BINS))
    parts: Any = [part[column].dropna() for part in groups.values()]
    axes.hist(
        parts,
        edges,
        stacked=True,
        label=list(groups),
        color=[STRATA.get(name, STRATA[""]) for name in groups],
    )
    mean = table[column].mean()
    axes.axvline(mean, color=PATH, linestyle="--", linewidth=0.9)
    axes.set_title(f"mean {mean:.1f}", color=PATH)
    axes.set_xlabel(label)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
