"""Accuracy against smoothness for different control grids, degrees and sampling distances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from flexroad.pipeline.config.models import Chain, Config
from flexroad.pipeline.reproduce.figures.layout import FLEXROAD, PATH, TRUTH, FigureFile, new_figure
from flexroad.pipeline.reproduce.figures.roles import changes

NAME = "trade_off"
SWEEPS: dict[str, tuple[str, ...]] = {
    "Control grid": ("fit.control_points",),
    "Degree p = q": ("fit.degree",),
    "Sampling, road / terrain (m)": ("sample.road_m", "sample.terrain_m"),
}
"""The options that are varied, by panel title."""


def make_figure(config: Config, full: str, done: pd.DataFrame) -> FigureFile:
    """Make the figure: road L2 over road MAD, mean over tiles, for each sweep in the run."""
    sweeps = {title: sweep(config.chains, full, options) for title, options in SWEEPS.items()}
    sweeps = {title: labels for title, labels in sweeps.items() if len(labels) > 1}
    caption = (
        "Accuracy against smoothness on roads, mean over tiles. Each dot is a variant that changes only the "
        "control grid, the degree or the sampling; the red dot is the full pipeline. Left is smoother, "
        "lower is more accurate."
    )
    if not sweeps:
        missing = (
            "no variant changes only the control grid, the degree or the sampling; `--config ablation` has "
            "such variants"
        )
        return FigureFile(NAME, caption, None, missing)
    means = done.groupby("variant")[["mad_road_deg", "l2_road_m"]].mean()
    return FigureFile(NAME, caption, draw(means, sweeps, full))


def sweep(chains: Mapping[str, Chain], full: str, options: tuple[str, ...]) -> dict[str, str]:
    """Return the variants that differ from the full pipeline only in these options, and the full one.

    Returns
    -------
    dict
        Label by variant, ordered by the options' values.
    """
    values = {
        variant: tuple(_value(chain, option) for option in options)
        for variant, chain in chains.items()
        if changes(chain, chains[full]) <= set(options)
    }
    # A variant with the same values as the full pipeline is left out.
    distinct = {variant: v for variant, v in values.items() if variant == full or v != values[full]}
    return {
        variant: " / ".join(map(_text, distinct[variant]))
        for variant in sorted(distinct, key=distinct.__getitem__)
    }


def _value(chain: Chain, option: str) -> Any:
    stage, name = option.split(".")
    return getattr(chain[stage], name)


def _text(value: Any) -> str:
    return "×".join(map(str, value)) if isinstance(value, tuple) else f"{value:g}"


def draw(means: pd.DataFrame, sweeps: Mapping[str, Mapping[str, str]], full: str) -> Figure:
    """Draw one panel per sweep.

    Parameters
    ----------
    means : DataFrame
        ``mad_road_deg`` and ``l2_road_m`` by variant.
    sweeps : Mapping
        For each title, the labels by variant.
    full : str
        The full pipeline, part of every sweep.
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
        # Alternately above and below, so that the labels of close neighbours do not overlap.
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
