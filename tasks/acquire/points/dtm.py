"""Bare ground from ground points: a TIN of one node per cell, or the cells' means."""

from __future__ import annotations

import math

import numpy as np

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.points import fill_voids
from flexroad.tasks.acquire.points.binning import Cells, means
from flexroad.tasks.acquire.points.tin import tin
from flexroad.tasks.types import Floats

SPARSEST = 2 * math.sqrt(2)
"""Nodes of a gapless raster leave circles of up to so many cells empty, wherever they lie in their cells."""


def triangulated(
    cells: Cells, easting: Floats, northing: Floats, height: Floats, grid: Grid, void_m: float
) -> Floats:
    """Return the ground at the cell centres, linear between the cells' centroids, ``(H, W)``, m.

    A centroid is the mean of its points in plan and height: exact on planes, however the points lie in
    their cell, and without the low bias of lowest points. A cell with ground whose centre is outside all
    triangles, as at the border of the survey, takes its points' mean height.

    Parameters
    ----------
    cells : Cells
        The cells of the ground points, ``(n,)``.
    easting, northing, height : Floats
        The ground points, ``(n,)``, m.
    grid : Grid
        The cells.
    void_m : float
        The ground stays void where a disc of this diameter, and a little wider, has no node (m).
    """
    east, north, mean = means(cells, grid.shape, easting - grid.west, northing - grid.north, height)
    ground = tin(east, north, mean, grid, void_m + SPARSEST * grid.cell)
    return np.where(np.isnan(ground), mean, ground)


def averaged(cells: Cells, height: Floats, grid: Grid, void_m: float) -> Floats:
    """Return the mean height of the ground points per cell, voids up to ``void_m`` filled, ``(H, W)``, m."""
    (mean,) = means(cells, grid.shape, height)
    return fill_voids.fill(mean, grid, void_m)


def reach_m(void_m: float, cell: float) -> float:
    """Return how far from a cell ground points can change the triangulated ground there (m)."""
    return math.ceil(void_m / cell + SPARSEST) * cell
