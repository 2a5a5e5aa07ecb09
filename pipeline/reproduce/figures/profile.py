"""Heights along a vehicle's path in the raw DSM, on a plane and on FlexRoad (the paper's Fig. 1)."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from scipy import ndimage

from flexroad.pipeline.reproduce.figures.layout import (
    FLEXROAD,
    PATH,
    PLANE,
    RAW,
    TRUTH,
    FigureFile,
    new_figure,
)
from flexroad.pipeline.reproduce.figures.roles import Roles
from flexroad.pipeline.reproduce.figures.tile_view import TileView, missing_roles
from flexroad.pipeline.reproduce.figures.trajectory import vehicle_trajectory
from flexroad.tasks.types import Floats

NAME = "road_profile"
CLOSE_M = 0.5
"""Limit of the error axis (m)."""
HEADROOM = 0.25
"""Margin of the height axis above and below the road, as a fraction of the road's height range."""


def make_figure(view: TileView, roles: Roles) -> FigureFile:
    """Make the figure: map of the path, heights along it and their errors."""
    row, col = vehicle_trajectory(view.street)
    caption = (
        f"{view}: heights along a vehicle's path (red: the longest path along the tile's roads, in the "
        f"right-hand lane) of the raw DSM, the plane, FlexRoad and {view.against} (top), and their "
        f"differences from {view.against} (bottom, cut off at {CLOSE_M:g} m). Peaks of the DSM are objects "
        "on or above the road."
    )
    missing = missing_roles((("Plane", roles.plane),)) or ("" if row.size > 1 else "the tile has no road")
    if missing or roles.plane is None:
        return FigureFile(NAME, caption, None, missing)
    rasters = {
        "truth": view.truth,
        "raw DSM": view.dsm,
        "Plane": view.results[roles.plane].height,
        "FlexRoad": view.results[roles.full].height,
    }
    heights = {label: along(raster, row, col) for label, raster in rasters.items()}
    return FigureFile(NAME, caption, draw(view, row, col, heights))


def along(raster: Floats, row: Floats, col: Floats) -> Floats:
    """Return bilinear heights of a raster at fractional rows and columns; NaN next to NaN cells."""
    return np.asarray(ndimage.map_coordinates(raster, [row, col], order=1, mode="nearest"))


def draw(view: TileView, row: Floats, col: Floats, heights: dict[str, Floats]) -> Figure:
    """Draw a map of the path, the heights along it and their errors.

    Parameters
    ----------
    view : TileView
        The tile.
    row, col : Floats
        The path, in cells.
    heights : dict of str to Floats
        Heights along the path (m) by label: ``raw DSM``, ``Plane``, ``FlexRoad`` and ``truth``.
    """
    figure = new_figure(2.9)
    axes = figure.subplot_mosaic([["map", "heights"], ["map", "errors"]], width_ratios=[1, 2.1])
    cell = view.grid.cell
    at = cell * np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(row), np.diff(col)))])
    _map(axes["map"], view, row, col, at)
    styles: dict[str, dict[str, Any]] = {
        "raw DSM": {"color": RAW, "linewidth": 0.8},
        "Plane": {"color": PLANE},
        "truth": {"color": TRUTH, "linewidth": 2.4, "alpha": 0.7},
        "FlexRoad": {"color": FLEXROAD, "linestyle": (0, (3.5, 1.2))},
    }
    for name, style in styles.items():
        label = view.against.removeprefix("the ") if name == "truth" else name
        axes["heights"].plot(at, heights[name], label=label, **style)
        axes["errors"].plot(at, heights[name] - heights["truth"], label=label, **style)
    _frame(axes["heights"], axes["errors"], at, heights)
    return figure


def _map(axes: Axes, view: TileView, row: Floats, col: Floats, at: Floats) -> None:
    grid = view.grid
    size = (0.0, grid.width * grid.cell, 0.0, grid.height * grid.cell)
    axes.imshow(view.street, cmap=ListedColormap(["#f4f2ec", "#c9cbd0"]), vmin=0, vmax=1, extent=size)
    x, y = (col + 0.5) * grid.cell, (grid.height - row - 0.5) * grid.cell
    axes.plot(x, y, color=PATH)
    for distance in np.arange(0, at[-1] + 1, 100):
        i = int(np.searchsorted(at, distance).clip(0, at.size - 1))
        axes.plot(x[i], y[i], "o", color=PATH, markersize=2.5)
        # Offset towards the middle of the map, so that the labels of the ends stay inside.
        right, up = x[i] < x.max() / 2, y[i] < y.max() / 2
        axes.annotate(
            f"{distance:.0f} m",
            (x[i], y[i]),
            (4 if right else -4, 4 if up else -4),
            textcoords="offset points",
            ha="left" if right else "right",
            va="bottom" if up else "top",
            fontsize=6,
        )
    axes.set_xlim(0, size[1])
    axes.set_ylim(0, size[3])
    axes.set_xlabel("m east")
    axes.set_ylabel("m north")


def _frame(upper: Axes, lower: Axes, at: Floats, heights: dict[str, Floats]) -> None:
    road = np.concatenate([heights["truth"], heights["FlexRoad"]])
    low, high = np.nanmin(road), np.nanmax(road)
    room = max(HEADROOM * (high - low), 2.0)
    upper.set_ylim(low - room, high + room)
    upper.set_ylabel("height (m)")
    upper.legend(ncols=4, loc="upper left", bbox_to_anchor=(0, 1.22), borderaxespad=0, handlelength=2.2)
    upper.tick_params(labelbottom=False)
    lower.set_ylim(-CLOSE_M, CLOSE_M)
    lower.set_ylabel("error (m)")
    lower.set_xlabel("distance along the path (m)")
    for axes in (upper, lower):
        axes.set_xlim(0, at[-1])
