"""Meshes without NURBS, without ECSRC and of the full pipeline, coloured by error (the ablation figure)."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog import Grid
from flexroad.catalog.grid import Bounds
from flexroad.pipeline.report.mesh_pictures import render_meshes
from flexroad.pipeline.report.pictures import NO_MESH
from flexroad.pipeline.reproduce.figures.layout import FigureFile, new_figure
from flexroad.pipeline.reproduce.figures.roles import Roles
from flexroad.pipeline.reproduce.figures.scales import ERROR_COLOURS, ERROR_NORM, drawable
from flexroad.pipeline.reproduce.figures.tile_view import TileView, missing_roles
from flexroad.tasks.types import Bools

NAME = "ablation_renders"
SIZE_PX = (760, 540)
UNKNOWN = "#d0d0d0"
CLOSE_M = 120.0
"""Side of the square that is drawn (m); on a complete tile the details would be too small."""


def make_figure(view: TileView, roles: Roles) -> FigureFile:
    """Make the figure: oblique views of the three meshes. Needs OpenGL."""
    methods = (("w/o NURBS", roles.wo_nurbs), ("w/o ECSRC", roles.wo_ecsrc), ("FlexRoad in full", roles.full))
    caption = (
        f"{view}: meshes without NURBS, without ECSRC and of the full pipeline, coloured by their vertical "
        f"distance to {view.against} as in the error maps. The square of {CLOSE_M:g} m is the one in which "
        "ECSRC drops the largest area of the road mask; on the complete tile it drops "
        f"{view.dropped.sum() * view.grid.cell**2:,.0f} m²."
    )
    columns = {label: variant for label, variant in methods if variant is not None}
    missing = missing_roles(methods)
    if missing:
        return FigureFile(NAME, caption, None, missing)
    meshes = {variant: view.results[variant].mesh for variant in columns.values()}
    colours = {variant: vertex_colours(view, variant) for variant in columns.values()}
    pictures = render_meshes(meshes, colours, busiest(view.dropped, view.grid), SIZE_PX)
    images = {label: png for label, variant in columns.items() if (png := pictures[variant]) is not None}
    if len(images) < len(columns):
        return FigureFile(NAME, caption, None, NO_MESH)
    return FigureFile(NAME, caption, draw(images))


def busiest(dropped: Bools, grid: Grid) -> Bounds:
    """Return the square of side `CLOSE_M` with the most True cells; on a tie the northernmost."""
    n = min(round(CLOSE_M / grid.cell), *grid.shape)
    sums = np.pad(dropped.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    counts = sums[n:, n:] - sums[:-n, n:] - sums[n:, :-n] + sums[:-n, :-n]
    row, col = (int(i) for i in np.unravel_index(np.argmax(counts), counts.shape))
    west, north = grid.west + col * grid.cell, grid.north - row * grid.cell
    return west, north - n * grid.cell, west + n * grid.cell, north


def vertex_colours(view: TileView, variant: str) -> NDArray[np.uint8]:
    """Return the colour of the error in the cell under each vertex, ``(V, 3)``, red, green and blue."""
    mesh = view.results[variant].mesh
    row, col = view.grid.cells(mesh.vertices[:, 0] + mesh.origin[0], mesh.vertices[:, 1] + mesh.origin[1])
    error = drawable(view.error(variant)[row, col])
    colours = colormaps[ERROR_COLOURS].with_extremes(bad=UNKNOWN)
    return np.asarray(colours(ERROR_NORM(error), bytes=True)[:, :3])


def draw(pictures: dict[str, bytes]) -> Figure:
    """Draw the PNG pictures side by side with their labels and one colour bar."""
    figure = new_figure(1.75)
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    pixels = [np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) for png in pictures.values()]
    not_white = np.any([image.min(axis=2) < 250 for image in pixels], axis=0)
    rows, cols = (np.flatnonzero(not_white.any(axis=axis)) for axis in (1, 0))
    for panel, label, image in zip(axes, pictures, pixels, strict=True):
        # All cropped alike, to the part that is not white in at least one.
        panel.imshow(image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1])
        panel.set_title(label)
        panel.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(ERROR_NORM, ERROR_COLOURS), ax=list(axes), extend="both", pad=0.01, aspect=20
    )
    bar.set_label("error (m)")
    bar.ax.yaxis.set_major_formatter("{x:g}")
    return figure
