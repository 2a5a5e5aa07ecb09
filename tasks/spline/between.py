"""Values between known ones: Laplace's equation on some cells of a grid."""

from __future__ import annotations

import numpy as np
import scipy

from flexroad.tasks.types import Bools, Floats

HELD = 1e-9
"""Weight of 0 in each cell without a value: parts that no known value touches become 0."""


def between(values: Floats, cells: Bools) -> Floats:
    """Return values with those that are NaN filled: each is the mean of its neighbours among the cells.

    Parameters
    ----------
    values : ndarray, (H, W)
        NaN only in the given cells.
    cells : ndarray of bool, (H, W)
        The other cells count as insulated: their values have no effect.
    """
    unknown = cells & np.isnan(values)
    if not unknown.any():
        return values
    # With a rim of other cells, every cell has four neighbours.
    given, cells, unknown = np.pad(values, 1), np.pad(cells, 1), np.pad(unknown, 1)
    row, col = np.nonzero(unknown)
    number = np.full(given.shape, -1)
    number[row, col] = own = np.arange(row.size)
    degree, right, joints = np.full(row.size, HELD), np.zeros(row.size), []
    for down, east in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        place = row + down, col + east
        known = cells[place] & ~unknown[place]
        joined = np.flatnonzero(unknown[place])
        degree[known] += 1
        degree[joined] += 1
        right[known] += given[place][known]
        joints.append((joined, number[place][joined], np.full(joined.size, -1.0)))
    rows, cols, weights = (np.concatenate(part) for part in zip((own, own, degree), *joints, strict=True))
    matrix = scipy.sparse.csc_matrix((weights, (rows, cols)), 2 * (row.size,))
    given[row, col] = scipy.sparse.linalg.spsolve(matrix, right)
    return given[1:-1, 1:-1]
