"""Estimate the horizontal shift of an orthophoto against the heights.

Matching edges is not enough: in a photo a tree is a dark patch with its shadow on one side, so it appears
shifted away from the sun. Instead, the photo's brightness and greenness are explained by least squares. The
explaining layers are computed from the DSM: height above ground, roughness (leaves), illumination by the sun,
and cast shadow. This is done for sun positions all around the sky and for shifts up to `REACH_M`. The result
is the sun and the shift that explain the largest share of the variance, to about half a cell. Only detail
finer than `DETAIL_M` is used.

Tiles of one flight have the same sun and usually the same shift, so several tiles give a better estimate. The
result is a mean: in photos that are not true orthophotos, roofs and crowns lean outwards, cars have moved,
and trees have grown. A flat field gives no information. `Shift.confidence` measures how clear the best shift
is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.types import Bools, Floats, Orthophoto, TileData

rasterio = lazy("rasterio")

Singles = NDArray[np.float32]
Sun = tuple[float, float]
"""Azimuth clockwise from north, and height above the horizon (degrees)."""

REACH_M = 5.0
"""Largest shift searched, east and north (m)."""
FINEST_M, MAX_CELLS = 1.0, 320
"""Smallest working cell (m), and largest width and height of the working grid: only the middle of a larger
tile is used."""
STRIDE = 3
"""Every third cell is compared: neighbouring cells are correlated."""
DETAIL_M = 4.0
"""Standard deviation of the Gaussian whose smooth part is subtracted (m)."""
APART_M = 2.0
"""Smallest distance of a second peak from the best peak (m)."""
CLEAR = 0.3
"""Smallest confidence of an accepted shift. Photos of other places reach 0.25 over five synthetic tiles; a
tile's own photo has 0.28 to 0.6."""
SMALLEST_M = 1.0
"""Shifts smaller than this (m), or than half a cell of the heights, give no warning."""

AROUND = tuple((float(azimuth), float(rise)) for azimuth in range(0, 360, 30) for rise in (25, 40, 55))
"""Sun positions tried first, 30 degrees apart in azimuth and 15 in height."""
CLOSER = (1 / 2, 1 / 4, 1 / 8)
"""Factors of `STEP_DEG` in the following refinements around the best sun so far."""
STEP_DEG = (30.0, 15.0)
"""Step between the first sun positions in azimuth and height (degrees)."""


@dataclass(frozen=True)
class Shift:
    """Offset of the photo from the heights."""

    east_m: float
    north_m: float
    confidence: float
    """1 minus b / a, 0 to 1: a is the variance explained by the best shift, b by the best shift at least
    `APART_M` away."""
    sun: Sun

    @property
    def length_m(self) -> float:
        """Length of the shift (m)."""
        return math.hypot(self.east_m, self.north_m)

    def __str__(self) -> str:
        east = f"{abs(self.east_m):.1f} m {'east' if self.east_m >= 0 else 'west'}"
        north = f"{abs(self.north_m):.1f} m {'north' if self.north_m >= 0 else 'south'}"
        return f"{east} and {north}"


@dataclass(frozen=True, eq=False)
class Pair:
    """Heights and photo of a tile on one lattice, prepared for comparison."""

    cell: float
    """Cell size (m)."""
    height: Floats
    """DSM, ``(H, W)``, m; voids are filled."""
    valid: Bools
    """Cells with a DSM height, ``(H, W)``."""
    always: Singles
    """Layers that do not depend on the sun at the compared cells, ``(2, n)``: height above ground, and
    roughness of high cells."""
    photo: Singles
    """Brightness and greenness at the compared cells for every shift, ``(2, shifts, n)``; 0 where unknown."""


def note(data: TileData, photo: Orthophoto) -> str | None:
    """Return a warning if a photo is clearly shifted against the heights of its tile, else None."""
    if not large_enough(data.grid):
        return None
    result = shift([pair(data, photo)])
    if result.confidence < CLEAR or not matters(result, data.grid.cell):
        return None
    return f"dop: seems to lie {result} of the heights; `flexroad catalog check` tests more tiles"


def large_enough(grid: Grid) -> bool:
    """Return whether a tile is large enough to estimate shifts up to `REACH_M`."""
    return min(grid.width, grid.height) * grid.cell >= 8 * REACH_M


def matters(result: Shift, cell: float, scatter_m: float = 0.0) -> bool:
    """Return whether a shift exceeds its scatter by `SMALLEST_M` and by half a cell of the heights."""
    return result.length_m > max(SMALLEST_M, cell / 2) + scatter_m


