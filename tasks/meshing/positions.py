"""Positions of the lattices of meshes, and points without duplicates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Floats

DECIMALS = 6
"""Decimals (of a metre) to which lattice offsets are rounded, so that 3 * 0.1 m equals 1 * 0.3 m."""
SNAP_M = 1e-3
"""The last line of a lattice is moved onto the border if it is closer to it than this (m)."""


def axis(start: float, stop: float, step: float, to_end: bool) -> Floats:
    """Return ``start``, ``start + step``, ... up to ``stop``; ``to_end`` adds ``stop`` if it is missing."""
    count = int(np.floor((stop - start + SNAP_M) / step))
    positions = start + np.round(np.arange(1, count + 1) * step, DECIMALS)
    positions = np.concatenate([[start], positions])
    if stop - positions[-1] <= SNAP_M:
        positions[-1] = stop
    elif to_end:
        positions = np.append(positions, stop)
    return positions


def without_duplicates(points: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return points by northing, then easting, each place once, and the new numbers of the given ones."""
    order = _by_northing(points)
    ordered = points[order]
    first = np.ones(len(points), bool)
    first[1:] = (ordered[1:, :2] != ordered[:-1, :2]).any(axis=1)
    number = np.empty(len(points), np.intp)
    number[order] = np.cumsum(first) - 1
    return ordered[first], number


def _by_northing(points: Floats) -> NDArray[np.intp]:
    """Return the order of points by northing, then easting."""
    x, y = np.ascontiguousarray(points[:, :2].T)
    # A stable sort of one number is fast, as the points come in a few ordered parts. Rounding makes it wrong
    # where two points on nearly the same northing are nearly at the same place.
    order = np.argsort(y * 2.0 ** np.ceil(np.log2(np.abs(x).max() + 1.0) + 1.0) + x, kind="stable")
    x, y = x[order], y[order]
    ordered = (y[:-1] < y[1:]) | ((y[:-1] == y[1:]) & (x[:-1] <= x[1:]))
    return order if ordered.all() else np.lexsort((points[:, 0], points[:, 1]))
