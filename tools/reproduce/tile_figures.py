"""The figures of one tile: heights along a path (the paper's Fig. 1), maps (Fig. 4) and meshes."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import Collection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from flexroad.catalog import Grid
from flexroad.catalog.grid import Bounds
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.report.pictures import NO_MESH, render_meshes
from flexroad.tools.reproduce.layout import (
    ANGLE_COLOURS,
    ANGLE_NORM,
    ERROR_COLOURS,
    ERROR_NORM,
    FLEXROAD,
    PATH,
    PLANE,
    RAW,
    TRUTH,
    Captioned,
    drawable,
    new_figure,
)
from flexroad.tools.reproduce.tile_view import Result, TileView, missing_roles, vehicle_trajectory

MOST_ERROR_M = 0.5
"""Limit of the error axis of the profile (m)."""
HEADROOM = 0.25
"""Margin of the height axis above and below the road, as a fraction of the road's height range."""
SIZE_PX = (760, 540)
UNKNOWN = "#d0d0d0"
CLOSE_M = 120.0
"""Side of the square that is drawn (m); on a complete tile the details would be too small."""


def road_profile(view: TileView) -> Captioned:
    """Make the figure: map of the path, heights along it and their errors."""
    row, col = vehicle_trajectory(view.street)
    caption = (
        f"{view}: heights along a vehicle's path (red: the longest path along the tile's roads, in the "
        f"right-hand lane) of the raw DSM, the plane, FlexRoad and {view.against} (top), and their "
        f"differences from {view.against} (bottom, cut off at {MOST_ERROR_M:g} m). Peaks of the DSM are "
        "objects on or above the road."
    )
    missing = missing_roles(view, {"Plane": "plane"}) or ("" if row.size > 1 else "the tile has no road")
    if missing:
        return caption, missing
    rasters = {
        "truth": view.truth,
        "raw DSM": view.dsm,
        "Plane": view.results["plane"].height,
        "FlexRoad": view.results["full"].height,
    }
    heights = {label: along(raster, row, col) for label, raster in rasters.items()}
    return caption, draw_profile(view, row, col, heights)


def along(raster: Floats, row: Floats, col: Floats) -> Floats:
    """Return bilinear heights of a raster at fractional rows and columns; NaN next to NaN cells."""
    return np.asarray(ndimage.map_coordinates(raster, [row, col], order=1, mode="nearest"))


