"""Page size, fonts, colours and scales shared by all figures, and how figures are saved."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.typing import RcKeyType

from flexroad.catalog.storage.paths import write
from flexroad.tasks.types import Floats
from flexroad.tools.report.pictures import webp

WIDTH_IN = 7.0
"""Width of a figure: the text width of a page (inches)."""
DPI = 220
SMALL_PX = 960
"""Width of the WebP picture, for web pages and mails."""

RAW, PLANE, FLEXROAD, TRUTH, PATH = "#f08c00", "#2f9e44", "#1c5fb8", "#8a8f98", "#d6293e"
"""Colours as in the paper's Fig. 1: raw DSM, plane, FlexRoad, reference (grey) and the vehicle's path."""
STRATA = {"urban": "#4c6a92", "suburban": "#d99a3d", "rural": "#7a9a5b", "": "#8a8f98"}

STYLE: dict[RcKeyType, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.1,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.constrained_layout.use": True,
    # Embeds TrueType fonts: text in the PDF stays text.
    "pdf.fonttype": 42,
}
ERROR_COLOURS, ERROR_NORM = "magma_r", LogNorm(0.01, 10)
"""Scale of errors (m); logarithmic, because errors on one tile range from a centimetre to several metres."""
ANGLE_COLOURS, ANGLE_NORM = "viridis_r", LogNorm(0.1, 60)
"""Scale of angles (degrees), logarithmic."""
LEAST = 1e-9
"""Replaces zeros, which have no logarithm."""


Captioned = tuple[str, Figure | str]
"""A caption, and the figure or the reason why it was not drawn."""


def new_figure(height_in: float) -> Figure:
    """Return an empty figure of width `WIDTH_IN`."""
    return Figure(figsize=(WIDTH_IN, height_in))


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write NAME.pdf, NAME.png and NAME.webp, a small picture; equal figures give equal bytes."""
    files: dict[str, bytes] = {}
    # A date or a software version in the metadata would change the bytes.
    for kind, metadata in (("png", {"Software": None}), ("pdf", {"CreationDate": None, "Producer": None})):
        buffer = io.BytesIO()
        with rc_context(STYLE):
            figure.savefig(buffer, format=kind, dpi=DPI, metadata=metadata)
        # The layout takes as long as the drawing, so the PDF uses the layout of the PNG.
        figure.set_layout_engine("none")
        files[kind] = buffer.getvalue()
        write(folder / f"{name}.{kind}", files[kind])
    write(folder / f"{name}.webp", webp(files["png"], SMALL_PX))


def drawable(values: Floats) -> np.ma.MaskedArray[tuple[int, ...], np.dtype[np.float64]]:
    """Return values with NaN masked and values below `LEAST` raised to `LEAST`."""
    return np.ma.masked_invalid(np.maximum(values, LEAST))
