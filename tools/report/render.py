"""Pictures for reports, as PNG bytes 480 pixels wide: maps of one tile, and line charts.

Maps have north up and metres on the axes. Their ``grid`` gives the place of the cells. Pictures of meshes are
in `pictures`.
"""

from __future__ import annotations

import io
import logging
import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray
from PIL import Image

from flexroad.catalog import Grid
from flexroad.tasks.quality.flagged import Place
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.types import Bools, Floats

log = logging.getLogger(__name__)

DPI = 100
WIDTH_PX, MAP_PX = 480, 340
"""Widths of a picture and of the map in it."""
TRUE_COLOUR_BYTES = 100_000
"""Largest size of a PNG in true colours (bytes); larger pictures are reduced to 256 colours."""
LEFT_PX, BELOW_PX, GAP_PX = 46, 42, 10
"""Space left of and below the map, and between map and legend."""

RELIEF = LinearSegmentedColormap.from_list(
    "relief", ["#8fae9a", "#b9c7a0", "#e6dcb4", "#d9bd90", "#c4a183", "#e9e2da"]
)
ROAD, KEPT, DROPPED = "#33373d", "#1f6fb2", "#f0681a"
BY_DTM = "#8a5fbf"
TRUE = "#00d5ff"
"""Colour of labels' outlines: it contrasts with grass, asphalt and roofs."""
OVERLAY = 0.72
"""Opacity of a mask over the relief."""
UNKNOWN = "#f2f2f2"
"""Colour of cells without a value."""
SUN_AZIMUTH_DEG, SUN_ALTITUDE_DEG = 315.0, 45.0
COLOURS = "YlOrRd"
LIMIT_M = 0.5
"""End of the colour bar: larger values have the same colour."""
CIRCLE, RING = "#1c2430", "#ffffff"
NEAR, LINE = 0.3, 0.04
"""Distance across which labels may overlap, and distance of their lines, as shares of the map's width."""


def hillshade(height: Floats, grid: Grid) -> bytes:
    """Draw heights (m), ``(H, W)``, as a shaded relief with a colour bar; NaN stays empty."""
    low, high = _limits(height)
    norm = Normalize(low, high)
    rgb = _shaded(RELIEF(norm(height))[..., :3], height, grid.cell)
    figure, axes = _map(rgb, grid)
    _colour_bar(figure, axes, RELIEF, norm, "height (m)")
    return _png(figure)


def filter_picture(height: Floats, raw: Bools, kept: Bools, grid: Grid) -> bytes:
    """Draw the kept and the dropped part of a road mask over the relief; the legend gives both areas.

    - `height`: the DSM (m), ``(H, W)``.
    - `raw`, `kept`: road before and after the filter (the paper's M^r and M^{r+}), ``(H, W)``.
    """
    return _parts_picture(height, (("kept", kept, KEPT), ("dropped", raw & ~kept, DROPPED)), grid)


def height_source_picture(height: Floats, height_source: NDArray[np.uint8], road: Bools, grid: Grid) -> bytes:
    """Draw the height source of the surface on road cells over the relief; the legend gives the areas.

    - `height`: the DSM (m), ``(H, W)``.
    - `height_source`: class of each cell, a `flexroad.tasks.quality.height_source.HeightSource`, ``(H, W)``.
    - `road`: road cells before the filter, ``(H, W)``.
    """
    kinds = (HeightSource.MEASURED, KEPT), (HeightSource.DTM, BY_DTM), (HeightSource.INFERRED, DROPPED)
    names = {HeightSource.MEASURED: "measured", HeightSource.DTM: "DTM", HeightSource.INFERRED: "inferred"}
    parts = [(names[kind], road & (height_source == kind), colour) for kind, colour in kinds]
    return _parts_picture(height, parts, grid)


def _parts_picture(height: Floats, parts: Sequence[tuple[str, Bools, str]], grid: Grid) -> bytes:
    """Draw areas (name, cells, colour) over a grey relief, with a legend."""
    grey = np.broadcast_to(np.array(to_rgb("#e4e2dd")), (*height.shape, 3))
    rgb = _shaded(grey, height, grid.cell)
    for _, mask, colour in parts:
        rgb = np.where(mask[..., None], (1 - OVERLAY) * rgb + OVERLAY * np.array(to_rgb(colour)), rgb)
    figure, axes = _map(rgb, grid)
    entries = [
        Patch(color=colour, alpha=OVERLAY, label=f"{name}\n{mask.sum() * grid.cell**2:,.0f} m²")
        for name, mask, colour in parts
    ]
    legend = _beside(figure, axes, WIDTH_PX - LEFT_PX - MAP_PX - GAP_PX)
    legend.set_axis_off()
    legend.legend(
        handles=entries,
        loc="upper left",
        frameon=False,
        fontsize=8,
        handlelength=1,
        handletextpad=0.5,
        borderaxespad=0,
    )
    return _png(figure)


