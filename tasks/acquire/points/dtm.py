"""DTM from ground points: a TIN with one node per cell, or the mean per cell."""

from __future__ import annotations

import math

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points import fill_voids
from flexroad.tasks.acquire.points.binning import Cells, means
from flexroad.tasks.acquire.points.tin import tin
from flexroad.tasks.types import Floats

EMPTY_CIRCLE_CELLS = 2 * math.sqrt(2)
"""Largest diameter (cells) of an empty circle between nodes at any position in cells that all have one."""


def triangulated(
    cells: Cells, easting: Floats, northing: Floats, height: Floats, grid: Grid, void_m: float
) -> Floats:
    """Return the ground height at the cell centres, linear between the centroids of cells, ``(H, W)``, m.

    A centroid is the mean of the points of a cell in plan and height: it is exact on planes and not biased,
    as the lowest point would be. A cell with ground points whose centre is outside all triangles, as at the
    border of the survey, has the mean height of its points.

    Parameters
    ----------
    cells : Cells
        The cells of the ground points, ``(n,)``.
    easting, northing, height : Floats
        The ground points, ``(n,)``, m.
    grid : Grid
        The cells.
    void_m : float
        The DTM is NaN where a circle of this diameter plus `EMPTY_CIRCLE_CELLS` has no node (m).
    """
    east, north, mean = means(cells, grid.shape, easting - grid.west, northing - grid.north, height)
    ground = tin(east, north, mean, grid, void_m + EMPTY_CIRCLE_CELLS * grid.cell)
    return np.where(np.isnan(ground), mean, ground)


def averaged(cells: Cells, height: Floats, grid: Grid, void_m: float) -> Floats:
    """Return the mean height of the ground points per cell, voids up to ``void_m`` filled, ``(H, W)``, m."""
    (mean,) = means(cells, grid.shape, height)
    return fill_voids.fill(mean, grid, void_m)


def reach_m(void_m: float, cell: float) -> float:
    """Return the largest distance from a cell at which points can change its triangulated height (m)."""
    return math.ceil(void_m / cell + EMPTY_CIRCLE_CELLS) * cell
