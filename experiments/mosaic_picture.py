"""Draw docs/images/mosaic.png: what is fitted at a corner, at an edge and inside a tile, and to which ground.

``PYTHONPATH=. python experiments/mosaic_picture.py docs/images/mosaic.png``. Tiles have 8 intervals instead
of 70, and the distance H is 4 intervals.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

INTERVALS, REACH, DEGREE = 8, 4, 3
GROUND, FITTED, HELD, OTHER = "#f6e3b4", "#d1495b", "#2a6f97", "0.55"
Span = tuple[int, int]
"""First and last line."""


def points(axes: Axes, u: Span, v: Span, color: str, size: float, marker: str = "o") -> None:
    """Draw the control points of a block."""
    x, y = np.meshgrid(np.arange(u[0], u[1] + 1), np.arange(v[0], v[1] + 1))
    axes.scatter(x, y, s=size, c=color, marker=marker, linewidths=0, zorder=3)


def panel(axes: Axes, title: str, u: Span, v: Span) -> None:
    """Draw the lattice, four tiles, and the window from which control points are computed."""
    first, last = -INTERVALS - REACH, INTERVALS + REACH
    lines = np.arange(first, last + 1)
    axes.add_patch(Rectangle((u[0], v[0]), u[1] - u[0], v[1] - v[0], facecolor=GROUND, zorder=0))
    axes.vlines(lines, first, last, color="0.87", linewidth=0.6, zorder=1)
    axes.hlines(lines, first, last, color="0.87", linewidth=0.6, zorder=1)
    borders = (-INTERVALS, 0, INTERVALS)
    axes.vlines(borders, first, last, color="black", linewidth=1.6, zorder=2)
    axes.hlines(borders, first, last, color="black", linewidth=1.6, zorder=2)
    points(axes, (first, last), (first, last), OTHER, 2.0)
    axes.set_title(title, fontsize=13, loc="left")
    axes.set(xlim=(first, last), ylim=(first, last), xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_visible(False)


def distance(
    axes: Axes, start: tuple[float, float], stop: tuple[float, float], at: tuple[float, float]
) -> None:
    """Draw the distance H."""
    axes.annotate(
        "", stop, start, arrowprops={"arrowstyle": "<->", "linewidth": 1.2, "shrinkA": 0, "shrinkB": 0}
    )
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
    axes.text(*at, "H", fontsize=13, ha="center", va="center", zorder=5, bbox=box)


def picture(path: Path) -> None:
    """Write the picture."""
    n, h, half = INTERVALS, REACH, DEGREE // 2
    figure, (corner, edge, inside) = plt.subplots(1, 3, figsize=(11, 4.55))
    block, between = (-half, half), (half + 1, n - half - 1)
    far = n - half, n + half

    panel(corner, "1. Corner: 3 x 3 points", (-h, h), (-h, h))
    points(corner, block, block, FITTED, 26)
    distance(corner, (0, -h - 0.8), (h, -h - 0.8), (h / 2, -h - 2.0))

    panel(edge, "2. Edge: the 3 columns between", (-h, h), (-h, n + h))
    for ends in (block, far):
        points(edge, block, ends, HELD, 26, "s")
    points(edge, block, between, FITTED, 26)
    distance(edge, (0, -h - 0.8), (h, -h - 0.8), (h / 2, -h - 2.0))

    panel(inside, "3. Interior: all other points", (0, n), (0, n))
    for part in (block, far):
        points(inside, part, (-half, n + half), HELD, 26, "s")
        points(inside, between, part, HELD, 26, "s")
    points(inside, between, between, FITTED, 26)

    dot = {"linestyle": "none", "markersize": 7}
    handles = [
        plt.Line2D([], [], color="black", linewidth=1.6, label="border of tiles"),
        plt.Line2D([], [], color="0.75", linewidth=1, label="line of the lattice"),
        Rectangle((0, 0), 1, 1, facecolor=GROUND, label="ground that is fitted"),
        plt.Line2D([], [], color=FITTED, marker="o", label="points kept from this fit", **dot),
        plt.Line2D([], [], color=HELD, marker="s", label="points held", **dot),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=5, frameon=False, fontsize=12, handlelength=1.4)
    figure.subplots_adjust(left=0.01, right=0.99, top=0.93, bottom=0.09, wspace=0.05)
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    picture(Path(sys.argv[1]))
