"""The path of a vehicle through a tile: the longest path along its roads, in the right-hand lane."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from flexroad.tasks.types import Bools, Floats

EIGHT = np.ones((3, 3), dtype=bool)
EDGE_COST = 8.0
"""Extra cost of a step near the road's edge: factor 1 + EDGE_COST / d^2 at d cells from the edge."""
SMOOTHING_CELLS = 3.0
"""Standard deviation of the Gaussian that smooths the path."""
STEP_CELLS = 0.5
"""Distance between the points that are returned."""
SIDE = 0.5
"""Shift to the right, as a fraction of the distance from the middle of the road to its edge."""


def vehicle_trajectory(road: Bools) -> tuple[Floats, Floats]:
    """Return the path as rows and columns, `STEP_CELLS` apart; empty if there is no road.

    The path is the longest of all shortest paths (with a cost that keeps to the middle of the road) between
    two cells of the largest connected road. It is computed by two searches, the second from the far
    end of the first, which is exact on roads without loops. It is then moved to the right, halfway to the
    edge of the road.

    - `road`: road cells, ``(H, W)``.
    """
    if not road.any():
        return np.empty(0), np.empty(0)
    parts, _ = ndimage.label(road, EIGHT)
    road = parts == np.argmax(np.bincount(parts.ravel())[1:]) + 1
    # Padded, because roads continue beyond the tile.
    clear = ndimage.distance_transform_edt(np.pad(road, 16, mode="edge"))[16:-16, 16:-16]
    # Paths start and end in the middle of the road: at cells with the largest edge distance in 3 x 3 cells.
    middle = road & (clear == ndimage.maximum_filter(clear, 3))
    number = np.cumsum(road).reshape(road.shape) - 1
    graph = _steps(road, clear, number)
    ends = number[middle]
    start = ends[np.argmax(dijkstra(graph, directed=False, indices=ends[0])[ends])]
    cost, previous = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    path = [ends[np.argmax(cost[ends])]]
    while path[-1] != start:
        path.append(previous[path[-1]])
    middle_row, middle_col = (axis[path].astype(np.float64) for axis in np.nonzero(road))
    row, col = _smooth(*_to_the_right(middle_row, middle_col, SIDE * clear[road][path]))
    return _inside(row, col, road.shape)


def _steps(road: Bools, clear: Floats, number: np.ndarray) -> sparse.coo_array:
    """Return the graph of the steps between neighbouring road cells (8 neighbours) with their costs."""
    a, b, cost = [], [], []
    height, width = road.shape
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
        there = slice(down, height), slice(max(0, right), width + min(0, right))
        both = road[here] & road[there]
        a.append(number[here][both])
        b.append(number[there][both])
        edge_distance = np.minimum(clear[here][both], clear[there][both])
        cost.append(np.hypot(down, right) * (1 + EDGE_COST / edge_distance**2))
    n = int(road.sum())
    return sparse.coo_array((np.concatenate(cost), (np.concatenate(a), np.concatenate(b))), shape=(n, n))


def _to_the_right(row: Floats, col: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Move a path to the right, at right angles to its direction, by a distance in cells."""
    if row.size < 2:
        return row, col
    # Smoothed, because the path from cell to cell has only eight directions.
    south, east = (
        np.gradient(ndimage.gaussian_filter1d(a, SMOOTHING_CELLS, mode="nearest")) for a in (row, col)
    )
    length = np.maximum(np.hypot(south, east), 1e-9)
    return row + distance * east / length, col - distance * south / length


def _inside(row: Floats, col: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Cut off the ends outside the tile, as on a road that leaves the tile at an angle."""
    last = shape[0] - 1, shape[1] - 1
    inside = np.flatnonzero((row >= 0) & (row <= last[0]) & (col >= 0) & (col <= last[1]))
    kept = slice(inside[0], inside[-1] + 1) if inside.size else slice(0)
    return row[kept].clip(0, last[0]), col[kept].clip(0, last[1])


def _smooth(row: Floats, col: Floats) -> tuple[Floats, Floats]:
    """Smooth the corners of a path and resample it at steps of `STEP_CELLS`."""
    row, col = (ndimage.gaussian_filter1d(axis, SMOOTHING_CELLS, mode="nearest") for axis in (row, col))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(row), np.diff(col)))])
    at = np.arange(0.0, along[-1], STEP_CELLS)
    return np.interp(at, along, row), np.interp(at, along, col)
