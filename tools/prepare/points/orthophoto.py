"""Orthophoto from coloured points: the colour of the highest point per pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats, Orthophoto
from flexroad.tools.prepare.points.binning import Cells, bins
from flexroad.tools.prepare.types import Points

Codes = NDArray[np.int32]
"""Colours as 24-bit numbers (red, green, blue from the highest byte); -1 if there is none."""


def photo(points: Points, grid: Grid, fill_m: float) -> Orthophoto:
    """Return the colour of the highest point in each pixel; voids have that of the nearest valid pixel.

    Of points at the same height, the one with the greatest red, then green, then blue is used; of pixels at
    the same distance, the northernmost, then the westernmost.

    - `points`: must have colours, and include a rim of ``fill_m`` around the grid.
    - `fill_m`: pixels whose centre is farther than this from that of a valid pixel stay without colour (m).
    """
    assert points.colour is not None
    rim = grid.buffered(fill_m)
    red, green, blue = points.colour.T.astype(np.int32)
    top = _top_codes(
        bins(points.easting, points.northing, rim), points.height, red << 16 | green << 8 | blue, rim.shape
    )
    codes = _nearest(top, _offsets(fill_m / grid.cell))[rim.window(grid)]
    colour = np.stack([codes >> 16 & 255, codes >> 8 & 255, codes & 255]).astype(np.uint8)
    valid = codes >= 0
    return Orthophoto(grid, np.where(valid, colour, np.uint8(0)), valid)


@compiled()
def _top_codes(cells: Cells, height: Floats, codes: Codes, shape: tuple[int, int]) -> Codes:
    top = np.full(shape[0] * shape[1], -np.inf)
    best = np.full(top.size, -1, np.int32)
    for i in range(cells.size):
        c = cells[i]
        if c >= 0 and (height[i] > top[c] or (height[i] == top[c] and codes[i] > best[c])):
            top[c], best[c] = height[i], codes[i]
    return best.reshape(shape)


def _offsets(radius: float) -> NDArray[np.int64]:
    """Return the (row, col) offsets within ``radius`` pixels, the nearest first, ``(n, 2)``."""
    reach = int(radius + 1e-9)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    square = row**2 + col**2
    order = np.lexsort((col, row, square))
    return np.stack([row, col], axis=1)[order[: np.count_nonzero(square <= radius**2 + 1e-9)]]


@compiled()
def _nearest(codes: Codes, offsets: NDArray[np.int64]) -> Codes:
    rows, cols = codes.shape
    filled = codes.copy()
    for r in range(rows):
        for c in range(cols):
            for k in range(offsets.shape[0]):
                row, col = r + offsets[k, 0], c + offsets[k, 1]
                if 0 <= row < rows and 0 <= col < cols and codes[row, col] >= 0:
                    filled[r, c] = codes[row, col]
                    break
    return filled
