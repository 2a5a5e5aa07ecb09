"""The squares of a lattice whose triangles need no search: Delaunay's, because no point lies in their circle.

The four corners of a square lie on one circle. If no other point lies in it, both diagonals give two faces of
a Delaunay triangulation. Where squares are side by side, only the points on the outer edge of their area are
needed to triangulate the rest: these edges are part of every Delaunay triangulation of the points outside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Bools, Floats

ON_LATTICE = 1e-5
"""Points closer than this to a node are on it (share of the step), for offsets are rounded to 1e-6 m."""


@dataclass(frozen=True, eq=False)
class Squares:
    """Squares of a lattice with a point at each corner and no other point in their circle."""

    corner: tuple[float, float]
    """X and y of the south-western node (m)."""
    step: float
    """Side of a square (m)."""
    complete: Bools
    """The squares that are these, ``(n, m)``, row 0 in the south."""
    numbers: NDArray[np.int32]
    """Number of the point at each node, -1 where none is, ``(n + 1, m + 1)``."""

    @property
    def faces(self) -> NDArray[np.int32]:
        """Two faces per square, cut from north-west to south-east, counter-clockwise, ``(F, 3)``."""
        sw, se, nw, ne = (part[self.complete] for part in _corners(self.numbers))
        return np.stack([sw, se, nw, se, ne, nw], axis=-1).reshape(-1, 3)

    @property
    def inner(self) -> NDArray[np.int32]:
        """Numbers of the points between four of the squares; no other face needs them."""
        between = np.logical_and.reduce(_corners(self.complete))
        return self.numbers[1:-1, 1:-1][between]

    def contains(self, places: Floats) -> Bools:
        """Return which places, ``(n, 2)``, lie in one of the squares, ``(n,)``."""
        column, row = np.floor((places - self.corner) / self.step).astype(np.intp).T
        rows, columns = self.complete.shape
        valid = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.asarray(valid & self.complete[np.where(valid, row, 0), np.where(valid, column, 0)])


def squares(points: Floats, corner: tuple[float, float], step: float) -> Squares:
    """Return the squares of a lattice that points fill alone.

    Parameters
    ----------
    points : ndarray, (n, 2 or more)
        No two at the same place in plan, none west or south of the corner.
    corner : tuple of float
        X and y of the south-western node (m).
    step : float
        Distance of the nodes (m).
    """
    place = (points[:, :2] - corner) / step
    nearest = np.rint(place)
    column, row = nearest.astype(np.intp).T
    on_node = np.flatnonzero((np.abs(place - nearest) < ON_LATTICE).all(axis=1))
    numbers = np.full((row.max() + 2, column.max() + 2), -1, np.int32)
    numbers[row[on_node], column[on_node]] = on_node
    # A second point at a node is not in `numbers`, and so is off the lattice, too.
    off_node = numbers[row, column] != np.arange(len(points))
    complete = np.logical_and.reduce([part >= 0 for part in _corners(numbers)])
    # The circle of a square lies within it and the eight squares around it.
    column, row = np.floor(place[off_node]).astype(np.intp).T
    for down in (-1, 0, 1):
        for left in (-1, 0, 1):
            rows, columns = row + down, column + left
            valid = (rows >= 0) & (rows < complete.shape[0]) & (columns >= 0) & (columns < complete.shape[1])
            complete[rows[valid], columns[valid]] = False
    return Squares(corner, step, complete, numbers)


def _corners(nodes: NDArray) -> tuple[NDArray, ...]:  # type: ignore[type-arg]
    """Return the south-western, south-eastern, north-western and north-eastern nodes of all squares."""
    return nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
