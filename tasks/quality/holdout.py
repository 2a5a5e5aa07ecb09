"""Check the error estimate: withhold squares of road, fit without them, and compare the fit with them.

The intervals of `quality.estimate` should cover 90% of the squares, summed over many tiles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.levels.seen import level_data
from flexroad.tasks.metrics.evaluate import mean
from flexroad.tasks.quality.estimate import INTERVAL, SQUARE_M, compare
from flexroad.tasks.roads.dtm_validity import ground_to_fit
from flexroad.tasks.roads.road_height import with_road_heights
from flexroad.tasks.types import Bools, RoadClusters, RoadMask, Surface, TileData

INSET_M = 15.0
"""Distance of the squares from the tile's border (m): heights nearer to it also affect the fixed border."""
MIN_CELLS = 5
"""Smallest number of kept road cells of a square; the mean of fewer cells is noise."""

Refit = Callable[[TileData, RoadClusters], Surface]
"""Fits data of the tile in the same way as its surface."""


def holdout(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    refit: Refit | None,
    dsm_dtm_tolerance_m: float,
    share: float,
) -> dict[str, float]:
    """Fit without a share of the road's squares, and compare the surface and its error estimate with them.

    - `data`, `road`, `clusters`: as in `tasks.quality.assess.assess`.
    - `refit`: the fit; not needed if ``share`` is 0.
    - `share`: share of the squares that are withheld, from 0 to 1.
    - result: the figures of `Quality` by name.
    """
    if not share or refit is None:
        return _figures(np.nan, np.nan, np.nan)
    seen = level_data(data, clusters)
    window, kept = data.grid.window(data.core), clusters.mask & np.isfinite(seen.dsm)
    squares = withheld_squares(kept[window], data.core, share)
    if not (squares >= 0).any():
        return _figures(0.0, np.nan, np.nan)
    away = np.zeros(data.grid.shape, np.bool_)
    away[window] = squares >= 0
    rest = _without(data, away)
    try:
        surface = refit(rest, clusters)
    except TaskError:
        # Too few heights are left for a second fit; the surface of the tile is not affected.
        return _figures(0.0, np.nan, np.nan)
    cells = compare(rest, road, clusters, surface, dsm_dtm_tolerance_m, only_road=True)
    off = cells.height - ground_to_fit(with_road_heights(seen, clusters), clusters, window)
    counted = (squares >= 0) & kept[window]
    _, number = np.unique(squares[counted], return_inverse=True)
    count = np.bincount(number)
    difference = np.abs(np.bincount(number, off[counted]) / count)
    estimate = np.bincount(number, cells.estimate[counted]) / count
    return _figures(len(count), mean(difference), mean(difference <= INTERVAL * estimate))


def _figures(squares: float, error_m: float, covered: float) -> dict[str, float]:
    return {"holdout_squares": squares, "holdout_error_m": error_m, "holdout_covered": covered}


def withheld_squares(kept: Bools, core: Grid, share: float) -> NDArray[np.int64]:
    """Return the number of the withheld square in each cell of the core, ``(H, W)``; else -1.

    Squares lie at multiples of their side in easting and northing. The choice of withheld squares depends
    only on their position, not on how land is cut into tiles.
    """
    west, south, east, north = core.bounds
    x, y = np.meshgrid(core.eastings, core.northings)
    column, row = (np.floor(axis / SQUARE_M).astype(np.int64) for axis in (x, y))
    inside = (np.minimum(x - west, east - x) > INSET_M) & (np.minimum(y - south, north - y) > INSET_M)
    chosen = inside & (_random(column, row) < share)
    number = np.where(chosen, column * 2**31 + row, -1)
    present, cells = np.unique(np.where(kept, number, -1), return_counts=True)
    enough = present[(cells >= MIN_CELLS) & (present >= 0)]
    return np.where(np.isin(number, enough), number, -1)


def _random(column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return a number from 0 to 1 for each square that looks random (splitmix64)."""
    value = (column.astype(np.uint64) << np.uint64(32)) ^ row.astype(np.uint64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        value = (value ^ (value >> np.uint64(shift))) * np.uint64(factor)
    return (value ^ (value >> np.uint64(31))) / 2.0**64


def _without(data: TileData, away: Bools) -> TileData:
    """Return the data without the heights of some cells."""
    top = data.road_height
    return replace(
        data,
        dsm=np.where(away, np.nan, data.dsm),
        dtm=np.where(away, np.nan, data.dtm),
        road_height=None if top is None else np.where(away, np.nan, top),
    )
