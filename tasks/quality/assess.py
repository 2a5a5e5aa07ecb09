"""Assess a tile's surface without ground truth: figures, flags and a map of its support.

All figures are over the raw segmented mask, where the surface is used as road. The surface is compared with
two height sources: the DSM on cells that the filter kept, and the DTM. The distance to the nearer of them is
the error estimate; tiles with the largest one should be checked first. A local fault appears as a patch of
road with a large error estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

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

VERSION = 2

SCATTER_M = 5.0
"""Side of the square over which the scatter of the DSM is taken (m); smaller than a tree crown."""
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
"""Figure of each flag; the flag is raised if the figure exceeds the option with the figure's name."""
NO_ROAD = "no-road"
"""The flag of a tile without road: its mask has none, or the filter dropped all of it. With an empty mask it
is the only flag."""


class Options(base.Options):
    """Tolerance between two heights of the same ground, and the threshold of each flag."""

    agree_m: float = Field(
        AGREE_M, gt=0, description="largest difference between two heights of the same ground (m)"
    )
    error_estimate_m: float = Field(
        0.1,
        gt=0,
        description="flag error-estimate: mean distance of the surface to the nearer of DSM and DTM (m)",
    )
    suspect_m2: float = Field(
        50.0, gt=0, description="flag patch: largest patch of road with an error estimate above agree_m (m2)"
    )
    curvature_per_m: float = Field(
        0.2, gt=0, description="flag spike: largest curvature on the road (1/m); a speed hump has less"
    )
    edge_step_m: float = Field(
        0.15, gt=0, description="flag edge-step: p95 of the step at the road's edge (m); higher than a kerb"
    )
    residual_p95_m: float = Field(
        0.5, gt=0, description="flag loose: p95 distance of the kept points to the surface (m)"
    )
    off_dtm_road: float = Field(
        0.1, ge=0, le=1, description="flag off-dtm: share of the road more than agree_m off the DTM"
    )
    inferred_road: float = Field(
        0.05, ge=0, le=1, description="flag inferred: share of the road without a height in the fit"
    )
    dropped_road: float = Field(
        0.5, ge=0, le=1, description="flag dropped: share of the mask that the filter dropped"
    )
    bounded_weights: float = Field(
        0.25, ge=0, le=1, description="flag weights: share of the NURBS weights at a bound"
    )


@dataclass(frozen=True, eq=False)
class Compared:
    """A surface beside DSM and DTM in the cells of a tile's core; arrays are ``(H, W)``."""

    on_road: Bools
    """Road cells of the raw mask within the survey."""
    kept: Bools
    """Those that the filter kept and that have a DSM height."""
    classes: NDArray[np.uint8]
    """The cells' `Support`."""
    height: Floats
    """Height of the surface (m)."""
    off_dsm: Floats
    """Surface minus DSM (m)."""
    off_dtm: Floats
    """Surface minus DTM (m)."""
    estimate: Floats
    """Estimated error of the surface (m), by `error_estimate`."""


def assess(
    data: TileData, road: RoadMask, clusters: RoadClusters, surface: Surface, options: Options
) -> Quality:
    """Assess a surface by the data it was fitted to.

    Parameters
    ----------
    data : TileData
        DSM and DTM, m; the reference and its road mask are not used.
    road : RoadMask
        The raw mask and the cells beyond the survey.
    clusters : RoadClusters
        The road cells that the filter kept.
    surface : Surface
        The fitted surface.
    options : Options
        Tolerance and thresholds.

    Returns
    -------
    Quality
        Figures over the road cells of the core; NaN where the tile or the surface has no such data.
    """
    cells = compare(data, road, clusters, surface, options)
    on_road, kept, classes, height = cells.on_road, cells.kept, cells.classes, cells.height
    estimate, cell = cells.estimate, data.core.cell
    residuals, to_dtm = _finite(cells.off_dsm[kept]), _finite(cells.off_dtm[on_road])
    figures = {
        "residual_median_m": _quantile(residuals, 50),
        "residual_nmad_m": nmad(residuals),
        "residual_p95_m": _quantile(np.abs(residuals), 95),
        "curvature_per_m": _largest(_second_differences(height, on_road) / cell**2),
        "edge_step_m": _quantile(_edge_steps(height, on_road), 95),
        "measured_road": mean(classes[on_road] == Support.MEASURED),
        "dtm_road": mean(classes[on_road] == Support.DTM),
        "inferred_road": mean(classes[on_road] == Support.INFERRED),
        "dropped_road": mean(~kept[on_road]),
        "off_dtm_m": _quantile(to_dtm, 50),
        "off_dtm_road": mean(np.abs(to_dtm) > options.agree_m),
        "bounded_weights": _share_at_bound(surface),
        "error_estimate_m": mean(_finite(estimate[on_road])),
        "suspect_m2": _largest_patch(on_road & (estimate > options.agree_m)) * cell**2,
    }
    flags = [flag for flag, name in FLAGS.items() if figures[name] > getattr(options, name)]
    if not on_road.any():
        figures["suspect_m2"] = float("nan")
        flags = []
    if not kept.any():
        flags = [NO_ROAD, *flags]
    return Quality(**figures, flags=tuple(flags), support=classes)


