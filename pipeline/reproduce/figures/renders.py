"""Meshes without NURBS, without the filter and in full, coloured by error: the paper's ablation figure."""

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
"""Side of the square that is drawn; of a whole tile too little would be seen."""


def make_figure(view: TileView, roles: Roles) -> FigureFile:
    """Draw the three meshes obliquely; needs OpenGL."""
    parts = (("w/o NURBS", roles.wo_nurbs), ("w/o ECSRC", roles.wo_ecsrc), ("FlexRoad in full", roles.full))
    caption = (
        f"{view}: meshes without NURBS, without ECSRC and in full, coloured by their vertical distance to "
        f"{view.against} in the colours of the error maps. Drawn is the square of {CLOSE_M:g} m "
        "in which ECSRC drops most of the road mask, of which it drops "
        f"{view.dropped.sum() * view.grid.cell**2:,.0f} m² on the tile."
    )
    columns = {label: variant for label, variant in parts if variant is not None}
    missing = missing_roles(parts)
    if missing:
        return FigureFile(NAME, caption, None, missing)
    meshes = {variant: view.results[variant].mesh for variant in columns.values()}
    colours = {variant: vertex_colours(view, variant) for variant in columns.values()}
    pictures = render_meshes(meshes, colours, busiest(view.dropped, view.grid), SIZE_PX)
    shown = {label: png for label, variant in columns.items() if (png := pictures[variant]) is not None}
    if len(shown) < len(columns):
        return FigureFile(NAME, caption, None, NO_MESH)
    return FigureFile(NAME, caption, draw(shown))


def busiest(dropped: Bools, grid: Grid) -> Bounds:
    """Return the square of `CLOSE_M` that holds most of the cells, the northernmost of several."""
    n = min(round(CLOSE_M / grid.cell), *grid.shape)
    sums = np.pad(dropped.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    held = sums[n:, n:] - sums[:-n, n:] - sums[n:, :-n] + sums[:-n, :-n]
    row, col = (int(i) for i in np.unravel_index(np.argmax(held), held.shape))
    west, north = grid.west + col * grid.cell, grid.north - row * grid.cell
    return west, north - n * grid.cell, west + n * grid.cell, north


def vertex_colours(view: TileView, variant: str) -> NDArray[np.uint8]:
    """Return a colour per vertex, ``(V, 3)``: that of the error in the cell under it."""
    mesh = view.results[variant].mesh
    row, col = view.grid.cells(mesh.vertices[:, 0] + mesh.origin[0], mesh.vertices[:, 1] + mesh.origin[1])
    error = drawable(view.error(variant)[row, col])
    colours = colormaps[ERROR_COLOURS].with_extremes(bad=UNKNOWN)
    return np.asarray(colours(ERROR_NORM(error), bytes=True)[:, :3])


def draw(pictures: dict[str, bytes]) -> Figure:
    """Set pictures side by side over their labels, with one colour bar."""
    figure = new_figure(1.75)
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    pixels = [np.asarray(Image.open(io.BytesIO(png)).convert("RGB")) for png in pictures.values()]
    drawn = np.any([image.min(axis=2) < 250 for image in pixels], axis=0)
    rows, cols = (np.flatnonzero(drawn.any(axis=axis)) for axis in (1, 0))
    for one, label, image in zip(axes, pictures, pixels, strict=True):
        # The same part of each, without the white around all.
        one.imshow(image[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1])
        one.set_title(label)
        one.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(ERROR_NORM, ERROR_COLOURS), ax=list(axes), extend="both", pad=0.01, aspect=20
    )
    bar.set_label("error (m)")
    bar.ax.yaxis.set_major_formatter("{x:g}")
    return figure
