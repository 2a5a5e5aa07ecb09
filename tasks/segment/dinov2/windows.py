"""Overlapping windows over an image, and the blending of their results without seams.

Windows lie on a lattice fixed to the ground, not to the tile: neighbouring tiles use the same windows along
their common edge, and results do not depend on the tiling. The weight of a window falls towards its sides
as a raised cosine over the overlap. So the weights of all windows at a pixel sum to one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools

Image = NDArray[np.float32]
"""``(bands, h, w)``."""
Predict = Callable[[Image], NDArray[np.float32]]
"""Windows ``(n, bands, size, size)`` -> one value per pixel, ``(n, size, size)``."""
Corner = tuple[int, int]
"""Row and column of a window's north-west pixel."""


def cover(grid: Grid, gsd_m: float, size: int, overlap: int = 0) -> Grid:
    """Return the pixel grid of all windows that overlap a grid; it consists of complete windows.

    - `grid`: the area to cover; the windows extend beyond it by up to ``size`` pixels.
    - `gsd_m`: size of the windows' pixels (m).
    - `size`, `overlap`: side of a window, and its overlap with the next window (pixels).
    """
    step, side = (size - overlap) * gsd_m, size * gsd_m
    first, last = math.floor((grid.west - side) / step) + 1, math.ceil(grid.east / step) - 1
    low, high = math.floor(grid.south / step) + 1, math.ceil((grid.north + side) / step) - 1
    width, height = ((n * (size - overlap) + size) for n in (last - first, high - low))
    return Grid(grid.crs, first * step, high * step, gsd_m, width, height)


def corners(shape: tuple[int, int], size: int, overlap: int = 0) -> Iterator[Corner]:
    """Yield the corners of the windows of an image that consists of complete windows, row by row."""
    for row in range(0, shape[0] - size + 1, size - overlap):
        for col in range(0, shape[1] - size + 1, size - overlap):
            yield row, col


def taper(size: int, overlap: int) -> NDArray[np.float32]:
    """Return a window's weights along one side, ``(size,)``: a raised cosine over the overlap, else 1.

    The weights of two windows in their overlap sum to 1 (``sin^2 + cos^2``). ``overlap`` is at most half of
    ``size``.
    """
    weights = np.ones(size)
    rise = np.sin(np.pi / 2 * (np.arange(overlap) + 0.5) / max(overlap, 1)) ** 2
    weights[:overlap] = rise
    weights[size - overlap :] = rise[::-1]
    return weights.astype(np.float32)


def blend(
    predict: Predict, image: Image, valid: Bools, size: int, overlap: int, batch: int = 1
) -> NDArray[np.float32]:
    """Return the weighted mean of the windows' predictions, ``(h, w)``.

    - `predict`: called with ``batch`` windows at a time, the last time with fewer.
    - `image`: consists of complete windows, see `cover`.
    - `valid`: pixels with data; windows without data are skipped and have the value 0.
    - `size`, `overlap`: as in `cover` (pixels).
    - `batch`: windows per call of ``predict``.

    Notes
    -----
    Along the image's border neighbouring windows are missing, so weights sum to less than 1 there. The grid
    given to `cover` lies inside that border.
    """
    side = taper(size, overlap)
    weights = side[:, None] * side
    result = np.zeros(image.shape[1:], np.float32)
    used = [
        (slice(row, row + size), slice(col, col + size))
        for row, col in corners(valid.shape, size, overlap)
        if valid[row : row + size, col : col + size].any()
    ]
    for start in range(0, len(used), batch):
        part = used[start : start + batch]
        for window, value in zip(part, predict(np.stack([image[:, *w] for w in part])), strict=True):
            result[window] += weights * value
    return result
