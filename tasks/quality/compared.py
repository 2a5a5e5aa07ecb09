"""A surface beside the heights of its tile, cell by cell."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.quality.estimate import deviation, error_estimate, scatter
from flexroad.tasks.quality.support import Support, support
from flexroad.tasks.roads.dtm_validity import without_invalid_dtm
from flexroad.tasks.roads.road_height import with_road_heights
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, Surface, TileData


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
    smooth: Floats
    """The same without the steps of the ground beside roads (m)."""
    off_dsm: Floats
    """Surface minus the heights that it was fitted to on the road, elsewhere minus DSM (m)."""
    excess: Floats
    """DSM minus the heights that the road was fitted to (m)."""
    off_dtm: Floats
    """Surface minus DTM (m)."""
    deviation: Floats
    """Distance to the nearer of DSM and DTM (m), by `quality.estimate.deviation`; the estimated error of
    inferred cells."""
    estimate: Floats
    """Estimated error of the surface (m), by `quality.estimate.error_estimate`."""


def compare(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    surface: Surface,
    agree_m: float,
    only_road: bool = False,
) -> Compared:
    """Compare a surface with DSM and DTM cell by cell.

    Parameters
    ----------
    data, road, clusters, surface
        As in `tasks.quality.assess.assess`.
    agree_m : float
        Largest difference between two heights of the same ground (m).
    only_road : bool
        Leave the estimated error NaN beside the road; that takes less time.
    """
    window = data.grid.window(data.core)
    fitted = with_road_heights(data, clusters)
    classes = support(data, road, _with_ground(clusters, surface, data), agree_m)[window]
    on_road = road.mask[window] & (classes != Support.NONE)
    kept = on_road & clusters.mask[window] & np.isfinite(data.dsm[window])
    height = surface.lattice(data.core.eastings, data.core.northings)
    smooth = height - surface.steps if isinstance(surface, SteppedSurface) else height
    off_dsm, off_dtm = height - fitted.dsm[window], height - data.dtm[window]
    spread = scatter((fitted.dsm - data.dtm)[window], kept, data.core.cell)
    residual = height - _heights(fitted, clusters)[window]
    residual[classes == Support.NONE] = np.nan
    estimate = error_estimate(residual, off_dtm, spread, kept, on_road, data.core.cell, only_road)
    inferred = classes == Support.INFERRED
    distance = np.where(inferred, estimate, deviation(off_dsm, off_dtm, spread, kept, inferred))
    excess = (data.dsm - fitted.dsm)[window]
    return Compared(on_road, kept, classes, height, smooth, off_dsm, excess, off_dtm, distance, estimate)


def _with_ground(clusters: RoadClusters, surface: Surface, data: TileData) -> RoadClusters:
    """Return the clusters with the DTM valid where the surface has a step up to it."""
    if not isinstance(surface, SteppedSurface) or clusters.beside is None or clusters.dtm_invalid is None:
        return clusters
    stepped = np.zeros(data.grid.shape, np.bool_)
    stepped[data.grid.window(data.core)] = clusters.beside[data.grid.window(data.core)]
    return replace(clusters, dtm_invalid=clusters.dtm_invalid & ~stepped)


def heights_fitted(data: TileData, clusters: RoadClusters) -> Floats:
    """Return the heights of a fit, ``(H, W)``, m; NaN where none enters.

    They are those of `with_road_heights` on kept road cells, else the valid DTM.
    """
    return _heights(with_road_heights(data, clusters), clusters)


def _heights(fitted: TileData, clusters: RoadClusters) -> Floats:
    return np.where(clusters.mask, fitted.dsm, without_invalid_dtm(fitted, clusters).dtm)