def error_map(error: Floats, grid: Grid, road: Bools | None = None, limit_m: float | None = None) -> bytes:
    """Draw signed vertical errors: red is too high, blue too low, arrows mean that some exceed the limit.

    - `error`: mesh or surface minus reference (m), ``(H, W)``; NaN stays empty.
    - `road`: cells whose outline is drawn.
    - `limit_m`: end of the colour bar on both sides (m). By default the 98th percentile of the absolute
      error, rounded up to 1, 2 or 5 times a power of ten; set it to compare pictures.
    """
    limit = limit_m if limit_m is not None else _round_limit(error)
    figure, axes = _map(error, grid, "RdBu_r", Normalize(-limit, limit))
    if road is not None:
        _outline(axes, road, grid, "#222222", 0.6)
    beyond = bool(np.nanmax(np.abs(error), initial=0.0) > limit)
    label = "too low  ←  error (m)  →  too high"
    _colour_bar(figure, axes, "RdBu_r", Normalize(-limit, limit), label, "both" if beyond else "neither")
    return _png(figure)


def segmentation_map(photo: NDArray[np.uint8], truth: Bools, segmented: Bools, grid: Grid) -> bytes:
    """Draw the outlines of labelled and segmented road over an orthophoto.

    - `photo`: an orthophoto of the grid (red, green, blue), ``(3, h, w)``.
    - `truth`, `segmented`: road by the labels and by the segmenter, ``(H, W)``.
    """
    figure, axes = _map(np.moveaxis(photo, 0, -1) / 255, grid)
    # The first line is wider, so that it is visible below the second line where both agree.
    parts = (("labels", truth, TRUE, 2.4), ("segmented", segmented, DROPPED, 0.9))
    for _, mask, colour, width in parts:
        _outline(axes, mask, grid, colour, width)
    legend = _beside(figure, axes, WIDTH_PX - LEFT_PX - MAP_PX - GAP_PX)
    legend.set_axis_off()
    handles = [Line2D([], [], color=colour, lw=width, label=name) for name, _, colour, width in parts]
    legend.legend(handles=handles, loc="upper left", frameon=False, fontsize=8, handlelength=1.2)
    return _png(figure)


