"""Test whether cells lie on the ground cells around them: on their plane, or at their offset from the DTM."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats

NO_NEIGHBOURS, INCONSISTENT, CONSISTENT = np.uint8(0), np.uint8(1), np.uint8(2)
"""Results per cell: no ground cell is near; the cell is off the ground; the cell lies on the ground."""
MAX_PLANE_VARIANCE = 0.5
"""A plane is used only where the variance of its height is at most this share of a single cell's."""

Window = tuple[int, int, int, int]
"""First and last row, first and last column; the last ones are exclusive."""


@compiled()
def ground_consistency(
    dsm: Floats, dtm: Floats, ground: Bools, candidates: Bools, reach: int, theta: float
) -> NDArray[np.uint8]:
    """Return `NO_NEIGHBOURS`, `INCONSISTENT` or `CONSISTENT` for each candidate cell, ``(H, W)``.

    A cell is compared with the ground cells at most ``reach`` rows and columns away. It is consistent if its
    height is within ``theta`` (m) of the DTM plus their mean height above the DTM, or of their least-squares
    plane where that is determined well enough (`MAX_PLANE_VARIANCE`). Other cells are `NO_NEIGHBOURS`.
    """
    rows, cols = dsm.shape
    result = np.zeros((rows, cols), np.uint8)
    for r in range(rows):
        for c in range(cols):
            if not candidates[r, c]:
                continue
            window = max(r - reach, 0), min(r + reach + 1, rows), max(c - reach, 0), min(c + reach + 1, cols)
            n, offset = _count_and_offset(dsm, dtm, ground, window)
            # NaN where the DTM is unknown: the comparison is then False.
            consistent = abs(dsm[r, c] - dtm[r, c] - offset) <= theta
            if n > 0:
                consistent = consistent or abs(_above_plane(dsm, ground, window, n, r, c)) <= theta
                result[r, c] = CONSISTENT if consistent else INCONSISTENT
    return result


@compiled()
def _count_and_offset(dsm: Floats, dtm: Floats, ground: Bools, window: Window) -> tuple[int, float]:
    """Return the number of ground cells and their mean height above the DTM (m), NaN if that is unknown."""
    top, bottom, left, right = window
    n, m, offset = 0, 0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if ground[i, j]:
                n += 1
                if not np.isnan(dtm[i, j]):
                    m, offset = m + 1, offset + dsm[i, j] - dtm[i, j]
    return n, offset / m if m > 0 else np.nan


@compiled()
def _above_plane(dsm: Floats, ground: Bools, window: Window, n: int, r: int, c: int) -> float:
    """Return a cell's height above the plane of the ground cells (m), NaN if the plane is too uncertain."""
    top, bottom, left, right = window
    y, x, z = 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if ground[i, j]:
                y, x, z = y + (i - r), x + (j - c), z + dsm[i, j] - dsm[r, c]
    y, x, z = y / n, x / n, z / n
    yy, yx, xx, yz, xz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(top, bottom):
        for j in range(left, right):
            if ground[i, j]:
                a, b, up = i - r - y, j - c - x, dsm[i, j] - dsm[r, c] - z
                yy, yx, xx, yz, xz = yy + a * a, yx + a * b, xx + b * b, yz + a * up, xz + b * up
    det = yy * xx - yx * yx
    if det <= 1e-9 * (yy + xx) ** 2:
        return np.nan
    variance = 1 / n + (xx * y * y - 2 * yx * y * x + yy * x * x) / det
    if variance > MAX_PLANE_VARIANCE:
        return np.nan
    return -(z - (y * (xx * yz - yx * xz) + x * (yy * xz - yx * yz)) / det)
