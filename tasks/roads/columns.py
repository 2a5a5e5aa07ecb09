"""The cells of a mask, row by row, for loops over the few that lie in a part of a row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools


@compiled()
def columns_of(mask: Bools) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Return the columns of the cells of a mask, row by row, and where those of each cell begin.

    The columns of row ``r`` from ``c`` up to ``d`` are ``columns[before[r * W + c] : before[r * W + d]]``.

    Parameters
    ----------
    mask : (H, W) array of bool

    Returns
    -------
    columns : (n,) array of int
        Ascending within a row.
    before : (H * W + 1,) array of int
        Number of cells of the mask before each cell.
    """
    before = np.zeros(mask.size + 1, np.int32)
    before[1:] = np.cumsum(mask)
    return np.flatnonzero(mask) % mask.shape[1], before
