"""A picture of the error estimate along the road, with circles around the places to look at."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, to_rgb
from matplotlib.patheffects import withStroke

from flexroad.catalog import Grid
from flexroad.pipeline.report.render import _colour_bar, _map, _png, _shaded
from flexroad.tasks.quality.places import Place
from flexroad.tasks.types import Bools, Floats

COLOURS = "YlOrRd"
LIMIT_M = 0.5
"""End of the colour bar: beyond it all is equally bad."""
CIRCLE, RING = "#1c2430", "#ffffff"
NEAR, LINE = 0.3, 0.04
"""Distance across which labels may overlap, and that of their lines, as shares of the width of the map."""


def estimate_picture(
    height: Floats, estimate: Floats, road: Bools, grid: Grid, places: Mapping[str, Place], title: str = ""
) -> bytes:
    """Draw the error estimate of the road over the relief.

    Parameters
    ----------
    height : Floats
        The DSM (m), ``(H, W)``.
    estimate : Floats
        Estimated error of the surface (m), ``(H, W)``.
    road : Bools
        Road cells before the filter, ``(H, W)``.
    grid : Grid
        Where the cells lie.
    places : Mapping
        Place by flag; each has a circle, with the names of its flags.
    title : str
        What is drawn, above the map.

    Returns
    -------
    bytes
        A PNG, 480 pixels wide.
    """
    norm = Normalize(0, LIMIT_M, clip=True)
    grey = np.broadcast_to(np.array(to_rgb("#e4e2dd")), (*height.shape, 3))
    relief = _shaded(grey, height, grid.cell)
    coloured = colormaps[COLOURS](norm(np.nan_to_num(estimate)))[..., :3]
    rgb = np.where((road & np.isfinite(estimate))[..., None], coloured, relief)
    figure, axes = _map(rgb, grid, title)
    _circles(axes, grid, places)
    _colour_bar(figure, axes, COLOURS, norm, "error estimate (m)", "max")
    return _png(figure)


def _circles(axes: Axes, grid: Grid, places: Mapping[str, Place]) -> None:
    names: dict[Place, list[str]] = {}
    for flag, place in places.items():
        names.setdefault(place, []).append(flag)
    width, last = grid.width * grid.cell, (-math.inf, -math.inf)
    for (east, north), flags in sorted(names.items(), key=lambda item: item[0][1]):
        x, y = east - grid.west, north - grid.south
        for colour, line in ((RING, 3.4), (CIRCLE, 1.6)):
            axes.plot(x, y, "o", ms=15, mfc="none", mec=colour, mew=line)
        on_left = x < width / 2
        # From south to north, each label at least a line above the one before it, if both are near.
        near = abs(x - last[0]) < NEAR * width
        label = max(y, last[1] + LINE * width) if near else y
        last = x, label
        axes.annotate(
            ", ".join(flags),
            (x, label),
            (10 if on_left else -10, 0),
            textcoords="offset points",
            ha="left" if on_left else "right",
            va="center",
            fontsize=8,
            color=CIRCLE,
            path_effects=[withStroke(linewidth=2.5, foreground=RING)],
            annotation_clip=False,
        )
