"""Say how far a tile's surface can be trusted, without ground truth: figures, flags, a map of its support.

Road is the raw segmented mask, for on it the surface is used. Two witnesses know the ground there: the scan,
where the filter kept it, and the terrain model. How far the surface is from the nearer of them is the tile's
doubt; tiles with the most are worth a look first. A fault in one place shows as a patch of doubted road.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.metrics.statistics import mean, nmad
from flexroad.tasks.quality.support import Support, support
from flexroad.tasks.roads.dtm_validity import AGREE_M, rise
from flexroad.tasks.spline.surface import MAX_LOG_WEIGHT, NurbsSurface
from flexroad.tasks.types import Bools, Floats, Quality, RoadClusters, RoadMask, Surface, TileData

VERSION = 1

AROUND_M = 5.0
"""Side of the square over which the scan's scatter is taken (m): more than a cell, less than a crown."""
FLAGS = {
    "error-estimate": "error_estimate_m",
    "patch": "suspect_m2",
    "spike": "curvature_per_m",
    "edge-step": "edge_step_m",
    "loose": "residual_p95_m",
    "off-dtm": "off_dtm_road",
    "inferred": "inferred_road",
    "dropped": "dropped_road",
    "weights": "bounded_weights",
}
"""Each flag and the figure that raises it when it is above the option of the figure's name."""
NO_ROAD = "no-road"
"""The flag of a tile whose mask has no road: nothing else can be told of it."""


class Options(base.Options):
    """What two heights of one ground may differ by, and above what a figure raises its flag."""

    agree_m: float = Field(
        AGREE_M, gt=0, description="heights that differ by more do not tell of one ground (m)"
    )
    error_estimate_m: float = Field(
        0.1, gt=0, description="flag error-estimate: mean distance of the surface to its nearer witness (m)"
    )
    suspect_m2: float = Field(
        50.0, gt=0, description="flag patch: largest patch of road doubted by more than agree_m (m2)"
    )
    curvature_per_m: float = Field(
        0.2, gt=0, description="flag spike: largest curvature on the road (1/m); a speed hump has less"
    )
    edge_step_m: float = Field(
        0.15, gt=0, description="flag edge-step: p95 of the step where the road ends (m); above a kerb"
    )
    residual_p95_m: float = Field(
        0.5, gt=0, description="flag loose: p95 distance of the kept points to the surface (m)"
    )
    off_dtm_road: float = Field(
        0.1, ge=0, le=1, description="flag off-dtm: share of the road more than agree_m off the DTM"
    )
    inferred_road: float = Field(
        0.05, ge=0, le=1, description="flag inferred: share of the road that no height supports"
    )
    dropped_road: float = Field(
        0.5, ge=0, le=1, description="flag dropped: share of the mask that the filter dropped"
    )
    bounded_weights: float = Field(
        0.25, ge=0, le=1, description="flag weights: share of the NURBS weights at a bound"
    )


def assess(
    data: TileData, road: RoadMask, clusters: RoadClusters, surface: Surface, options: Options
) -> Quality:
    """Measure a surface by what it was made from.

    Parameters
    ----------
    data : TileData
        DSM and DTM, m; neither the reference nor its road mask is looked at.
    road : RoadMask
        The raw mask and the cells beyond the survey.
    clusters : RoadClusters
        What the filter kept.
    surface : Surface
        What was fitted.
    options : Options
        Thresholds.

    Returns
    -------
    Quality
        Over the road cells of the core; NaN for what a tile or a surface does not have.
    """
    window, cell = data.grid.window(data.core), data.core.cell
    rests_on = support(data, road, clusters, options.agree_m)[window]
    on_road = road.mask[window] & (rests_on != Support.NONE)
    kept = on_road & clusters.mask[window] & np.isfinite(data.dsm[window])
    height = surface.lattice(data.core.eastings, data.core.northings)
    off_dsm, off_dtm = height - data.dsm[window], height - data.dtm[window]
    doubted = error_estimate(off_dsm, off_dtm, data.dsm[window] - data.dtm[window], kept, rests_on, cell)
    residuals, to_dtm = _finite(off_dsm[kept]), _finite(off_dtm[on_road])
    figures = {
        "residual_median_m": _quantile(residuals, 50),
        "residual_nmad_m": nmad(residuals),
        "residual_p95_m": _quantile(np.abs(residuals), 95),
        "curvature_per_m": _largest(_bends(height, on_road) / cell**2),
        "edge_step_m": _quantile(_edge_steps(height, on_road), 95),
        "measured_road": mean(rests_on[on_road] == Support.MEASURED),
        "dtm_road": mean(rests_on[on_road] == Support.DTM),
        "inferred_road": mean(rests_on[on_road] == Support.INFERRED),
        "dropped_road": mean(~kept[on_road]),
        "off_dtm_m": _quantile(to_dtm, 50),
        "off_dtm_road": mean(np.abs(to_dtm) > options.agree_m),
        "bounded_weights": _bounded(surface),
        "error_estimate_m": mean(_finite(doubted[on_road])),
        "suspect_m2": _patch(on_road & (doubted > options.agree_m)) * cell**2,
    }
    flags = [flag for flag, name in FLAGS.items() if figures[name] > getattr(options, name)]
    return Quality(**figures, flags=tuple(flags if on_road.any() else [NO_ROAD]), support=rests_on)


