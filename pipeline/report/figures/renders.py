"""Meshes without NURBS, without the filter and in full, coloured by error: the paper's ablation figure."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from pipeline.report.figures.cast import Cast
from pipeline.report.figures.errors import ERROR_COLOURS, ERROR_NORM
from pipeline.report.figures.plate import Plate, new_figure
from pipeline.report.figures.view import TileView, absent
from pipeline.report.pictures import NO_MESH
from pipeline.report.render import render_meshes

NAME = "ablation_renders"
SIZE_PX = (760, 620)
UNKNOWN = "#d0d0d0"


def plate(view: TileView, cast: Cast) -> Plate:
    """Draw the three meshes obliquely; needs OpenGL."""
    parts = (("w/o NURBS", cast.wo_nurbs), ("w/o ECSRC", cast.wo_ecsrc), ("FlexRoad in full", cast.full))
    caption = (
        f"{view}: the meshes without NURBS, without ECSRC and in full, seen from the south-south-west, "
        "heights one and a half times as large as they are, coloured by their vertical distance to "
        f"{view.against}; the colours are those of the error maps."
    )
    columns = {label: variant for label, variant in parts if variant is not None}
    missing = absent(parts)
    if missing:
        return Plate(NAME, caption, None, missing)
    colours = {variant: vertex_colours(view, variant) for variant in columns.values()}
    meshes = {variant: view.results[variant].mesh for variant in columns.values()}
    pictures = render_meshes(meshes, colours, SIZE_PX)
    shown = {label: png for label, variant in columns.items() if (png := pictures[variant]) is not None}
    if len(shown) < len(columns):
        return Plate(NAME, caption, None, NO_MESH)
    return Plate(NAME, caption, draw(shown))


def vertex_colours(view: TileView, variant: str) -> NDArray[np.uint8]:
    """Return a colour per vertex, ``(V, 3)``: that of the error in the cell under it."""
    mesh = view.results[variant].mesh
    row, col = view.grid.cells(mesh.vertices[:, 0] + mesh.origin[0], mesh.vertices[:, 1] + mesh.origin[1])
    error = np.ma.masked_invalid(view.error(variant)[row, col])
    colours = colormaps[ERROR_COLOURS].with_extremes(bad=UNKNOWN)
    return np.asarray(colours(ERROR_NORM(error), bytes=True)[:, :3])


def draw(pictures: dict[str, bytes]) -> Figure:
    """Set pictures side by side over their labels, with one colour bar."""
    figure = new_figure(2.2)
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    for one, (label, png) in zip(axes, pictures.items(), strict=True):
        one.imshow(np.asarray(Image.open(io.BytesIO(png)).convert("RGB")))
        one.set_title(label)
        one.set_axis_off()
    bar = figure.colorbar(
        ScalarMappable(ERROR_NORM, ERROR_COLOURS), ax=list(axes), extend="both", pad=0.01, aspect=20
    )
    bar.set_label("error (m)")
    bar.ax.yaxis.set_major_formatter("{x:g}")
    return figure
