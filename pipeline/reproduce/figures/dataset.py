"""The figure of the run's tiles: strata, road share and height range."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from flexroad.pipeline.reproduce.figures.layout import PATH, STRATA, FigureFile, new_figure
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses

NAME = "dataset"
BINS = 12
Table = pd.DataFrame


def statistics(run: Run, full: str, done: Table) -> Table:
    """Return ``tile_id, stratum, road_percent, height_range_m`` of the finished tiles.

    The road share is that of the run's table; heights are those of the DSM, with houses and trees.

    Raises
    ------
    ConfigError
        If a tile's source files can no longer be read.
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


def make_figure(table: Table) -> FigureFile:
    """Make the figure: tiles per stratum, and histograms of road share and height range."""
    caption = (
        f"The {len(table)} tiles: number per stratum, road share by the evaluation mask, and height range "
        "of the DSM, houses and trees included. Dashed: the means, "
        f"{table.road_percent.mean():.1f}% and {table.height_range_m.mean():.1f} m."
    )
    return FigureFile(NAME, caption, draw(table))


def draw(table: Table) -> Figure:
    """Draw a table as returned by `statistics`."""
    figure = new_figure(2.1)
    bars, roads, heights = figure.subplots(1, 3, width_ratios=[1, 1.5, 1.5])
    groups = _groups(table)
    rectangles = bars.bar(
        list(groups), [len(part) for part in groups.values()], color=[_colour(name) for name in groups]
    )
    bars.bar_label(rectangles, fontsize=7)
    bars.set_ylabel("tiles")
    bars.yaxis.set_major_locator(MaxNLocator(integer=True))
    _histogram(roads, table, groups, "road_percent", "share of road (%)")
    _histogram(heights, table, groups, "height_range_m", "range of heights (m)")
    if len(groups) > 1:
        roads.legend(loc="upper right", handlelength=1)
    return figure


def _groups(table: Table) -> dict[str, Table]:
    named = {str(name): part for name, part in table.groupby("stratum")}
    order = [*STRATA, *sorted(set(named) - set(STRATA))]
    return {name or "tiles": named[name] for name in order if name in named}


def _colour(name: str) -> str:
    return STRATA.get(name, STRATA[""])


def _histogram(axes: Axes, table: Table, groups: dict[str, Table], column: str, label: str) -> None:
    edges = list(np.histogram_bin_edges(table[column].dropna(), BINS))
    parts: Any = [part[column].dropna() for part in groups.values()]
    axes.hist(parts, edges, stacked=True, label=list(groups), color=[_colour(name) for name in groups])
    mean = table[column].mean()
    axes.axvline(mean, color=PATH, linestyle="--", linewidth=0.9)
    axes.set_title(f"mean {mean:.1f}", color=PATH)
    axes.set_xlabel(label)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