def pair(data: TileData, photo: Orthophoto) -> Pair:
    """Return a tile's heights and photo prepared for comparison; the photo must cover the tile's grid."""
    grid = _working(data.grid)
    height, ground = (_onto(values, data.grid, grid) for values in (data.dsm, data.dtm))
    valid = np.isfinite(height)
    height = np.where(valid, height, ground)
    height = np.where(np.isfinite(height), height, np.nanmin(height, initial=9e9))
    above = np.nan_to_num(height - ground)
    rough = scipy.ndimage.uniform_filter(np.abs(height - scipy.ndimage.median_filter(height, 5)), 5)
    high = np.clip((above - 0.5) / 2, 0, 1)
    n = _reach(grid.cell)
    always = [_expected(values, valid, grid.cell) for values in (high, high * np.clip(2 * rough, 0, 1))]
    targets = [_shifted(_detail(values, grid.cell), n) for values in _targets(photo, grid)]
    return Pair(grid.cell, height, valid, np.stack(always), np.stack(targets))


def shift(pairs: Sequence[Pair], sun: Sun | None = None) -> Shift:
    """Return the common shift and sun that explain the photos of all pairs best.

    - `pairs`: tiles of one flight, at least one, with the same cell.
    - `sun`: position of the sun; searched if None.
    """
    cell, n = pairs[0].cell, _reach(pairs[0].cell)
    refinements = CLOSER if sun is None else ()
    sun, explained = _best(pairs, AROUND if sun is None else [sun])
    for factor in refinements:
        steps = [
            (east * factor * STEP_DEG[0], up * factor * STEP_DEG[1])
            for east in (-1, 0, 1)
            for up in (-1, 0, 1)
        ]
        sun, explained = _best(pairs, [(sun[0] + azimuth, sun[1] + rise) for azimuth, rise in steps])
    row, col = np.unravel_index(np.argmax(explained), explained.shape)
    rows, cols = np.ogrid[: 2 * n + 1, : 2 * n + 1]
    elsewhere = np.hypot(rows - row, cols - col) * cell >= APART_M
    peak = float(explained[row, col])
    east = (col - n + _vertex(explained[row], int(col))) * cell
    south = (row - n + _vertex(explained[:, col], int(row))) * cell
    confidence = 1 - float(explained[elsewhere].max()) / peak if peak > 0 else 0.0
    return Shift(float(east), float(-south), confidence, (sun[0] % 360, sun[1]))


def _best(pairs: Sequence[Pair], suns: Sequence[Sun]) -> tuple[Sun, Floats]:
    """Return the best sun, and the variance that it explains for each shift, rows from the north."""
    n = _reach(pairs[0].cell)
    explained = np.sum([_explained(pair, suns) for pair in pairs], axis=0)
    best = int(np.argmax(explained.max(axis=1)))
    return suns[best], explained[best].reshape(2 * n + 1, 2 * n + 1)


def _explained(pair: Pair, suns: Sequence[Sun]) -> Floats:
    """Return the explained shares of the variances of brightness and greenness, ``(suns, shifts)``."""
    light = [_expected(v, pair.valid, pair.cell) for sun in suns for v in _light(pair.height, pair.cell, sun)]
    expected = np.stack([*pair.always, *light])
    gram = (expected @ expected.T).astype(np.float64)
    products = [(target @ expected.T).astype(np.float64) for target in pair.photo]
    variances = [np.maximum(np.einsum("sn,sn->s", target, target), 1e-9) for target in pair.photo]
    explained = np.zeros((len(suns), pair.photo.shape[1]))
    for i in range(len(suns)):
        layers = [0, 1, 2 + 2 * i, 3 + 2 * i]
        inverse = np.linalg.inv(gram[np.ix_(layers, layers)] + 1e-6 * np.eye(4))
        for product, variance in zip(products, variances, strict=True):
            part = product[:, layers]
            explained[i] += np.einsum("sj,jk,sk->s", part, inverse, part) / variance
    return explained


def _light(height: Floats, cell: float, sun: Sun) -> tuple[Floats, Floats]:
    """Return cast shadow and illumination (cosine of the angle of incidence) of each cell, both 0 to 1."""
    azimuth, rise = math.radians(sun[0]), math.radians(sun[1])
    east, north = math.sin(azimuth), math.cos(azimuth)
    shade = scipy.ndimage.gaussian_filter(
        _shadow(height, cell, east, north, math.tan(rise)).astype(float), 0.5
    )
    southward, eastward = np.gradient(scipy.ndimage.gaussian_filter(height, 0.7), cell)
    facing = math.sin(rise) - math.cos(rise) * (east * eastward - north * southward)
    return shade, np.clip(facing / np.sqrt(1 + southward**2 + eastward**2), 0, 1)


