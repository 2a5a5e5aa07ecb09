"""The way of a vehicle through a tile: the longest one along its roads, on the right of them."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from flexroad.tasks.types import Bools, Floats

EIGHT = np.ones((3, 3), dtype=bool)
EDGE_COST = 8.0
"""How much a way avoids the road's edge: one cell from it a step costs as much as 1 + this in the open."""
SMOOTHING_CELLS = 3.0
STEP_CELLS = 0.5
SIDE = 0.5
"""Part of the way from the middle of the road to its edge."""


def vehicle_trajectory(road: Bools) -> tuple[Floats, Floats]:
    """Return the way as rows and columns half a cell apart; empty where there is no road.

    The two ends are as far from each other as any on the largest connected road, by the shortest way that
    keeps to the middle. Found by going to the far end twice, which is exact on roads without loops. The way
    is then moved to the right, halfway to the road's edge, as vehicles drive.

    Parameters
    ----------
    road : Bools
        Road cells, ``(H, W)``.
    """
    if not road.any():
        return np.empty(0), np.empty(0)
    parts, _ = ndimage.label(road, EIGHT)
    road = parts == np.argmax(np.bincount(parts.ravel())[1:]) + 1
    # Roads go on beyond the tile.
    clear = ndimage.distance_transform_edt(np.pad(road, 16, mode="edge"))[16:-16, 16:-16]
    # Ways start and end in the middle of the road: where no cell around is further from its edge.
    middle = road & (clear == ndimage.maximum_filter(clear, 3))
    number = np.cumsum(road).reshape(road.shape) - 1
    graph = _steps(road, clear, number)
    ends = number[middle]
    start = ends[np.argmax(dijkstra(graph, directed=False, indices=ends[0])[ends])]
    cost, before = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    way = [ends[np.argmax(cost[ends])]]
    while way[-1] != start:
        way.append(before[way[-1]])
    middle_row, middle_col = (axis[way].astype(np.float64) for axis in np.nonzero(road))
    row, col = _smooth(*_to_the_right(middle_row, middle_col, SIDE * clear[road][way]))
    return _inside(row, col, road.shape)


def _steps(road: Bools, clear: Floats, number: np.ndarray) -> sparse.coo_array:
    """Return the cost of every step from a road cell to one of its eight neighbours, each way once."""
    a, b, cost = [], [], []
    height, width = road.shape
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
        there = slice(down, height), slice(max(0, right), width + min(0, right))
        both = road[here] & road[there]
        a.append(number[here][both])
        b.append(number[there][both])
        room = np.minimum(clear[here][both], clear[there][both])
        cost.append(np.hypot(down, right) * (1 + EDGE_COST / room**2))
    n = int(road.sum())
    return sparse.coo_array((np.concatenate(cost), (np.concatenate(a), np.concatenate(b))), shape=(n, n))


def _to_the_right(row: Floats, col: Floats, by: Floats) -> tuple[Floats, Floats]:
    """Move a way by so many cells at right angles to where it goes."""
    if row.size < 2:
        return row, col
    # From cell to cell a way has eight directions only.
    south, east = (
        np.gradient(ndimage.gaussian_filter1d(a, SMOOTHING_CELLS, mode="nearest")) for a in (row, col)
    )
    length = np.maximum(np.hypot(south, east), 1e-9)
    return row + by * east / length, col - by * south / length


def _inside(row: Floats, col: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Cut off the ends that lie beyond the tile, as on the right of a road that leaves it askew."""
    last = shape[0] - 1, shape[1] - 1
    inside = np.flatnonzero((row >= 0) & (row <= last[0]) & (col >= 0) & (col <= last[1]))
    kept = slice(inside[0], inside[-1] + 1) if inside.size else slice(0)
    return row[kept].clip(0, last[0]), col[kept].clip(0, last[1])


def _smooth(row: Floats, col: Floats) -> tuple[Floats, Floats]:
    """Round off the corners of a way from cell to cell, and cut it into equal steps."""
    row, col = (ndimage.gaussian_filter1d(axis, SMOOTHING_CELLS, mode="nearest") for axis in (row, col))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(row), np.diff(col)))])
    at = np.arange(0.0, along[-1], STEP_CELLS)
    return np.interp(at, along, row), np.interp(at, along, col)
