"""Draw docs/images/steps.png: the ground across a road with kerbs, and across one with walls.

``PYTHONPATH=. python experiments/steps_picture.py docs/images/steps.png``. The scenes are those of
tests/bench/bench_steps.py with the true mask.
"""

import sys
from collections.abc import Iterator
from itertools import pairwise

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.segment import mask
from flexroad.tasks.types import Bools, TileData
from tests.bench.bench_steps import FILTER, GRID, tiles

WIDTHS, BESIDE = range(8, 17), 10
"""Widths of the road and cells drawn on each of its sides."""
OPEN_M = 0.3
"""Largest height of the DSM above the truth along the section (m)."""


def sections(data: TileData, road: Bools) -> Iterator[tuple[int, slice]]:
    """Yield row and columns of the open sections across a road."""
    is_open = np.abs(data.dsm - data.reference) < OPEN_M
    for row in range(len(road)):
        edges = np.flatnonzero(np.diff(road[row].astype(int)))
        for left, right in pairwise(edges):
            columns = slice(left + 1 - BESIDE, right + 1 + BESIDE)
            inside = columns.start >= 0 and columns.stop <= road.shape[1]
            if inside and right - left in WIDTHS and road[row, left + 1]:
                alone = road[row, columns].sum() == right - left
                if alone and is_open[row, columns].all():
                    yield row, columns


def draw(axes: Axes, name: str, title: str) -> None:
    """Draw the most level section from west to east of a scene's tiles."""
    # On a slope, kerbs would not be seen.
    data, (row, columns) = min(
        ((tile, place) for tile in tiles(name, 0.0) for place in sections(tile, tile.reference_road)),
        key=lambda found: float(np.ptp(found[0].reference[found[1]])),
    )
    road = mask.segment(data, mask.Options())
    clusters = planar.ecsrc(data, road, FILTER)
    surface = smoothing_spline.fit(data, clusters, smoothing_spline.Options())
    x = np.arange(columns.stop - columns.start) - (columns.stop - columns.start - 1) / 2
    east, north = GRID.eastings[columns], GRID.northings[[row]]
    spline = surface.smooth(east, north)
    datum = data.reference[row, columns].mean()
    for heights, style, label in (
        (data.reference[row, columns], "k-", "truth"),
        (data.dtm[row, columns], "g:", "DTM"),
        (spline, "r--", "spline"),
        (surface.height(east, north), "C0.-", "with steps"),
    ):
        axes.plot(x, heights - datum, style, label=label, linewidth=1.2)
    axes.set(title=title, xlabel="m across the road", ylabel="height (m)")
    axes.grid(alpha=0.3)


def main() -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.9, 3.5), layout="constrained")
    draw(left, "kerbs", "kerbs of 12 cm")
    draw(right, "walls up", "walls of 4 m")
    left.legend(fontsize="small")
    figure.savefig(sys.argv[1], dpi=100)


if __name__ == "__main__":
    main()
