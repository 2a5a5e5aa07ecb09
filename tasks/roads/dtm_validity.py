"""Find road cells with an invalid DTM by comparing it with the plane through the kept road cells nearby."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

AGREE_M = 0.3
"""Largest difference of two heights of the same ground (m)."""


NEAR_M = 5.0
"""Standard deviation of the Gaussian weights of the kept cells around a gap (m)."""


REACH_M = 3 * NEAR_M
"""Farther than this from any kept cell the DTM is not checked (m)."""


CREST_M = 100.0
"""Smallest radius of crests and sags expected where a road is hidden (m)."""


THIN_M2 = 0.2
"""Cells whose variance in some direction is below this (m2) lie on a line and define no plane."""


def invalid_dtm(data: TileData, road: RoadMask, kept: Bools) -> Bools:
    """Return the road cells dropped by the filter whose DTM does not continue the road, ``(H, W)``.

    The expected height is that of the plane through the kept cells around. The DTM may differ from it by
    `AGREE_M`, plus the scatter of those cells, plus the rise of a crest over the distance to the nearest of
    them. Farther than `REACH_M` from all kept cells the DTM is taken as valid.

    Parameters
    ----------
    data : TileData
        DSM and DTM, m.
    road : RoadMask
        The raw mask.
    kept : (H, W) array of bool
        The filtered mask.
    """
    kept = kept & np.isfinite(data.dsm)
    checked = road.mask & ~kept & np.isfinite(data.dtm)
    if not (checked.any() and kept.any()):
        return np.zeros_like(checked)
    away = scipy.ndimage.distance_transform_edt(~kept) * data.grid.cell
    expected, scatter = extrapolated_plane(data.dsm, kept, data.grid.cell)
    off = np.abs(data.dtm - expected)
    return np.asarray(checked & (away <= REACH_M) & (off > AGREE_M + scatter + rise(away)))


def rise(away: Floats) -> Floats:
    """Return the largest deviation of a road from its tangent (m) at the distance ``away`` (m)."""
    return away**2 / (2 * CREST_M)


def without_invalid_dtm(data: TileData, clusters: RoadClusters) -> TileData:
    """Return the data with NaN for the invalid DTM, so that neither the loss nor the start uses it."""
    if clusters.dtm_invalid is None:
        return data
    return replace(data, dtm=np.where(clusters.dtm_invalid, np.nan, data.dtm))


def extrapolated_plane(heights: Floats, valid: Bools, cell: float) -> tuple[Floats, Floats]:
    """Return height and scatter (m) of the plane through the given cells around each cell, ``(H, W)`` each.

    Moving least squares with Gaussian weights; NaN where there is no given cell within `REACH_M`, or all of
    them lie on a line.

    Parameters
    ----------
    heights : (H, W) array
        Heights (m).
    valid : (H, W) array of bool
        Cells whose heights are used; at least one.
    cell : float
        Size of a cell (m).
    """
    datum = float(heights[valid].mean())
    z = np.where(valid, heights - datum, 0.0)
    total = _moment(valid.astype(np.float64), cell, 0, 0)
    orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        r, c, rr, rc, cc = (_moment(valid.astype(np.float64), cell, *order) / total for order in orders)
        m, mr, mc = (_moment(z, cell, *order) / total for order in ((0, 0), (1, 0), (0, 1)))
        # Central moments give two equations for the slopes, then the height at offset 0.
        rr, rc, cc = rr - r * r, rc - r * c, cc - c * c
        mr, mc = mr - m * r, mc - m * c
        determinant = np.where(_least_spread(rr, rc, cc) >= THIN_M2, rr * cc - rc * rc, np.nan)
        by_row, by_col = (mr * cc - mc * rc) / determinant, (mc * rr - mr * rc) / determinant
        left = _moment(z**2, cell, 0, 0) / total - m * m - by_row * mr - by_col * mc
        return datum + m - by_row * r - by_col * c, np.sqrt(np.maximum(left, 0.0))


def _least_spread(rr: Floats, rc: Floats, cc: Floats) -> Floats:
    """Return the smaller eigenvalue of symmetric 2 x 2 matrices."""
    return np.asarray((rr + cc) / 2 - np.hypot((rr - cc) / 2, rc))


def _moment(values: Floats, cell: float, row_power: int, col_power: int) -> Floats:
    """Return the sum of value x Gaussian weight x powers of the offsets (m) over each cell's neighbours."""
    n = int(REACH_M / cell)
    offset = np.arange(-n, n + 1) * cell
    bell = np.exp(-0.5 * (offset / NEAR_M) ** 2)
    along = scipy.ndimage.correlate1d(values, bell * offset**row_power, axis=0, mode="constant")
    return np.asarray(scipy.ndimage.correlate1d(along, bell * offset**col_power, axis=1, mode="constant"))
