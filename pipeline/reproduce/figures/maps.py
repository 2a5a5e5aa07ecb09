"""Maps of error and smoothness of Plane, RGT and FlexRoad on one tile (the paper's Fig. 4)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from flexroad.catalog import Grid
from flexroad.pipeline.reproduce.figures.layout import FigureFile, new_figure
from flexroad.pipeline.reproduce.figures.roles import Roles
from flexroad.pipeline.reproduce.figures.scales import (
    ANGLE_COLOURS,
    ANGLE_NORM,
    ERROR_COLOURS,
    ERROR_NORM,
    drawable,
)
from flexroad.pipeline.reproduce.figures.tile_view import Result, TileView, missing_roles

NAME = "error_and_smoothness"


def make_figure(view: TileView, roles: Roles) -> FigureFile:
    """Make the figure: vertical error per cell above mean angle per face, for the three methods."""
    methods = (("Plane", roles.plane), ("RGT", roles.rgt), ("FlexRoad", roles.full))
    missing = missing_roles(methods)
    caption = (
        f"{view}: vertical distance to {view.against} per cell (top) and mean angle of each face to its "
        "neighbours (bottom) for Plane, RGT and FlexRoad. Both scales are logarithmic; values outside a "
        "scale have the colour of its end. The titles give the tile's means, as in the run's table."
    )
    columns = {label: variant for label, variant in methods if variant is not None}
    return FigureFile(NAME, caption, None if missing else draw(view, columns), missing)


def draw(view: TileView, columns: dict[str, str]) -> Figure:
    """Draw one column of two maps per variant; `columns` gives the variant of each label."""
    figure = new_figure(4.6)
    axes = figure.subplots(2, len(columns), sharex=True, sharey=True, squeeze=False)
    artists: list[tuple[AxesImage, Collection]] = []
    for (upper, lower), (label, variant) in zip(axes.T, columns.items(), strict=True):
        result = view.results[variant]
        artists.append((_errors(upper, view, variant), _angles(lower, result, view.grid)))
        _titles(upper, lower, label, result)
    for row, (artist, text) in enumerate(zip(artists[0], ("error (m)", "angle (°)"), strict=True)):
        bar = figure.colorbar(artist, ax=list(axes[row]), extend="both", pad=0.015, aspect=22, shrink=0.85)
        bar.set_label(text)
        bar.ax.yaxis.set_major_formatter("{x:g}")
    _frame(axes, view.grid)
    return figure


def _errors(axes: Axes, view: TileView, variant: str) -> AxesImage:
    size = (0.0, view.grid.width * view.grid.cell, 0.0, view.grid.height * view.grid.cell)
    error = drawable(view.error(variant))
    return axes.imshow(
        error, cmap=ERROR_COLOURS, norm=ERROR_NORM, extent=size, origin="upper", interpolation="nearest"
    )


def _angles(axes: Axes, result: Result, grid: Grid) -> Collection:
    mesh = result.mesh
    x = mesh.vertices[:, 0] + (mesh.origin[0] - grid.west)
    y = mesh.vertices[:, 1] + (mesh.origin[1] - grid.south)
    # Rasterised in the PDF: a hundred thousand vector triangles would make it slow to open.
    return axes.tripcolor(
        x,
        y,
        mesh.faces,
        facecolors=drawable(result.angles),
        cmap=ANGLE_COLOURS,
        norm=ANGLE_NORM,
        edgecolors="none",
        antialiased=False,
        rasterized=True,
    )


def _titles(upper: Axes, lower: Axes, label: str, result: Result) -> None:
    m = result.metrics
    upper.set_title(f"{label}\nroad {m.l2_road_m:.3f} m, terrain {m.l2_terrain_m:.3f} m")
    lower.set_title(f"road {m.mad_road_deg:.2f}°, terrain {m.mad_terrain_deg:.2f}°")


def _frame(axes: np.ndarray, grid: Grid) -> None:
    for panel in axes.flat:
        panel.set_aspect("equal")
        panel.spines[["top", "right"]].set_visible(True)
        panel.set_xlim(0, grid.width * grid.cell)
        panel.set_ylim(0, grid.height * grid.cell)
    axes[0, 0].set_ylabel("L2 error\nm north")
    axes[1, 0].set_ylabel("MAD\nm north")
    for panel in axes[1]:
        panel.set_xlabel("m east")
