"""Whether a cell lies on the ground that is known around it: on its plane, or as far off the DTM as it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats

NO_NEIGHBOURS, INCONSISTENT, CONSISTENT = np.uint8(0), np.uint8(1), np.uint8(2)
"""Nothing known is near; the cell is off what is known; it lies on it."""
SURE = 0.5
"""A plane counts where the variance of its height is at most this part of a single cell's."""

Window = tuple[int, int, int, int]
"""First and last row, first and last column; the last ones not included."""


@compiled()
def against_known(
    dsm: Floats, dtm: Floats, known: Bools, asked: Bools, reach: int, theta: float
) -> NDArray[np.uint8]:
    """Return `NO_NEIGHBOURS`, `INCONSISTENT` or `CONSISTENT` for the asked cells, ``(H, W)``.

    What is known are the cells in the square of ``reach`` cells around. A cell lies on them if it is within
    ``theta`` (m) of the DTM plus their mean height above it, or of their least-squares plane, where that is
    sure.
    """
    rows, cols = dsm.shape
    found = np.zeros((rows, cols), np.uint8)
    for r in range(rows):
        for c in range(cols):
            if not asked[r, c]:
                continue
            window = max(r - reach, 0), min(r + reach + 1, rows), max(c - reach, 0), min(c + reach + 1, cols)
            n, over = _count_and_offset(dsm, dtm, known, window)
            # A DTM that is unknown gives NaN, which is within nothing.
            on = abs(dsm[r, c] - dtm[r, c] - over) <= theta
            if n > 0:
                on = on or abs(_above_plane(dsm, known, window, n, r, c)) <= theta
                found[r, c] = CONSISTENT if on else INCONSISTENT
    return found


@compiled()
def _count_and_offset(dsm: Floats, dtm: Floats, known: Bools, window: Window) -> tuple[int, float]:
    """Return how many cells are known and their mean height over the DTM (m), NaN without one."""
    top, bottom, left, right = window
    n, m, over = 0, 0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if known[i, j]:
                n += 1
                if not np.isnan(dtm[i, j]):
                    m, over = m + 1, over + dsm[i, j] - dtm[i, j]
    return n, over / m if m > 0 else np.nan


@compiled()
def _above_plane(dsm: Floats, known: Bools, window: Window, n: int, r: int, c: int) -> float:
    """Return a cell's height over the plane of the known ones (m), NaN where that is not sure."""
    top, bottom, left, right = window
    y, x, z = 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if known[i, j]:
                y, x, z = y + (i - r), x + (j - c), z + dsm[i, j] - dsm[r, c]
    y, x, z = y / n, x / n, z / n
    yy, yx, xx, yz, xz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if known[i, j]:
                a, b, up = i - r - y, j - c - x, dsm[i, j] - dsm[r, c] - z
                yy, yx, xx, yz, xz = yy + a * a, yx + a * b, xx + b * b, yz + a * up, xz + b * up
    det = yy * xx - yx * yx
    if det <= 1e-9 * (yy + xx) ** 2:
        return np.nan
    variance = 1 / n + (xx * y * y - 2 * yx * y * x + yy * x * x) / det
    if variance > SURE:
        return np.nan
    return -(z - (y * (xx * yz - yx * xz) + x * (yy * xz - yx * yz)) / det)
