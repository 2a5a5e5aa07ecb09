"""Where the DTM is not the road's: the road that can be seen beside a gap says how it goes on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, TileData

AGREE_M = 0.3
"""Two heights tell of one ground up to this difference (m)."""


NEAR_M = 5.0
"""Standard deviation of the Gaussian by which road beside a gap says how it goes on (m)."""


REACH_M = 3 * NEAR_M
"""Farther than this from any kept cell nothing can gainsay the DTM (m)."""


CREST_M = 100.0
"""Radius of the sharpest crest or sag to be expected where a road is not seen (m)."""


THIN_M2 = 0.2
"""What scatters less in some direction (m2) lies on a line, and no plane goes on from it."""


def invalid_dtm(data: TileData, road: RoadMask, kept: Bools) -> Bools:
    """Return the road cells the filter dropped where the DTM is off the road's continuation, ``(H, W)``.

    The plane through the kept cells around says where the road should be. The DTM may be off it by
    `AGREE_M`, what those cells scatter, and what a crest rises on the way to the next of them. Farther than
    `REACH_M` from all of them the DTM is believed.

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
    asked = road.mask & ~kept & np.isfinite(data.dtm)
    if not (asked.any() and kept.any()):
        return np.zeros_like(asked)
    away = scipy.ndimage.distance_transform_edt(~kept) * data.grid.cell
    expected, scatter = extrapolated_plane(data.dsm, kept, data.grid.cell)
    off = np.abs(data.dtm - expected)
    return np.asarray(asked & (away <= REACH_M) & (off > AGREE_M + scatter + rise(away)))


def rise(away: Floats) -> Floats:
    """Return how far a road may be from its tangent (m), so far away (m) from where it was seen."""
    return away**2 / (2 * CREST_M)


def without_invalid_dtm(data: TileData, clusters: RoadClusters) -> TileData:
    """Return the data without DTM where that is not sound, so that neither loss nor start see it."""
    if clusters.dtm_invalid is None:
        return data
    return replace(data, dtm=np.where(clusters.dtm_invalid, np.nan, data.dtm))


def extrapolated_plane(heights: Floats, known: Bools, cell: float) -> tuple[Floats, Floats]:
    """Return height and scatter (m) of the plane through the known cells around each cell, ``(H, W)`` each.

    Moving least squares with Gaussian weights; NaN where within `REACH_M` there is no known cell, or all of
    them lie on a line.

    Parameters
    ----------
    heights : (H, W) array
        Heights (m).
    known : (H, W) array of bool
        Which of them count; at least one.
    cell : float
        Size of a cell (m).
    """
    datum = float(heights[known].mean())
    z = np.where(known, heights - datum, 0.0)
    total = _moment(known.astype(np.float64), cell, 0, 0)
    orders = ((1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        r, c, rr, rc, cc = (_moment(known.astype(np.float64), cell, *order) / total for order in orders)
        m, mr, mc = (_moment(z, cell, *order) / total for order in ((0, 0), (1, 0), (0, 1)))
        # Central moments: two equations for the slopes, then the level where the offsets are 0.
        rr, rc, cc = rr - r * r, rc - r * c, cc - c * c
        mr, mc = mr - m * r, mc - m * c
        determinant = np.where(_least_spread(rr, rc, cc) >= THIN_M2, rr * cc - rc * rc, np.nan)
        by_row, by_col = (mr * cc - mc * rc) / determinant, (mc * rr - mr * rc) / determinant
        left = _moment(z**2, cell, 0, 0) / total - m * m - by_row * mr - by_col * mc
        return datum + m - by_row * r - by_col * c, np.sqrt(np.maximum(left, 0.0))


def _least_spread(rr: Floats, rc: Floats, cc: Floats) -> Floats:
    """Return the smaller eigenvalue of symmetric matrices of two rows."""
    return np.asarray((rr + cc) / 2 - np.hypot((rr - cc) / 2, rc))


def _moment(values: Floats, cell: float, row_power: int, col_power: int) -> Floats:
    """Return the sum over each cell's neighbours: value, Gaussian weight, and powers of the offsets (m)."""
    n = int(REACH_M / cell)
    offset = np.arange(-n, n + 1) * cell
    bell = np.exp(-0.5 * (offset / NEAR_M) ** 2)
    along = scipy.ndimage.correlate1d(values, bell * offset**row_power, axis=0, mode="constant")
    return np.asarray(scipy.ndimage.correlate1d(along, bell * offset**col_power, axis=1, mode="constant"))
