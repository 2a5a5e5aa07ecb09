"""How far an orthophoto lies off the heights: the plan shift under which the heights explain the photo best.

Edges alone do not tell: in a photo a tree is a dark blob with its shadow to one side, and looks shifted away
from the sun. So the photo's brightness and greenness are explained by what the DSM lets expect of them
(what stands high, what is rough like leaves, what faces the sun, what lies in its shadow) by least squares,
for suns all around the sky and shifts up to `REACH_M`; the sun and the shift that explain the largest share
of the variance win, to about half a cell. Only detail finer than `DETAIL_M` counts: the rest tells little.

Tiles of one flight have one sun and, mostly, one shift: together they tell more than each alone. What is
found is a mean: photos that were not made with the surface model lean (roofs and crowns lie outwards of
their feet), cars drove on, and trees grew; a flat field tells nothing. `Shift.confidence` tells how far the
best shift stands out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.types import Bools, Floats, Orthophoto, TileData

Singles = NDArray[np.float32]
Sun = tuple[float, float]
"""Azimuth from north over east, and height above the horizon (degrees)."""

REACH_M = 5.0
"""Shifts up to this are looked for, east and north."""
FINEST_M, MOST_CELLS = 1.0, 320
"""The working cell is at least this; of a larger tile its middle is taken."""
EVERY = 3
"""One cell in so many is compared: neighbours tell much the same."""
DETAIL_M = 4.0
"""Standard deviation of the smooth part that is taken away."""
APART_M = 2.0
"""A second peak counts as another one at this distance."""
CLEAR = 0.3
"""Confidence from which on a single tile is believed."""
SMALLEST_M = 1.0
"""Smaller shifts, and those below half a cell of the heights, are none to warn of."""

AROUND = tuple((float(azimuth), float(rise)) for azimuth in range(0, 360, 30) for rise in (25, 40, 55))
"""Suns all around the sky, each within 15 degrees of azimuth and 7.5 of height of any there may be."""
CLOSER = (1 / 2, 1 / 4, 1 / 8)
"""How much of that lies between the suns tried next, around the best so far."""
STEP_DEG = (30.0, 15.0)


@dataclass(frozen=True)
class Shift:
    """Where the photo lies, seen from the heights."""

    east_m: float
    north_m: float
    confidence: float
    """Share of what the best shift explains that no shift `APART_M` away does, 0 to 1."""
    sun: Sun

    @property
    def length_m(self) -> float:
        """How far it is."""
        return math.hypot(self.east_m, self.north_m)

    def __str__(self) -> str:
        east = f"{abs(self.east_m):.1f} m {'east' if self.east_m >= 0 else 'west'}"
        north = f"{abs(self.north_m):.1f} m {'north' if self.north_m >= 0 else 'south'}"
        return f"{east} and {north}"


@dataclass(frozen=True, eq=False)
class Pair:
    """Heights and photo of a tile on one lattice, ready to be compared."""

    cell: float
    height: Floats
    """DSM, ``(H, W)``, m, without voids."""
    known: Bools
    """Cells with a height of their own, ``(H, W)``."""
    always: Singles
    """What is expected whatever the sun, ``(2, n)``: what stands high, and what of it is rough."""
    seen: Singles
    """Brightness and greenness at these cells under every shift, ``(2, shifts, n)``; 0 where unknown."""


def note(data: TileData, photo: Orthophoto) -> str | None:
    """Return a warning of a photo that clearly lies off the heights of its tile, or None."""
    if not large_enough(data.grid):
        return None
    found = shift([pair(data, photo)])
    if found.confidence < CLEAR or not matters(found, data.grid.cell):
        return None
    return f"dop: seems to lie {found} of the heights; `flexroad catalog check` looks at more tiles"


def large_enough(grid: Grid) -> bool:
    """Return whether a tile is so much larger than the shifts looked for that it can tell of them."""
    return min(grid.width, grid.height) * grid.cell >= 8 * REACH_M


def matters(found: Shift, cell: float, scatter_m: float = 0.0) -> bool:
    """Return whether a shift exceeds its scatter by `SMALLEST_M` and by half a cell of the heights."""
    return found.length_m > max(SMALLEST_M, cell / 2) + scatter_m


def pair(data: TileData, photo: Orthophoto) -> Pair:
    """Return a tile's heights and its photo, which covers the tile's grid, ready to be compared."""
    grid = _working(data.grid)
    height, ground = (_onto(values, data.grid, grid) for values in (data.dsm, data.dtm))
    known = np.isfinite(height)
    height = np.where(known, height, ground)
    height = np.where(np.isfinite(height), height, np.nanmin(height, initial=9e9))
    above = np.nan_to_num(height - ground)
    rough = scipy.ndimage.uniform_filter(np.abs(height - scipy.ndimage.median_filter(height, 5)), 5)
    high = np.clip((above - 0.5) / 2, 0, 1)
    n = _reach(grid.cell)
    always = [_expected(values, known, grid.cell) for values in (high, high * np.clip(2 * rough, 0, 1))]
    seen = [_shifted(_detail(values, grid.cell), n) for values in _targets(photo, grid)]
    return Pair(grid.cell, height, known, np.stack(always), np.stack(seen))


def shift(pairs: Sequence[Pair], sun: Sun | None = None) -> Shift:
    """Return the one shift, under one sun, that explains the photos of all pairs best.

    Parameters
    ----------
    pairs : sequence of Pair
        Tiles of one flight, at least one, with the same cell.
    sun : Sun, optional
        Where it stood, if that is known.
    """
    cell, n = pairs[0].cell, _reach(pairs[0].cell)
    known = sun is not None
    sun, explained = _best(pairs, AROUND if sun is None else [sun])
    for part in () if known else CLOSER:
        steps = [
            (east * part * STEP_DEG[0], up * part * STEP_DEG[1]) for east in (-1, 0, 1) for up in (-1, 0, 1)
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
    """Return the sun that explains most, and what it explains by shift, rows from the north."""
    n = _reach(pairs[0].cell)
    explained = np.sum([_explained(pair, suns) for pair in pairs], axis=0)
    best = int(np.argmax(explained.max(axis=1)))
    return suns[best], explained[best].reshape(2 * n + 1, 2 * n + 1)


def _explained(pair: Pair, suns: Sequence[Sun]) -> Floats:
    """Return the explained shares of the variances of brightness and greenness, ``(suns, shifts)``."""
    light = [_expected(v, pair.known, pair.cell) for sun in suns for v in _light(pair.height, pair.cell, sun)]
    expected = np.stack([*pair.always, *light])
    gram = (expected @ expected.T).astype(np.float64)
    against = [(seen @ expected.T).astype(np.float64) for seen in pair.seen]
    variance = [np.maximum(np.einsum("sn,sn->s", seen, seen), 1e-9) for seen in pair.seen]
    found = np.zeros((len(suns), pair.seen.shape[1]))
    for i in range(len(suns)):
        which = [0, 1, 2 + 2 * i, 3 + 2 * i]
        inverse = np.linalg.inv(gram[np.ix_(which, which)] + 1e-6 * np.eye(4))
        for one, total in zip(against, variance, strict=True):
            found[i] += np.einsum("sj,jk,sk->s", one[:, which], inverse, one[:, which]) / total
    return found


def _light(height: Floats, cell: float, sun: Sun) -> tuple[Floats, Floats]:
    """Return how far a cell lies in the cast shadow and how squarely it faces the sun, both 0 to 1."""
    azimuth, rise = math.radians(sun[0]), math.radians(sun[1])
    east, north = math.sin(azimuth), math.cos(azimuth)
    shade = scipy.ndimage.gaussian_filter(
        _shadow(height, cell, east, north, math.tan(rise)).astype(float), 0.5
    )
    southward, eastward = np.gradient(scipy.ndimage.gaussian_filter(height, 0.7), cell)
    facing = math.sin(rise) - math.cos(rise) * (east * eastward - north * southward)
    return shade, np.clip(facing / np.sqrt(1 + southward**2 + eastward**2), 0, 1)


def _shadow(height: Floats, cell: float, east: float, north: float, slope: float) -> Bools:
    """Return the cells that something between them and the sun hides, by steps of one cell toward it."""
    rows, cols = height.shape
    shade = np.zeros(height.shape, bool)
    longest = (height.max() - height.min()) / slope / cell
    for step in range(1, math.ceil(min(longest, max(rows, cols))) + 1):
        down, right = round(-step * north), round(step * east)
        here = _overlap(rows, down), _overlap(cols, right)
        there = _overlap(rows, -down), _overlap(cols, -right)
        shade[here] |= height[there] - step * cell * slope > height[here]
    return shade


def _overlap(count: int, by: int) -> slice:
    """Return the indices that stay within the count when ``by`` is added."""
    return slice(max(0, -by), max(0, min(count, count - by)))


def _working(grid: Grid) -> Grid:
    cell = max(grid.cell, FINEST_M)
    width, height = (min(MOST_CELLS, int(count * grid.cell / cell)) for count in (grid.width, grid.height))
    west = grid.west + (grid.width * grid.cell - width * cell) / 2
    north = grid.north - (grid.height * grid.cell - height * cell) / 2
    return Grid(grid.crs, west, north, cell, width, height)


def _onto(values: Floats, source: Grid, grid: Grid) -> Floats:
    """Return the mean of the values under each cell of the grid, ``(H, W)``; NaN where there is none."""
    from rasterio.enums import Resampling
    from rasterio.warp import reproject

    found = np.full(grid.shape, np.nan)
    reproject(
        values.astype(np.float64),
        found,
        src_transform=source.transform,
        dst_transform=grid.transform,
        src_crs=grid.crs,
        dst_crs=grid.crs,
        src_nodata=np.nan,
        dst_nodata=np.nan,
        resampling=Resampling.average,
    )
    return found


def _targets(photo: Orthophoto, grid: Grid) -> tuple[Floats, Floats]:
    """Return brightness, white walls and roofs cut off, and greenness on the grid, ``(H, W)``."""
    red, green, blue = photo.colour.astype(np.float64)
    bright = np.where(photo.known, 0.299 * red + 0.587 * green + 0.114 * blue, np.nan)
    leafy = np.where(photo.known, (2 * green - red - blue) / (red + green + blue + 30), np.nan)
    bright, leafy = _onto(bright, photo.grid, grid), _onto(leafy, photo.grid, grid)
    if np.isfinite(bright).any():
        bright = np.minimum(bright, 1.2 * np.nanmedian(bright))
    return bright, leafy


def _detail(values: Floats, cell: float) -> Floats:
    """Return the values less their smooth part, ``(H, W)``; 0 where unknown."""
    known = np.isfinite(values)
    weight = scipy.ndimage.gaussian_filter(known.astype(float), DETAIL_M / cell)
    smooth = scipy.ndimage.gaussian_filter(np.where(known, values, 0.0), DETAIL_M / cell)
    return np.where(known, values - smooth / np.maximum(weight, 1e-9), 0.0)


def _expected(values: Floats, known: Bools, cell: float) -> Singles:
    """Return the detail of what is expected where every shift of the photo reaches, ``(n,)``."""
    n = _reach(cell)
    inner = np.where(known, _detail(values, cell), 0.0)[n:-n, n:-n].ravel()[::EVERY]
    expected: Singles = (inner - inner.mean()).astype(np.float32)
    return expected


def _shifted(values: Floats, n: int) -> Singles:
    """Return what the photo shows at every inner cell under every shift, ``(shifts, n)``."""
    rows, cols = values.shape[0] - 2 * n, values.shape[1] - 2 * n
    windows = np.lib.stride_tricks.sliding_window_view(values.astype(np.float32), (rows, cols))
    seen: Singles = np.stack([window.ravel()[::EVERY] for line in windows for window in line])
    seen -= seen.mean(axis=1, keepdims=True)
    return seen


def _reach(cell: float) -> int:
    """Return the largest shift in cells; one more than asked, for the peak's other side."""
    return math.ceil(REACH_M / cell) + 1


def _vertex(values: Floats, at: int) -> float:
    """Return how far the top of the parabola through a peak and its neighbours lies beside it (cells)."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, peak, after = values[at - 1 : at + 2]
    bend = before - 2 * peak + after
    return float((before - after) / (2 * bend)) if bend < 0 else 0.0
