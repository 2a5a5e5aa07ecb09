"""Find road cells with an invalid DTM by comparing it with the plane through the kept road cells nearby."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.roads.distances import columns_of
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

DSM_DTM_TOLERANCE_M = 0.3
"""Largest difference of two heights of the same ground (m)."""
NEAR_M = 5.0
"""Standard deviation of the Gaussian weights of the kept cells around a gap (m)."""
REACH_M = 3 * NEAR_M
"""Largest distance from a kept cell at which the DTM is checked (m)."""
CREST_M = 100.0
"""Smallest expected radius of crests and sags of a hidden road (m)."""
THIN_M2 = 0.2
"""Cells whose variance in some direction is below this (m2) lie on a line and define no plane."""

Slices = tuple[slice, slice]
"""(row, col) slices of a part of a raster."""
EVERYWHERE: Slices = (slice(None), slice(None))


def invalid_dtm(data: TileData, road: RoadMask, kept: Bools, near: Slices = EVERYWHERE) -> Bools:
    """Return the road cells dropped by the filter whose DTM does not continue the road, ``(H, W)``.

    The expected height is the height of the plane through the kept cells around. The DTM may differ from it
    by `DSM_DTM_TOLERANCE_M`, plus the scatter of these cells, plus the rise of a crest over the distance to
    the nearest of them. Farther than `REACH_M` from all kept cells the DTM is taken as valid.

    - `data`: DSM and DTM, m.
    - `kept`: the filtered mask.
    - `near`: the part of the raster in which the DTM is checked.
    """
    kept = kept & np.isfinite(data.dsm)
    checked: Bools = np.zeros(kept.shape, np.bool_)
    invalid: Bools = np.zeros(kept.shape, np.bool_)
    checked[near] = road.mask[near] & ~kept[near] & np.isfinite(data.dtm[near])
    if checked.any() and kept.any():
        expected, scatter, away = extrapolated_plane(data.dsm, kept, checked, data.grid.cell)
        off = np.abs(data.dtm[checked] - expected)
        invalid[checked] = (away <= REACH_M) & (off > DSM_DTM_TOLERANCE_M + scatter + rise(away))
    return invalid


def rise(away: Floats) -> Floats:
    """Return the largest deviation of a road from its tangent (m) at the distance ``away`` (m)."""
    return away**2 / (2 * CREST_M)


def valid_dtm(data: TileData, clusters: RoadClusters, window: Slices = EVERYWHERE) -> Floats:
    """Return the DTM in a window with NaN where it is invalid, so that neither loss nor start uses it."""
    if clusters.dtm_invalid is None:
        dtm: Floats = data.dtm[window]
        return dtm
    return np.where(clusters.dtm_invalid[window], np.nan, data.dtm[window])


def ground_to_fit(data: TileData, clusters: RoadClusters, window: Slices = EVERYWHERE) -> Floats:
    """Return the heights to fit in a window, m: the DSM on the road, the valid DTM elsewhere."""
    return np.where(clusters.labels[window] > 0, data.dsm[window], valid_dtm(data, clusters, window))


def extrapolated_plane(
    heights: Floats, valid: Bools, wanted: Bools, cell: float
) -> tuple[Floats, Floats, Floats]:
    """Extrapolate the plane through the given cells around each wanted cell.

    Moving least squares with Gaussian weights over the given cells up to `REACH_M` away in rows and columns.
    Height and scatter are NaN where no cell is given, or all given cells lie on a line.

    - `heights`: heights (m).
    - `valid`: cells whose heights are used; at least one.
    - `wanted`: cells at which the plane is evaluated; n in number.
    - `cell`: size of a cell (m).
    - `height`, `scatter`, `away`: height of the plane, scatter of the given cells around it, and distance to
      the nearest given cell (m), or inf. In row-major order of the wanted cells.
    """
    datum, n = float(heights[valid].mean()), int(REACH_M / cell)
    bell = np.exp(-0.5 * (np.arange(-n, n + 1) * cell / NEAR_M) ** 2)
    cells = np.argwhere(wanted)
    # Neighbouring cells of one column share most of their rows.
    order = np.argsort(cells[:, 1], kind="stable")
    sums, nearest = _sums(heights, valid, cells, order, bell, cell, datum)
    with np.errstate(invalid="ignore", divide="ignore"):
        r, c, rr, rc, cc, m, mr, mc, mm = sums[:, 1:].T / sums[:, 0]
        # Central moments give two equations for the slopes, then the height at offset 0.
        rr, rc, cc = rr - r * r, rc - r * c, cc - c * c
        mr, mc = mr - m * r, mc - m * c
        least_variance = (rr + cc) / 2 - np.hypot((rr - cc) / 2, rc)
        determinant = np.where(least_variance >= THIN_M2, rr * cc - rc * rc, np.nan)
        by_row, by_col = (mr * cc - mc * rc) / determinant, (mc * rr - mr * rc) / determinant
        left = mm - m * m - by_row * mr - by_col * mc
        height, scatter = datum + m - by_row * r - by_col * c, np.sqrt(np.maximum(left, 0.0))
    return height, scatter, np.sqrt(nearest) * cell


@compiled()
def _sums(
    heights: Floats,
    valid: Bools,
    cells: NDArray[np.intp],
    order: NDArray[np.intp],
    bell: Floats,
    cell: float,
    datum: float,
) -> tuple[Floats, Floats]:
    """Return weighted sums over the valid cells around each cell, and the squared distance to the nearest.

    The sums are over 1, r, c, rr, rc, cc, z, rz, cz and zz, ``(n, 10)``, with offsets r and c (m) and heights
    z above the datum (m). The distances are in cells, ``(n,)``.
    """
    reach = len(bell) // 2
    sums, nearest = np.zeros((len(cells), 10)), np.full(len(cells), np.inf)
    row_sums, done_for = np.empty((len(valid), 7)), np.full(len(valid), -1)
    columns, before = columns_of(valid)
    for k in order:
        row, col = cells[k]
        for i in range(max(row - reach, 0), min(row + reach + 1, len(valid))):
            if done_for[i] != col:
                of_row = _row_sums(heights, columns, before, i, col, bell, cell, datum)
                for j in range(7):
                    row_sums[i, j] = of_row[j]
                done_for[i] = col
            n, c, cc, z, cz, zz, beside = row_sums[i]
            if n == 0.0:
                continue
            w, r = bell[i - row + reach], (i - row) * cell
            terms = (n, r * n, c, r * r * n, r * c, cc, z, r * z, cz, zz)
            for j in range(10):
                sums[k, j] += w * terms[j]
            nearest[k] = min(nearest[k], (i - row) ** 2 + beside**2)
    return sums, nearest


@compiled()
def _row_sums(
    heights: Floats,
    columns: NDArray[np.intp],
    before: NDArray[np.int32],
    row: int,
    col: int,
    bell: Floats,
    cell: float,
    datum: float,
) -> tuple[float, float, float, float, float, float, float]:
    """Return the weighted sums of 1, c, cc, z, cz and zz in one row, and the columns to the nearest cell."""
    reach, wide = len(bell) // 2, heights.shape[1]
    n, c, cc, z, cz, zz, beside = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf
    first, last = row * wide + max(col - reach, 0), row * wide + min(col + reach + 1, wide)
    for j in columns[before[first] : before[last]]:
        w, x, up = bell[j - col + reach], (j - col) * cell, heights[row, j] - datum
        n, c, cc = n + w, c + w * x, cc + w * x * x
        z, cz, zz = z + w * up, cz + w * x * up, zz + w * up * up
        beside = min(beside, abs(j - col))
    return n, c, cc, z, cz, zz, beside
