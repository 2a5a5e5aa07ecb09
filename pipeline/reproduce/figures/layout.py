"""What all figures share: the page, the type and the colours they are drawn in, and how they are saved."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.typing import RcKeyType

from flexroad.catalog.storage.paths import write

WIDTH_IN = 7.0
"""Width of a page's text."""
DPI = 220

RAW, PLANE, FLEXROAD, TRUTH, PATH = "#f08c00", "#2f9e44", "#1c5fb8", "#8a8f98", "#d6293e"
"""Colours of the paper's Fig. 1: orange, green, blue, and the vehicle's path in red."""
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
    # Text stays text in the PDF.
    "pdf.fonttype": 42,
}


@dataclass(frozen=True, eq=False)
class FigureFile:
    """A figure with its caption, or why there is none."""

    name: str
    """Of its files, without suffix."""
    caption: str
    figure: Figure | None
    missing: str = ""


def new_figure(height_in: float) -> Figure:
    """Return an empty figure as wide as a page's text."""
    return Figure(figsize=(WIDTH_IN, height_in))


def save(figure: Figure, folder: Path, name: str) -> None:
    """Write NAME.pdf and NAME.png; equal figures give equal bytes."""
    # A date or a version in the file would change it from day to day.
    for kind, metadata in (("pdf", {"CreationDate": None, "Producer": None}), ("png", {"Software": None})):
        buffer = io.BytesIO()
        with rc_context(STYLE):
            figure.savefig(buffer, format=kind, dpi=DPI, metadata=metadata)
        write(folder / f"{name}.{kind}", buffer.getvalue())