def draw_profile(view: TileView, row: Floats, col: Floats, heights: dict[str, Floats]) -> Figure:
    """Draw a map of the path, the heights along it and their errors.

    - `row`, `col`: the path, in cells.
    - `heights`: heights along the path (m) by label: ``raw DSM``, ``Plane``, ``FlexRoad`` and ``truth``.
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
    _frame_profile(axes["heights"], axes["errors"], at, heights)
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
        # The labels of the ends are moved towards the middle of the map, so that they stay inside.
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


def _frame_profile(upper: Axes, lower: Axes, at: Floats, heights: dict[str, Floats]) -> None:
    road = np.concatenate([heights["truth"], heights["FlexRoad"]])
    low, high = np.nanmin(road), np.nanmax(road)
    room = max(HEADROOM * (high - low), 2.0)
    upper.set_ylim(low - room, high + room)
    upper.set_ylabel("height (m)")
    upper.legend(ncols=4, loc="upper left", bbox_to_anchor=(0, 1.22), borderaxespad=0, handlelength=2.2)
    upper.tick_params(labelbottom=False)
    lower.set_ylim(-MOST_ERROR_M, MOST_ERROR_M)
    lower.set_ylabel("error (m)")
    lower.set_xlabel("distance along the path (m)")
    for axes in (upper, lower):
        axes.set_xlim(0, at[-1])


def error_maps(view: TileView) -> Captioned:
    """Make the figure: vertical error per cell above mean angle per face, for the three methods."""
    methods = {"Plane": "plane", "RGT": "rgt", "FlexRoad": "full"}
    caption = (
        f"{view}: vertical distance to {view.against} per cell (top) and mean angle of each face to its "
        "neighbours (bottom) for Plane, RGT and FlexRoad. Both scales are logarithmic; values outside a "
        "scale have the colour of its end. The titles give the tile's means, as in the run's table."
    )
    return caption, missing_roles(view, methods) or draw_maps(view, methods)


def draw_maps(view: TileView, columns: dict[str, str]) -> Figure:
    """Draw one column of two maps per method; `columns` gives the role of each label."""
    figure = new_figure(4.6)
    axes = figure.subplots(2, len(columns), sharex=True, sharey=True, squeeze=False)
    artists: list[tuple[AxesImage, Collection]] = []
    for (upper, lower), (label, role) in zip(axes.T, columns.items(), strict=True):
        result = view.results[role]
        artists.append((_errors(upper, view, role), _angles(lower, result, view.grid)))
        m = result.metrics
        upper.set_title(f"{label}\nroad {m.l2_road_m:.3f} m, terrain {m.l2_terrain_m:.3f} m")
        lower.set_title(f"road {m.mad_road_deg:.2f}°, terrain {m.mad_terrain_deg:.2f}°")
    for row, (artist, text) in enumerate(zip(artists[0], ("error (m)", "angle (°)"), strict=True)):
        bar = figure.colorbar(artist, ax=list(axes[row]), extend="both", pad=0.015, aspect=22, shrink=0.85)
        bar.set_label(text)
        bar.ax.yaxis.set_major_formatter("{x:g}")
    _frame_maps(axes, view.grid)
    return figure


def _errors(axes: Axes, view: TileView, role: str) -> AxesImage:
    size = (0.0, view.grid.width * view.grid.cell, 0.0, view.grid.height * view.grid.cell)
    error = drawable(view.error(role))
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


def _frame_maps(axes: np.ndarray, grid: Grid) -> None:
    for panel in axes.flat:
        panel.set_aspect("equal")
        panel.spines[["top", "right"]].set_visible(True)
        panel.set_xlim(0, grid.width * grid.cell)
        panel.set_ylim(0, grid.height * grid.cell)
    axes[0, 0].set_ylabel("L2 error\nm north")
    axes[1, 0].set_ylabel("MAD\nm north")
    for panel in axes[1]:
        panel.set_xlabel("m east")


def ablation_renders(view: TileView) -> Captioned:
    """Make the figure: oblique views of the three meshes. Needs OpenGL."""
    methods = {"w/o NURBS": "wo_nurbs", "w/o ECSRC": "wo_ecsrc", "FlexRoad in full": "full"}
    caption = (
        f"{view}: meshes without NURBS, without ECSRC and of the full pipeline, coloured by their vertical "
        f"distance to {view.against} as in the error maps. The square of {CLOSE_M:g} m is the one in which "
        "ECSRC drops the largest area of the road mask; on the complete tile it drops "
        f"{view.dropped.sum() * view.grid.cell**2:,.0f} m²."
    )
    if missing := missing_roles(view, methods):
        return caption, missing
    meshes = {label: view.results[role].mesh for label, role in methods.items()}
    colours = {label: vertex_colours(view, role) for label, role in methods.items()}
    pictures = render_meshes(meshes, colours, busiest(view.dropped, view.grid), SIZE_PX)
    images = {label: png for label, png in pictures.items() if png is not None}
    return caption, NO_MESH if len(images) < len(methods) else draw_renders(images)


def busiest(dropped: Bools, grid: Grid) -> Bounds:
    """Return the square of side `CLOSE_M` with the most True cells; on a tie the northernmost."""
    n = min(round(CLOSE_M / grid.cell), *grid.shape)
    sums = np.pad(dropped.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    counts = sums[n:, n:] - sums[:-n, n:] - sums[n:, :-n] + sums[:-n, :-n]
    row, col = (int(i) for i in np.unravel_index(np.argmax(counts), counts.shape))
    west, north = grid.west + col * grid.cell, grid.north - row * grid.cell
    return west, north - n * grid.cell, west + n * grid.cell, north


def vertex_colours(view: TileView, role: str) -> NDArray[np.uint8]:
    """Return the colour of the error in the cell under each vertex, ``(V, 3)``, red, green and blue."""
    mesh = view.results[role].mesh
    row, col = view.grid.cells(mesh.vertices[:, 0] + mesh.origin[0], mesh.vertices[:, 1] + mesh.origin[1])
    error = drawable(view.error(role)[row, col])
    colours = colormaps[ERROR_COLOURS].with_extremes(bad=UNKNOWN)
    return np.asarray(colours(ERROR_NORM(error), bytes=True)[:, :3])


def draw_renders(pictures: dict[str, bytes]) -> Figure:
    """Draw the PNG pictures side by side with their labels and one colour bar."""
    figure = new_figure(1.75)
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    pixels = [np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) for png in pictures.values()]
    not_white = np.any([image.min(axis=2) < 250 for image in pixels], axis=0)
    rows, cols = (np.flatnonzero(not_white.any(axis=axis)) for axis in (1, 0))
    for panel, label, image in zip(axes, pictures, pixels, strict=True):
        # All are cropped to the same part: outside of it, every picture is white.
        panel.imshow(image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1])
        panel.set_title(label)
        panel.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(ERROR_NORM, ERROR_COLOURS), ax=list(axes), extend="both", pad=0.01, aspect=20
    )
    bar.set_label("error (m)")
    bar.ax.yaxis.set_major_formatter("{x:g}")
    return figure
