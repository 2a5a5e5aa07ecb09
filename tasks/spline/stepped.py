"""A spline with steps beside roads: kerbs, walls and banks, which a smooth surface cannot follow.

The spline is the road's surface, continued beside it. A cell beside the road has a step: the height of the
ground there above the spline. So both sides of a kerb have their own height, and the road stays smooth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Bools, Floats, RoadClusters, TileData

SAME_M = 0.25
"""A DSM within this of the spline (m) shows the ground: it is the road, or as low as a kerb."""
OPEN_M = 0.2
"""A DSM within this of the DTM (m) shows the ground, too."""
ROUNDED = 0.1
"""Share of the rise of the DTM across three cells by which it may be more, at a wall."""
ALIKE_M = 0.1
"""Standard deviation of the weights of neighbouring cells by the difference of their steps (m)."""
WALL_M = 0.5
"""Where objects hide the ground, smaller steps are left out (m): they are not known there."""
BEYOND_M = 3.0
"""Distance from the cells whose DTM is left out up to which the spline may still be off (m). Nearer to the
road than this, cells with a DTM were dropped by the filter, and are no ground beside it."""


@dataclass(frozen=True, eq=False)
class SteppedSurface(NurbsSurface):
    """A spline, and the steps of cells above it; the slope and the normal are the spline's."""

    steps: NDArray[np.float32]
    """Height of the ground above the spline, ``(H, W)``, m; 0 on the road, and along the tile's border."""
    cells: Grid
    """The cells of the steps."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in their broadcast shape."""
        return np.asarray(self.smooth(easting, northing) + self.steps[self.cells.cells(easting, northing)])

    def smooth(self, easting: Floats, northing: Floats) -> Floats:
        """Return the heights of the spline (m) at scattered points, in their broadcast shape."""
        return super().height(easting, northing)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""
        row, col = self.cells.cells(eastings, northings)
        return np.asarray(super().lattice(eastings, northings) + self.steps[np.ix_(row, col)])


def with_steps(data: TileData, clusters: RoadClusters, surface: NurbsSurface) -> SteppedSurface:
    """Return a tile's surface with the steps of the cells beside its road."""
    from flexroad.tasks.roads.road_height import ground_heights

    steps = steps_beside(ground_heights(data, clusters), clusters, surface)
    return SteppedSurface(**vars(surface), steps=steps, cells=data.core)


def steps_beside(data: TileData, clusters: RoadClusters, surface: NurbsSurface) -> NDArray[np.float32]:
    """Return the steps of the cells beside the road, ``(H, W)``, m, on the tile's core; else 0.

    These are the cells whose DTM the fit leaves out, and those near them. Their height is the DSM's where it
    shows the ground. It is averaged with the neighbours' whose steps are alike, so that edges remain.

    Parameters
    ----------
    data, clusters : TileData, RoadClusters
        The heights, and the cells whose DTM is left out.
    surface : NurbsSurface
        The spline fitted to them.
    """
    core, window = data.core, data.grid.window(data.core)
    steps = np.zeros(core.shape, np.float32)
    if clusters.dtm_invalid is None:
        return steps
    unknown = clusters.dtm_invalid[window] & ~clusters.mask[window]
    beside = unknown | (_within(unknown, core) & ~_within(clusters.mask[window], core))
    dsm, dtm = data.dsm[window], data.dtm[window]
    spline = surface.lattice(core.eastings, core.northings)
    rise = dsm - spline
    seen = beside & ((np.abs(rise) <= SAME_M) | _is_open(dsm, dtm))
    # Neighbours meet in the spline.
    beside[[0, -1]], beside[:, [0, -1]] = False, False
    around = _around(np.where(seen, rise, np.nan), beside)
    smoothed = (dtm - spline)[beside]
    walls = np.where(unknown[beside], _walls(around, smoothed), smoothed)
    walls = np.where(np.abs(walls) >= WALL_M, walls, 0.0)
    own = np.where(seen[beside], rise[beside], walls)
    weights = np.where(np.isfinite(around), np.exp(-0.5 * ((around - own[:, None]) / ALIKE_M) ** 2), 0.0)
    total = weights.sum(axis=1)
    means = (weights * np.nan_to_num(around)).sum(axis=1) / np.maximum(total, 1e-300)
    steps[beside] = np.where(seen[beside], means, own)
    return steps


def _within(cells: Bools, grid: Grid) -> Bools:
    """Return the cells at most `BEYOND_M` away from the given ones, ``(H, W)``."""
    if not cells.any():
        return cells
    away: Floats = scipy.ndimage.distance_transform_edt(~cells)
    return np.asarray(away * grid.cell <= BEYOND_M)


def _is_open(dsm: Floats, dtm: Floats) -> Bools:
    """Return the cells whose DSM is the DTM's height, or at a wall that of the ground above or below it."""
    low = scipy.ndimage.minimum_filter(np.nan_to_num(dtm, nan=np.inf), 3)
    high = scipy.ndimage.maximum_filter(np.nan_to_num(dtm, nan=-np.inf), 3)
    # The DTM is smoothed: beside the wall it has not reached the full height.
    reach = OPEN_M + ROUNDED * np.maximum(high - low, 0.0)
    away = np.minimum(np.abs(dsm - low), np.abs(dsm - high))
    return np.asarray((np.abs(dsm - dtm) <= OPEN_M) | (away <= reach))


def _around(values: Floats, cells: Bools) -> Floats:
    """Return the values of each cell and its eight neighbours, ``(n, 9)``; no cell is at the border."""
    row, col = np.nonzero(cells)
    return np.stack([values[row + i, col + j] for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=1)


def _walls(around: Floats, smoothed: Floats) -> Floats:
    """Return the steps of hidden cells, ``(n,)``, m: the median of the known steps around, or 0.

    A smoothed step is half as high at the wall as behind it, so that the DTM tells the side of the wall.

    Parameters
    ----------
    around : ndarray, (n, 9)
        Steps of the cell and its neighbours; NaN where hidden.
    smoothed : ndarray, (n,)
        The DTM above the spline.
    """
    ordered, count = np.sort(around, axis=1), np.isfinite(around).sum(axis=1)
    rows = np.arange(len(around))
    medians = (ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, 8)]) / 2
    return np.where(smoothed * np.sign(medians) >= np.abs(medians) / 2, medians, 0.0)