def compare(
    data: TileData, road: RoadMask, clusters: RoadClusters, surface: Surface, options: Options
) -> Compared:
    """Compare a surface with DSM and DTM cell by cell; the parameters are those of `assess`."""
    window = data.grid.window(data.core)
    classes = support(data, road, clusters, options.agree_m)[window]
    on_road = road.mask[window] & (classes != Support.NONE)
    kept = on_road & clusters.mask[window] & np.isfinite(data.dsm[window])
    height = surface.lattice(data.core.eastings, data.core.northings)
    off_dsm, off_dtm = height - data.dsm[window], height - data.dtm[window]
    dsm_above_dtm = data.dsm[window] - data.dtm[window]
    estimate = error_estimate(off_dsm, off_dtm, dsm_above_dtm, kept, classes, data.core.cell)
    return Compared(on_road, kept, classes, height, off_dsm, off_dtm, estimate)


def cell_errors(
    data: TileData, road: RoadMask, clusters: RoadClusters, surface: Surface, options: Options
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the estimated error (m) and the `Support` of each cell of the core, ``(H, W)``; see `assess`.

    The estimate is NaN beyond the survey.
    """
    cells = compare(data, road, clusters, surface, options)
    return np.where(cells.classes == Support.NONE, np.nan, cells.estimate), cells.classes


def error_estimate(
    off_dsm: Floats,
    off_dtm: Floats,
    dsm_above_dtm: Floats,
    kept: Bools,
    classes: NDArray[np.uint8],
    cell: float,
) -> Floats:
    """Return the estimated error of the surface in each cell, ``(H, W)``, m; it is not an upper bound.

    It is the distance to the nearer of DTM and DSM. The DTM is used where it supports the surface, the DSM on
    cells that the filter kept. The distance to the DSM is at least the scatter of the DSM around the cell,
    which is small on roads and bridge decks and large in tree crowns. Where neither is available, the
    estimate is `AGREE_M` plus the height a road may gain since the nearest supported cell.

    Parameters
    ----------
    off_dsm, off_dtm : (H, W) array
        Surface minus DSM and DTM (m).
    dsm_above_dtm : (H, W) array
        DSM minus DTM (m).
    kept : (H, W) array of bool
        Road cells that the filter kept.
    classes : (H, W) array of uint8
        The cells' `Support`.
    cell : float
        Size of a cell (m).
    """
    scatter = _scatter(
        dsm_above_dtm, kept & np.isfinite(dsm_above_dtm), 2 * max(1, round(SCATTER_M / cell / 2)) + 1
    )
    by_scan = np.where(kept, np.maximum(np.abs(off_dsm), scatter), np.nan)
    inferred = classes == Support.INFERRED
    by_dtm = np.where(inferred, np.nan, np.abs(off_dtm))
    estimate = np.fmin(by_scan, by_dtm)
    if inferred.any():
        away = scipy.ndimage.distance_transform_edt(inferred) * cell
        estimate[inferred] = AGREE_M + rise(away[inferred])
    return estimate


def _scatter(values: Floats, valid: Bools, size: int) -> Floats:
    """Return the standard deviation of the valid values in a square around each cell; 0 if there are none."""
    share = np.maximum(scipy.ndimage.uniform_filter(valid.astype(np.float64), size), 1e-9)
    values = np.where(valid, values, 0.0)
    mean, square = (
        scipy.ndimage.uniform_filter(values, size) / share,
        scipy.ndimage.uniform_filter(values**2, size) / share,
    )
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)))


def _second_differences(height: Floats, on_road: Bools) -> Floats:
    """Return absolute second differences along rows and columns of three road cells each, ``(n,)``, m."""
    parts = []
    for z, road in ((height, on_road), (height.T, on_road.T)):
        second_difference = z[2:] - 2 * z[1:-1] + z[:-2]
        parts.append(np.abs(second_difference[road[2:] & road[1:-1] & road[:-2]]))
    return _finite(np.concatenate(parts))


def _edge_steps(height: Floats, on_road: Bools) -> Floats:
    """Return the distance of each first cell beside the road to the line of the last two on it, ``(n,)``."""
    parts = []
    for z, road in ((height, on_road), (height.T, on_road.T)):
        for profile, road_profile in ((z, road), (z[::-1], road[::-1])):
            step = profile[2:] - 2 * profile[1:-1] + profile[:-2]
            parts.append(np.abs(step[~road_profile[2:] & road_profile[1:-1] & road_profile[:-2]]))
    return _finite(np.concatenate(parts))


def _largest_patch(cells: Bools) -> int:
    """Return the number of cells in the largest connected patch."""
    patches, _ = scipy.ndimage.label(cells)
    return int(np.bincount(patches[cells], minlength=1).max())


def _share_at_bound(surface: Surface) -> float:
    if not isinstance(surface, NurbsSurface):
        return float("nan")
    return mean(np.abs(np.log(surface.W)) > MAX_LOG_WEIGHT * (1 - 1e-9))


def _finite(values: Floats) -> Floats:
    return values[np.isfinite(values)]


def _largest(values: Floats) -> float:
    return float(values.max()) if values.size else float("nan")


def _quantile(values: Floats, percent: float) -> float:
    return float(np.percentile(values, percent)) if values.size else float("nan")
