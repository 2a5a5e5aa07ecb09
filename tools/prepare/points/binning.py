"""Points, their cells, and values of a cell from its points: means, highest point, top layer, colour.

The highest of many points with noise is above the surface; more points make this error larger. The mean of
the top layer (the points close below the highest point) has no such error. It still belongs to the uppermost
surface: a deck, not the ground under it. A single point far above all points around it is a spike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from flexroad.catalog.grid import Grid
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats, Orthophoto

Cells = NDArray[np.int64]
"""Row-major index of the cell of each point, ``(n,)``; -1 outside the grid."""

NUDGE = 1e-6
"""Share of a cell that is larger than the rounding error of its edge's coordinates."""
AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)
"""The 8 neighbours of a cell."""
Codes = NDArray[np.int32]
"""Colours as 24-bit numbers (red, green, blue from the highest byte); -1 without a colour."""


@dataclass(frozen=True, eq=False)
class Points:
    """A point cloud in the metric CRS of the rasters."""

    easting: Floats
    """``(n,)``, m."""
    northing: Floats
    """``(n,)``, m."""
    height: Floats
    """``(n,)``, m."""
    kind: NDArray[np.uint8]
    """Class by ASPRS, ``(n,)``: 2 is ground, 17 a bridge deck, 0 and 1 are unclassified."""
    colour: NDArray[np.uint8] | None = None
    """Red, green, blue, ``(n, 3)``, or None if the source has no colours."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.height)

    def __getitem__(self, key: slice | Bools | NDArray[np.intp]) -> Points:
        """Return a subset of the points, by a slice, a mask or indices."""
        colour = None if self.colour is None else self.colour[key]
        return Points(self.easting[key], self.northing[key], self.height[key], self.kind[key], colour)


def bins(easting: Floats, northing: Floats, grid: Grid) -> Cells:
    """Return the row-major index of the cell of each point, ``(n,)``; -1 outside the grid.

    A point on the border of two cells belongs to the eastern or southern one. Rounding does not change that,
    so all grids of the same lattice give the same result.
    """
    cells: Cells = _bins(
        np.asarray(easting), np.asarray(northing), grid.west, grid.north, grid.cell, grid.height, grid.width
    )
    return cells


@compiled()
def _bins(
    easting: Floats, northing: Floats, west: float, north: float, cell: float, rows: int, cols: int
) -> Cells:
    cells = np.full(easting.size, -1, np.int64)
    for i in range(easting.size):
        col = math.floor((easting[i] - west) / cell + NUDGE)
        row = math.floor((north - northing[i]) / cell + NUDGE)
        if 0 <= row < rows and 0 <= col < cols:
            cells[i] = row * cols + col
    return cells


def means(cells: Cells, shape: tuple[int, int], *values: Floats) -> tuple[Floats, ...]:
    """Return the mean of each array of values per cell, each ``(H, W)``; NaN in cells without points.

    Values are summed in the order of the points: another order changes only the last digits.

    - `cells`: the cells of the points, ``(n,)``; points outside the grid are left out.
    """
    # The first number is for the points outside.
    numbers, size = cells + 1, shape[0] * shape[1] + 1
    count = np.bincount(numbers, minlength=size)
    with np.errstate(invalid="ignore"):
        found = (np.bincount(numbers, value, size) / count for value in values)
        return tuple(mean[1:].reshape(shape) for mean in found)


def highest(cells: Cells, height: Floats, shape: tuple[int, int]) -> Floats:
    """Return the height of the highest point per cell, ``(H, W)``; NaN in cells without points."""
    top, _, _ = _two_highest(cells, height, shape[0] * shape[1])
    return np.where(np.isneginf(top), np.nan, top).reshape(shape)


def spikes(cells: Cells, height: Floats, shape: tuple[int, int], despike_m: float) -> NDArray[np.int64]:
    """Return the indices of single points far above all points around them, ``(k,)``.

    The highest point of a cell is a spike if it is more than ``despike_m`` above two heights: the second
    highest point of its cell, and the highest points of all 8 neighbours. A pole or a crown with two points
    is not a spike. A point without any points around it is not a spike. A cell has at most one spike.
    """
    top, second, index = _two_highest(cells, height, shape[0] * shape[1])
    around = ndimage.maximum_filter(top.reshape(shape), footprint=AROUND, mode="constant", cval=-np.inf)
    rest = np.maximum(second, around.ravel())
    single: NDArray[np.int64] = index[np.isfinite(rest) & (top > rest + despike_m)]
    return single


@compiled()
def _two_highest(cells: Cells, height: Floats, size: int) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return the two largest heights per cell (-inf if missing) and the index of the largest."""
    top, second = np.full(size, -np.inf), np.full(size, -np.inf)
    index = np.full(size, -1, np.int64)
    for i in range(cells.size):
        c = cells[i]
        if c < 0:
            continue
        if height[i] > top[c]:
            second[c], top[c], index[c] = top[c], height[i], i
        elif height[i] > second[c]:
            second[c] = height[i]
    return top, second, index


def top_layer(
    cells: Cells, height: Floats, highest: Floats, depth_m: float, shape: tuple[int, int]
) -> Floats:
    """Return the top layer of each cell: mean height (m), number and spread of its points, ``(3, H, W)``.

    The spread is the standard deviation of the heights (m): 0 for one point. Spread and mean are NaN in cells
    without points.

    - `highest`: highest point per cell, ``(H, W)``, m; NaN without points.
    - `depth_m`: points up to this much below the highest point belong to the top layer (m).
    """
    count, below, squared = _sums(cells, height, highest.ravel(), depth_m)
    with np.errstate(invalid="ignore"):
        mean, square = below / count, squared / count
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    return np.stack([highest + mean.reshape(shape), count.reshape(shape), spread.reshape(shape)])


@compiled()
def _sums(cells: Cells, height: Floats, highest: Floats, depth_m: float) -> tuple[Floats, Floats, Floats]:
    """Return number, sum and sum of squares of the heights relative to the highest point, per cell."""
    count, below, squared = np.zeros_like(highest), np.zeros_like(highest), np.zeros_like(highest)
    for i in range(cells.size):
        c = cells[i]
        if c < 0:
            continue
        z = height[i] - highest[c]
        if z >= -depth_m:
            count[c] += 1.0
            below[c] += z
            squared[c] += z * z
    return count, below, squared


def photo(points: Points, grid: Grid, fill_m: float) -> Orthophoto:
    """Return the colour of the highest point in each pixel; voids have the nearest valid pixel's colour.

    Among points at the same height, the largest red, then green, then blue is used. Among pixels at the same
    distance, the northernmost, then the westernmost is used.

    - `points`: must have colours, and include a rim of ``fill_m`` around the grid.
    - `fill_m`: pixels whose centre is farther than this from all valid centres stay without colour (m).
    """
    assert points.colour is not None
    rim = grid.buffered(fill_m)
    red, green, blue = points.colour.T.astype(np.int32)
    top = _top_codes(
        bins(points.easting, points.northing, rim), points.height, red << 16 | green << 8 | blue, rim.shape
    )
    # Offsets to the pixels within the distance, the nearest first.
    radius = fill_m / grid.cell
    reach = int(radius + 1e-9)
    row, col = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    square = row**2 + col**2
    order = np.lexsort((col, row, square))[: np.count_nonzero(square <= radius**2 + 1e-9)]
    codes = _nearest(top, np.stack([row, col], axis=1)[order])[rim.window(grid)]
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
