"""The squares of a lattice whose triangles need no search: Delaunay's, because no point lies in their circle.

The four corners of a square lie on one circle. If no other point lies in it, both diagonals give two faces of
a Delaunay triangulation; if one corner has no point, the other three are a face. Where such faces are side by
side, only the points on the outer edge of their area are needed to triangulate the rest: these edges are part
of every Delaunay triangulation of the points outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.types import Bools, Floats

ON_LATTICE = 1e-5
"""Points closer than this to a node are on it (share of the step), for offsets are rounded to 1e-6 m."""
WITHOUT = ((1, 3, 2), (0, 3, 2), (0, 1, 3), (0, 1, 2))
"""The corners of a square without one of them, counter-clockwise; in the order of `_corners`."""


@dataclass(frozen=True, eq=False)
class Squares:
    """The squares of a lattice with points at four or three of their corners, and no other point nearby."""

    corner: tuple[float, float]
    """X and y of the south-western node (m)."""
    step: float
    """Side of a square (m)."""
    numbers: NDArray[np.int32]
    """Number of the point at each node, -1 where none is, ``(n + 1, m + 1)``, row 0 in the south."""
    clear: Bools
    """The squares whose circle has no point but at their corners, ``(n, m)``."""

    @cached_property
    def full(self) -> Bools:
        """The squares with four points, ``(n, m)``."""
        return np.asarray(self.clear & (self._count == 4))

    @cached_property
    def halves(self) -> list[Bools]:
        """The squares that lack the point at one corner, ``(n, m)`` for each corner."""
        three = self.clear & (self._count == 3)
        return [three & (part < 0) for part in _corners(self.numbers)]

    @cached_property
    def _count(self) -> NDArray[np.int8]:
        """Number of points at the corners of each square."""
        occupied = (self.numbers >= 0).astype(np.int8)
        return np.asarray(sum(_corners(occupied)))

    @property
    def faces(self) -> NDArray[np.int32]:
        """Two faces per full square, cut from north-west to south-east, and halves, ``(F, 3)``.

        They are counter-clockwise.
        """
        corners = _corners(self.numbers)
        parts = [(self.full, WITHOUT[3]), (self.full, WITHOUT[0]), *zip(self.halves, WITHOUT, strict=True)]
        return np.concatenate(
            [np.stack([corners[k][where] for k in chosen], axis=-1) for where, chosen in parts]
        )

    @property
    def inner(self) -> NDArray[np.int32]:
        """Numbers of the points with faces of the squares all around; no other face needs them."""
        # A half square fills the angle at the corner opposite to the one that lacks a point.
        filled = (_corners(self.full | half)[k] for k, half in enumerate(self.halves))
        return self.numbers[1:-1, 1:-1][np.logical_and.reduce(list(filled))]

    def contains(self, places: Floats) -> Bools:
        """Return which places, ``(n, 2)``, lie in one of the faces and not on its edge, ``(n,)``."""
        place = (places - self.corner) / self.step
        column, row = np.floor(place).astype(np.intp).T
        x, y = (place - np.floor(place)).T
        rows, columns = self.full.shape
        at = np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)
        beyond = (x + y > 1, y > x, x > y, x + y < 1)
        result = self.full[at]
        for half, in_face in zip(self.halves, beyond, strict=True):
            result |= half[at] & in_face
        return np.asarray(result & (row == at[0]) & (column == at[1]))


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
    clear = np.ones((numbers.shape[0] - 1, numbers.shape[1] - 1), np.bool_)
    # The circle of a square lies within it and the eight squares around it.
    column, row = np.floor(place[off_node]).astype(np.intp).T
    for down in (-1, 0, 1):
        for left in (-1, 0, 1):
            rows, columns = row + down, column + left
            valid = (rows >= 0) & (rows < clear.shape[0]) & (columns >= 0) & (columns < clear.shape[1])
            clear[rows[valid], columns[valid]] = False
    return Squares(corner, step, numbers, clear)


def _corners(nodes: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Return the south-western, south-eastern, north-western and north-eastern nodes of all squares."""
    return nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]