def error_estimate(
    off_dsm: Floats, off_dtm: Floats, above: Floats, kept: Bools, rests_on: NDArray[np.uint8], cell: float
) -> Floats:
    """Return by how much the surface may be wrong in each cell, ``(H, W)``, m: an estimate, no bound.

    It is the distance to the nearer witness. The DTM is one where it supports the surface; the scan is one
    where the filter kept it, but never better than it scatters around the cell: a road or a bridge deck
    is even, a crown is not. Without either it is what a road may rise from where it was known last.

    Parameters
    ----------
    off_dsm, off_dtm : (H, W) array
        Surface minus DSM and DTM (m).
    above : (H, W) array
        DSM minus DTM (m).
    kept : (H, W) array of bool
        Cells where the scan counts.
    rests_on : (H, W) array of uint8
        The cells' `Support`.
    cell : float
        Size of a cell (m).
    """
    scatter = _scatter(above, kept & np.isfinite(above), 2 * max(1, round(AROUND_M / cell / 2)) + 1)
    by_scan = np.where(kept, np.maximum(np.abs(off_dsm), scatter), np.nan)
    inferred = rests_on == Support.INFERRED
    by_dtm = np.where(inferred, np.nan, np.abs(off_dtm))
    away = scipy.ndimage.distance_transform_edt(inferred) * cell
    return np.where(inferred, AGREE_M + rise(away), np.fmin(by_scan, by_dtm))


def _scatter(values: Floats, known: Bools, size: int) -> Floats:
    """Return the standard deviation of the known values in a square around each cell; 0 without any."""
    share = np.maximum(scipy.ndimage.uniform_filter(known.astype(np.float64), size), 1e-9)
    values = np.where(known, values, 0.0)
    mean, square = (
        scipy.ndimage.uniform_filter(values, size) / share,
        scipy.ndimage.uniform_filter(values**2, size) / share,
    )
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)))


def _bends(height: Floats, on_road: Bools) -> Floats:
    """Return the second differences (m) along rows and columns at road cells between road cells, ``(n,)``."""
    found = []
    for z, inside in ((height, on_road), (height.T, on_road.T)):
        bend = z[2:] - 2 * z[1:-1] + z[:-2]
        found.append(np.abs(bend[inside[2:] & inside[1:-1] & inside[:-2]]))
    return _finite(np.concatenate(found))


def _edge_steps(height: Floats, on_road: Bools) -> Floats:
    """Return by how far the first cell beside the road is off the line of the last two on it, ``(n,)``, m."""
    found = []
    for z, inside in ((height, on_road), (height.T, on_road.T)):
        for ahead, there in ((z, inside), (z[::-1], inside[::-1])):
            step = ahead[2:] - 2 * ahead[1:-1] + ahead[:-2]
            found.append(np.abs(step[~there[2:] & there[1:-1] & there[:-2]]))
    return _finite(np.concatenate(found))


def _patch(cells: Bools) -> int:
    """Return how many cells the largest patch of neighbours has."""
    patches, _ = scipy.ndimage.label(cells)
    return int(np.bincount(patches[cells], minlength=1).max())


def _bounded(surface: Surface) -> float:
    if not isinstance(surface, NurbsSurface):
        return float("nan")
    return mean(np.abs(np.log(surface.W)) > MAX_LOG_WEIGHT * (1 - 1e-9))


def _finite(values: Floats) -> Floats:
    return values[np.isfinite(values)]


def _largest(values: Floats) -> float:
    return float(values.max()) if values.size else float("nan")


def _quantile(values: Floats, percent: float) -> float:
    return float(np.percentile(values, percent)) if values.size else float("nan")