def _shadow(height: Floats, cell: float, east: float, north: float, slope: float) -> Bools:
    """Return the cells in cast shadow, ``(H, W)``, by ray casting in steps of one cell towards the sun."""
    rows, cols = height.shape
    shade = np.zeros(height.shape, bool)
    longest = (height.max() - height.min()) / slope / cell
    for step in range(1, math.ceil(min(longest, max(rows, cols))) + 1):
        down, right = round(-step * north), round(step * east)
        cells = _overlap(rows, down), _overlap(cols, right)
        towards_sun = _overlap(rows, -down), _overlap(cols, -right)
        shade[cells] |= height[towards_sun] - step * cell * slope > height[cells]
    return shade


def _overlap(count: int, by: int) -> slice:
    """Return the indices that stay in ``range(count)`` when ``by`` is added."""
    return slice(max(0, -by), max(0, min(count, count - by)))


def _working(grid: Grid) -> Grid:
    cell = max(grid.cell, FINEST_M)
    width, height = (min(MAX_CELLS, int(count * grid.cell / cell)) for count in (grid.width, grid.height))
    west = grid.west + (grid.width * grid.cell - width * cell) / 2
    north = grid.north - (grid.height * grid.cell - height * cell) / 2
    return Grid(grid.crs, west, north, cell, width, height)


def _onto(values: Floats, source: Grid, grid: Grid) -> Floats:
    """Return the mean of the values under each cell of the grid, ``(H, W)``; NaN without values."""
    means = np.full(grid.shape, np.nan)
    rasterio.warp.reproject(
        values.astype(np.float64),
        means,
        src_transform=source.transform,
        dst_transform=grid.transform,
        src_crs=grid.crs,
        dst_crs=grid.crs,
        src_nodata=np.nan,
        dst_nodata=np.nan,
        resampling=rasterio.enums.Resampling.average,
    )
    return means


def _targets(photo: Orthophoto, grid: Grid) -> tuple[Floats, Floats]:
    """Return brightness (clipped, because of white walls and roofs) and greenness on the grid, ``(H, W)``."""
    red, green, blue = photo.colour.astype(np.float64)
    bright = np.where(photo.known, 0.299 * red + 0.587 * green + 0.114 * blue, np.nan)
    leafy = np.where(photo.known, (2 * green - red - blue) / (red + green + blue + 30), np.nan)
    bright, leafy = _onto(bright, photo.grid, grid), _onto(leafy, photo.grid, grid)
    if np.isfinite(bright).any():
        bright = np.minimum(bright, 1.2 * np.nanmedian(bright))
    return bright, leafy


def _detail(values: Floats, cell: float) -> Floats:
    """Return the values minus their smooth part, ``(H, W)``; 0 where unknown."""
    valid = np.isfinite(values)
    weight = scipy.ndimage.gaussian_filter(valid.astype(float), DETAIL_M / cell)
    smooth = scipy.ndimage.gaussian_filter(np.where(valid, values, 0.0), DETAIL_M / cell)
    return np.where(valid, values - smooth / np.maximum(weight, 1e-9), 0.0)


def _expected(values: Floats, valid: Bools, cell: float) -> Singles:
    """Return the detail of a layer at the compared cells, ``(n,)``: cells inside the grid for every shift."""
    n = _reach(cell)
    inner = np.where(valid, _detail(values, cell), 0.0)[n:-n, n:-n].ravel()[::STRIDE]
    expected: Singles = (inner - inner.mean()).astype(np.float32)
    return expected


def _shifted(values: Floats, n: int) -> Singles:
    """Return the photo's values at the compared cells for every shift, ``(shifts, n)``, minus their mean."""
    rows, cols = values.shape[0] - 2 * n, values.shape[1] - 2 * n
    windows = np.lib.stride_tricks.sliding_window_view(values.astype(np.float32), (rows, cols))
    shifted: Singles = np.stack([window.ravel()[::STRIDE] for line in windows for window in line])
    shifted -= shifted.mean(axis=1, keepdims=True)
    return shifted


def _reach(cell: float) -> int:
    """Return the largest shift in cells, plus one so that a peak at `REACH_M` has a neighbour."""
    return math.ceil(REACH_M / cell) + 1


def _vertex(values: Floats, index: int) -> float:
    """Return the offset (cells) from a peak to the vertex of the parabola through it and its neighbours."""
    if not 0 < index < len(values) - 1:
        return 0.0
    before, peak, after = values[index - 1 : index + 2]
    bend = before - 2 * peak + after
    return float((before - after) / (2 * bend)) if bend < 0 else 0.0