def curves(
    lines: Mapping[str, tuple[Floats, Floats]],
    labels: tuple[str, str],
    limits: tuple[tuple[float, float] | None, tuple[float, float] | None] = (None, None),
    mark: tuple[float, float, str] | None = None,
) -> bytes:
    """Draw lines in one chart.

    - `lines`: the x and y values of each line by name, ``(n,)`` each.
    """
    figure = Figure(figsize=(WIDTH_PX / DPI, 3.4), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    for (name, (x, y)), colour in zip(lines.items(), (KEPT, DROPPED, ROAD), strict=False):
        axes.plot(x, y, color=colour, lw=1.6, label=name)
    if mark is not None:
        axes.plot(*mark[:2], "o", color=DROPPED, ms=6, label=mark[2])
    axes.set(xlabel=labels[0], ylabel=labels[1], xlim=limits[0], ylim=limits[1])
    axes.grid(color="#e4e2dd", lw=0.6)
    axes.tick_params(labelsize=8, length=2)
    axes.legend(fontsize=8, frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return _png(figure)


def _limits(height: Floats) -> tuple[float, float]:
    """Return the 1st and 99th percentile, so that single high objects do not dominate the colours."""
    valid = height[np.isfinite(height)]
    if valid.size == 0:
        return 0.0, 1.0
    low, high = np.percentile(valid, [1, 99])
    return float(low), float(max(high, low + 0.5))


def _round_limit(error: Floats) -> float:
    valid = np.abs(error[np.isfinite(error)])
    robust = max(float(np.percentile(valid, 98)) if valid.size else 0.0, 0.01)
    power = 10.0 ** math.floor(math.log10(robust))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= robust * (1 - 1e-9))


def _shaded(rgb: Floats, height: Floats, cell: float) -> Floats:
    """Shade colours by Lambert's law with the sun in the north-west; level ground keeps its colour."""
    # Next to NaN cells the gradient is NaN; these cells are shaded like level ground.
    south, east = (np.asarray(np.nan_to_num(slope)) for slope in np.gradient(height, cell))
    light = np.clip(0.5 * sunlight(east, south), 0, 1)[..., None]
    lit: Floats = 2 * light * rgb + (1 - 2 * light) * rgb**2
    return np.where(np.isfinite(height)[..., None], lit, to_rgb(UNKNOWN))


def sunlight(east: Floats, south: Floats) -> Floats:
    """Return the light on slopes to the east and south relative to level ground, by Lambert's law."""
    azimuth, altitude = math.radians(SUN_AZIMUTH_DEG), math.radians(SUN_ALTITUDE_DEG)
    sun_east, sun_north = math.sin(azimuth) * math.cos(altitude), math.cos(azimuth) * math.cos(altitude)
    facing = (math.sin(altitude) - sun_east * east + sun_north * south) / np.sqrt(1 + east**2 + south**2)
    return np.asarray(facing / math.sin(altitude))


def _map(
    values: Floats, grid: Grid, colours: str | None = None, norm: Normalize | None = None
) -> tuple[Figure, Axes]:
    """Return a figure with a map of colours or numbers; axes in metres from the tile's south-west corner."""
    scale = min(MAP_PX / grid.width, 2 * MAP_PX / grid.height)
    width, height = max(scale * grid.width, 60), max(scale * grid.height, 60)
    size = WIDTH_PX, BELOW_PX + height + 8
    figure = Figure(figsize=(size[0] / DPI, size[1] / DPI), dpi=DPI)
    axes = figure.add_axes((LEFT_PX / size[0], BELOW_PX / size[1], width / size[0], height / size[1]))
    axes.set_facecolor(UNKNOWN)
    extent = (0.0, grid.width * grid.cell, 0.0, grid.height * grid.cell)
    axes.imshow(np.ma.masked_invalid(values), cmap=colours, norm=norm, extent=extent, origin="upper")
    axes.set_xlabel(f"m east of {grid.west:,.10g}", fontsize=8)
    axes.set_ylabel(f"m north of {grid.south:,.10g}", fontsize=8)
    axes.tick_params(labelsize=7, length=2)
    return figure, axes


def _outline(axes: Axes, mask: Bools, grid: Grid, colour: str, width: float) -> None:
    """Draw the outline of a mask on a map."""
    if mask.any() and not mask.all():
        east, north = grid.eastings - grid.west, grid.northings - grid.south
        axes.contour(east, north, mask, levels=[0.5], colors=colour, linewidths=width)


def _beside(figure: Figure, axes: Axes, width_px: float) -> Axes:
    """Return new axes to the right of the map, of the same height."""
    place = axes.get_position()
    return figure.add_axes((place.x1 + GAP_PX / WIDTH_PX, place.y0, width_px / WIDTH_PX, place.height))


def _colour_bar(
    figure: Figure, axes: Axes, colours: Colormap | str, norm: Normalize, label: str, extend: str = "neither"
) -> None:
    bar = figure.colorbar(ScalarMappable(norm, colours), cax=_beside(figure, axes, 12), extend=extend)
    bar.set_label(label, fontsize=8)
    bar.ax.tick_params(labelsize=7, length=2)
    bar.outline.set_visible(False)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    buffer.seek(0)
    return _small(Image.open(buffer))


def _small(picture: Image.Image) -> bytes:
    """Return the picture as a PNG: in true colours if that is small, else in 256 colours.

    256 colours take a third of the bytes. They would be visible only on smooth pictures, which are small.
    """
    true = picture.convert("RGB")
    full = _encoded(true)
    if len(full) <= TRUE_COLOUR_BYTES:
        return full
    # MAXCOVERAGE keeps rare colours, such as the ends of a colour bar.
    return _encoded(true.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE))


def _encoded(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="png", optimize=True)
    return buffer.getvalue()


def estimate_picture(
    height: Floats, estimate: Floats, road: Bools, grid: Grid, places: Mapping[str, Place]
) -> bytes:
    """Draw the error estimate of the road over the relief.

    - `height`: the DSM (m), ``(H, W)``.
    - `estimate`: estimated error of the surface (m), ``(H, W)``.
    - `road`: road cells before the filter, ``(H, W)``.
    - `places`: place by flag; each has a circle, with the names of its flags.
    """
    norm = Normalize(0, LIMIT_M, clip=True)
    grey = np.broadcast_to(np.array(to_rgb("#e4e2dd")), (*height.shape, 3))
    relief = _shaded(grey, height, grid.cell)
    coloured = colormaps[COLOURS](norm(np.nan_to_num(estimate)))[..., :3]
    rgb = np.where((road & np.isfinite(estimate))[..., None], coloured, relief)
    figure, axes = _map(rgb, grid)
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
        # From south to north, each label at least a line above the previous label, if both are near.
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
