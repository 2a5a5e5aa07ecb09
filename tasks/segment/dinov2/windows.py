"""Overlapping windows over a picture, and one result out of theirs, without seams.

Windows lie on a lattice that is fixed to the ground, not to the tile: neighbouring tiles see the same windows
along their common edge, and a result does not depend on how land is cut. Each window's weight falls to its
sides as a raised cosine over the overlap, so that the weights of all windows at a pixel sum to one.
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
"""Windows ``(n, bands, size, size)`` -> a value per pixel ``(n, size, size)``."""
Corner = tuple[int, int]
"""Row and column of a window's north-west pixel."""


def cover(grid: Grid, gsd_m: float, size: int, overlap: int = 0) -> Grid:
    """Return the pixels of all windows that reach a grid: as long and as wide as whole windows.

    Parameters
    ----------
    grid : Grid
        The ground that is wanted; the windows reach beyond it by up to ``size`` pixels.
    gsd_m : float
        Size of the windows' pixels (m).
    size, overlap : int
        Side of a window, and what it shares with the next, in pixels.
    """
    step, side = (size - overlap) * gsd_m, size * gsd_m
    first, last = math.floor((grid.west - side) / step) + 1, math.ceil(grid.east / step) - 1
    low, high = math.floor(grid.south / step) + 1, math.ceil((grid.north + side) / step) - 1
    width, height = ((n * (size - overlap) + size) for n in (last - first, high - low))
    return Grid(grid.crs, first * step, high * step, gsd_m, width, height)


def corners(shape: tuple[int, int], size: int, overlap: int = 0) -> Iterator[Corner]:
    """Yield where the windows of a picture of whole windows lie, row by row."""
    for row in range(0, shape[0] - size + 1, size - overlap):
        for col in range(0, shape[1] - size + 1, size - overlap):
            yield row, col


def taper(size: int, overlap: int) -> NDArray[np.float32]:
    """Return a window's weights along one side, ``(size,)``: a raised cosine over the overlap, else 1.

    What two windows weigh in their overlap sums to 1 (``sin^2 + cos^2``); it is at most half of ``size``.
    """
    weights = np.ones(size)
    rise = np.sin(np.pi / 2 * (np.arange(overlap) + 0.5) / max(overlap, 1)) ** 2
    weights[:overlap] = rise
    weights[size - overlap :] = rise[::-1]
    return weights.astype(np.float32)


def blend(
    predict: Predict, image: Image, known: Bools, size: int, overlap: int, batch: int = 1
) -> NDArray[np.float32]:
    """Return the weighted mean of what the windows say, ``(h, w)``.

    Parameters
    ----------
    predict : callable
        What is to be known of each pixel, by windows; it is given ``batch`` of them, the last time fewer.
    image : (bands, h, w) array
        Of whole windows, as by `cover`.
    known : (h, w) array
        Windows without any known pixel are left out and count as 0.
    size, overlap : int
        As in `cover`, in pixels.
    batch : int
        Windows at a time.

    Notes
    -----
    Over the image's outer overlap windows of the neighbourhood are missing and the weights sum to less than
    1; the grid that was given to `cover` lies within.
    """
    side = taper(size, overlap)
    weights = side[:, None] * side
    result = np.zeros(image.shape[1:], np.float32)
    seen = [
        (slice(row, row + size), slice(col, col + size))
        for row, col in corners(known.shape, size, overlap)
        if known[row : row + size, col : col + size].any()
    ]
    for start in range(0, len(seen), batch):
        part = seen[start : start + batch]
        for where, value in zip(part, predict(np.stack([image[:, *w] for w in part])), strict=True):
            result[where] += weights * value
    return result
