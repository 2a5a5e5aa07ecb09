"""The heights to which roads are fitted: the DSM without the bias of the highest point.

A DSM has the highest point of each cell, which scanner noise lifts above the road. A catalog made from points
has the layer ``road_height`` instead. With rasters alone, the lift is estimated where the road is open
ground: there DSM and DTM are two heights of the same surface, and the DTM is a mean of points.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats, RoadClusters, TileData

OPEN_M = 0.15
"""Largest difference of DSM and DTM on open road (m): less than kerbs, cars and decks differ."""
STEP_M = 25.0
"""Distance of the places at which the offset is estimated (m), on multiples of it in easting and northing."""
REACH_M = 37.5
"""Cells up to this far from a place in easting and northing are used (m)."""
MIN_CELLS = 50
"""Smallest number of open cells around a place; with fewer, it has the offset of all ground."""


def with_road_heights(data: TileData, clusters: RoadClusters) -> TileData:
    """Return the data with the heights to which the road is fitted as DSM of the filtered road cells.

    They are the layer ``road_height``, the DSM minus its `dsm_offset`, or the DSM itself, by the options of
    `load`. Where the layer has no height, the DSM is used.
    """
    heights = ground_heights(data, clusters)
    if heights is data:
        return data
    return replace(heights, dsm=np.where(clusters.mask & np.isfinite(data.dsm), heights.dsm, data.dsm))


def ground_heights(data: TileData, clusters: RoadClusters) -> TileData:
    """Return the data with these heights as DSM of all cells: the ground beside a road has the same bias."""
    if data.road_height is not None:
        heights = np.where(np.isfinite(data.road_height), data.road_height, data.dsm)
    elif data.offset_dsm:
        heights = data.dsm - dsm_offset(data, clusters.mask)
    else:
        return data
    return replace(data, dsm=heights, road_height=None, offset_dsm=False)


def dsm_offset(data: TileData, road: Bools) -> Floats:
    """Return how far the DSM is above open road, ``(H, W)``, m: the local median of DSM minus DTM.

    Medians are taken at places of a lattice that all tiles share, and interpolated linearly. Without open
    road cells the offset is 0.

    - `road`: filtered road cells.
    """
    above = np.where(road, data.dsm - data.dtm, np.nan)
    above[~(np.abs(above) <= OPEN_M)] = np.nan
    if np.isnan(above).all():
        return np.zeros_like(above)
    rows, cols = _places(data.grid)
    medians = np.full((len(rows), len(cols)), float(np.nanmedian(above)))
    reach = REACH_M / data.grid.cell
    for i, row in enumerate(rows):
        for j, col in enumerate(cols):
            around = above[_near(row, reach), _near(col, reach)]
            if np.count_nonzero(np.isfinite(around)) >= MIN_CELLS:
                medians[i, j] = np.nanmedian(around)
    step = STEP_M / data.grid.cell
    at = np.meshgrid(
        (np.arange(data.grid.height) - rows[0]) / step,
        (np.arange(data.grid.width) - cols[0]) / step,
        indexing="ij",
    )
    return np.asarray(scipy.ndimage.map_coordinates(medians, at, order=1, mode="nearest"))


def _places(grid: Grid) -> tuple[Floats, Floats]:
    """Return rows and columns of the places, ascending, that surround the cells of a grid."""
    west, _, _, north = grid.bounds
    step = STEP_M / grid.cell
    col = (np.floor(west / STEP_M) * STEP_M - west) / grid.cell - 0.5
    row = (north - np.ceil(north / STEP_M) * STEP_M) / grid.cell - 0.5
    rows = row + step * np.arange(np.ceil((grid.height - row) / step) + 1)
    cols = col + step * np.arange(np.ceil((grid.width - col) / step) + 1)
    return rows, cols


def _near(centre: float, reach: float) -> slice:
    return slice(max(0, int(np.ceil(centre - reach))), max(0, int(np.floor(centre + reach)) + 1))
