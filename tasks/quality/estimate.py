"""Estimated error of a surface, cell by cell, from the residuals of its fit.

Noise of single cells averages out in a smooth surface. The misfit of larger pieces of ground remains, so
residuals are first averaged over squares. If a surface misses the heights around a place, it also misses
heights there that were not measured. The two constants were chosen on squares of 5 m that were withheld from
DSM and DTM of eight places: 90% of the squares are within the interval (docs/quality.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.tasks.levels.abutments import TUNNEL_M
from flexroad.tasks.levels.seen import hidden, level_data, off_ground, with_approaches
from flexroad.tasks.quality.height_source import HeightSource, height_source
from flexroad.tasks.roads.distances import distances, filled
from flexroad.tasks.roads.dtm_validity import DSM_DTM_TOLERANCE_M, ground_to_fit, rise
from flexroad.tasks.roads.flat_patches import CLIMB
from flexroad.tasks.roads.road_height import with_road_heights
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Bools, Floats, RoadClusters, RoadMask, Surface, TileData

SQUARE_M, AROUND_M = 5.0, 9.0
"""Sides of the squares over which residuals, and then their absolute values, are averaged (m)."""
LEAST_M, FACTOR = 0.0075, 1.8
"""The estimate of a surface without residuals (m), and its growth with the residuals."""
INTERVAL = 2.06
"""Half width of the 90% interval over the mean absolute error, for a normal distribution."""
MIN_SHARE = 0.2
"""Smallest share of cells with a residual in a square that is used."""
SCATTER_M = 5.0
"""Side of the square over which the scatter of the DSM is computed (m); smaller than a tree crown."""
CLIMB_M = 3.0
"""Least width of ground steeper than `CLIMB` (m): objects are wider, and the edge of a deck is narrower."""


def error_estimate(
    residual: Floats,
    off_dtm: Floats,
    scatter: Floats,
    kept: Bools,
    road: Bools,
    cell: float,
    only_road: bool = False,
) -> Floats:
    """Return the estimated mean absolute error of the surface around each cell, ``(H, W)``, m.

    It grows with the residuals of cells of the same class (road or not) around. Away from known heights it
    grows by the possible rise of a road since the nearest known height. On kept cells it is at least the
    smaller of the DSM's scatter and the distance to the DTM: a tree crown that the filter kept has both, a
    bridge deck only the distance. Without any height it is `DSM_DTM_TOLERANCE_M`.

    - `residual`: surface minus the fitted height (m); NaN where no height was used.
    - `off_dtm`: surface minus DTM (m).
    - `scatter`: the cells' `scatter` (m).
    - `kept`: road cells that the filter kept.
    - `road`: road cells.
    - `cell`: size of a cell (m).
    - `only_road`: leave the cells beside the road NaN, which halves the time.
    """
    estimate = np.full(residual.shape, np.nan)
    for cells in (road,) if only_road else (road, ~road):
        estimate[cells] = _unexplained(residual, cells, cell)[cells]
    return np.where(kept, np.fmax(estimate, np.fmin(scatter, np.abs(off_dtm))), estimate)


def deviation(off_dsm: Floats, off_dtm: Floats, scatter: Floats, kept: Bools, inferred: Bools) -> Floats:
    """Return the distance of the surface to the nearer of DSM and DTM in each cell, ``(H, W)``, m.

    The DSM is used on kept cells, at least with its `scatter`, and the DTM where it supports the surface. The
    distance is NaN where neither is used.
    """
    by_scan = np.where(kept, np.maximum(np.abs(off_dsm), scatter), np.nan)
    by_dtm = np.where(inferred, np.nan, np.abs(off_dtm))
    return np.fmin(by_scan, by_dtm)


def scatter(dsm: Floats, dtm: Floats, kept: Bools, cell: float) -> Floats:
    """Return the standard deviation of DSM minus DTM on kept cells around each cell, ``(H, W)``, m.

    The deviation of the DSM alone is used where it is smaller: a deck is smooth above a steep bank. It is
    small on roads and decks and large in tree crowns; 0 where no kept cell is near.
    """
    valid, size = kept & np.isfinite(dsm - dtm), _width(SCATTER_M, cell)
    share = _share_around(valid, size)
    # Heights are relative to a height nearby, because squares of heights above the sea lose digits.
    level = float(np.mean(dsm[valid])) if valid.any() else 0.0
    deviations = []
    for heights in (dsm - dtm, dsm - level):
        mean, square = (_mean_around(own, valid, share, size) for own in (heights, heights**2))
        deviations.append(np.sqrt(np.maximum(square - mean**2, 0.0)))
    return np.fmin(*deviations)


def climbed(smooth: Floats, dtm: Floats, kept: Bools, cell: float, dsm_dtm_tolerance_m: float) -> Bools:
    """Return the kept cells where the surface climbs an object, and kept cells inside them, ``(H, W)``.

    The surface is off the DTM there, and steeper than a road, both in itself and relative to the DTM: a deck
    is level above a steep bank, and a street on a hill is as steep as the DTM.

    - `smooth`, `dtm`: heights of the surface without steps, and of the terrain (m).
    - `kept`: road cells that the filter kept.
    - `cell`: size of a cell (m).
    """
    steep = kept & (np.abs(smooth - dtm) > dsm_dtm_tolerance_m)
    if steep.any():
        for heights in (smooth, smooth - dtm):
            slope = scipy.ndimage.generic_gradient_magnitude(heights, scipy.ndimage.sobel) / (8 * cell)
            steep &= slope > CLIMB
    wide = scipy.ndimage.binary_opening(steep, np.ones((_width(CLIMB_M, cell),) * 2))
    return np.asarray(scipy.ndimage.binary_fill_holes(wide) & kept)


def _unexplained(residual: Floats, cells: Bools, cell: float) -> Floats:
    """Return the estimate from the residuals of some cells around each cell, ``(H, W)``, m."""
    valid = cells & np.isfinite(residual)
    # A cell that is farther off than heights of the same ground is a car or a crown. Larger differences have
    # little weight in the loss of the fit, too.
    same_ground = np.clip(residual, -DSM_DTM_TOLERANCE_M, DSM_DTM_TOLERANCE_M)
    square, around = _width(SQUARE_M, cell), _width(AROUND_M, cell)
    share = _share_around(valid, square)
    misfit = np.abs(_mean_around(same_ground, valid, share, square))
    counted = valid & (share >= MIN_SHARE)
    share = _share_around(counted, around)
    misfit = _mean_around(misfit, counted, share, around)
    if not (share > 0).any():
        return np.full(residual.shape, DSM_DTM_TOLERANCE_M)
    estimate = filled(np.where(share > 0, LEAST_M + FACTOR * misfit, np.nan), cells)
    away = cells & ~valid
    estimate[away] += rise(distances(away, valid) * cell)
    return estimate


def _share_around(valid: Bools, size: int) -> Floats:
    """Return the share of valid cells in a square around each cell, ``(H, W)``."""
    share = scipy.ndimage.uniform_filter(valid.astype(np.float64), size)
    # Less than half a cell is a rounding error of the filter.
    return np.where(share * size**2 > 0.5, share, 0.0)


def _mean_around(values: Floats, valid: Bools, share: Floats, size: int) -> Floats:
    """Return the mean of the valid values in a square around each cell, given their share of the square."""
    total = scipy.ndimage.uniform_filter(np.where(valid, values, 0.0), size)
    return np.asarray(total / np.where(share > 0, share, 1.0))


def _width(side_m: float, cell: float) -> int:
    """Return the odd number of cells that is nearest to a length."""
    return 2 * max(1, round(side_m / cell / 2)) + 1


@dataclass(frozen=True, eq=False)
class Compared:
    """A surface beside DSM and DTM in the cells of a tile's core; arrays are ``(H, W)``."""

    on_road: Bools
    """Road cells of the raw mask within the survey."""
    kept: Bools
    """Road cells that the filter kept and that have a DSM height."""
    classes: NDArray[np.uint8]
    """The cells' `HeightSource`."""
    height: Floats
    """Height of the surface (m)."""
    smooth: Floats
    """Height of the surface without the steps of the ground beside roads (m)."""
    off_dsm: Floats
    """Surface minus the heights to which it was fitted on the road, elsewhere minus DSM (m)."""
    excess: Floats
    """DSM minus the heights to which the road was fitted (m)."""
    off_dtm: Floats
    """Surface minus DTM (m)."""
    deviation: Floats
    """Distance to the nearer of DSM and DTM (m), by `quality.estimate.deviation`; the estimated error of
    inferred cells."""
    estimate: Floats
    """Estimated error of the surface (m), by `quality.estimate.error_estimate`; at least the distance to the
    DTM on objects that it climbs, and the deviation where that exceeds ``dsm_dtm_tolerance_m``."""
    goes_on: Bools
    """Cells of level 0 below decks or above tunnels: a road that ends there at an abutment continues."""
    lacking: Bools
    """Inferred road cells. Cells below decks near road with a height (half of `TUNNEL_M`) are left out: a
    deck that hides the street below it is not a fault of the data."""


def compare(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    surface: Surface,
    dsm_dtm_tolerance_m: float,
    only_road: bool = False,
) -> Compared:
    """Compare a surface with DSM and DTM cell by cell; with levels, level 0 with the heights that it sees.

    - `data`, `road`, `clusters`, `surface`: as in `tasks.quality.assess.assess`.
    - `only_road`: leave the estimated error NaN beside the road; that takes less time.
    """
    data, clusters = level_data(data, clusters), with_approaches(clusters)
    window = data.grid.window(data.core)
    fitted = with_road_heights(data, clusters)
    own = clusters
    if isinstance(surface, SteppedSurface) and own.beside is not None and own.dtm_invalid is not None:
        # The DTM is valid where the surface has a step up to it.
        invalid = own.dtm_invalid.copy()
        invalid[window] &= ~own.beside[window]
        own = replace(own, dtm_invalid=invalid)
    every = height_source(data, road, own, dsm_dtm_tolerance_m)
    classes, below = every[window], hidden(road.levels, clusters.number, data.grid)
    on_road = road.mask[window] & (classes != HeightSource.NONE)
    kept = on_road & clusters.mask[window] & np.isfinite(data.dsm[window])
    height = surface.lattice(data.core.eastings, data.core.northings)
    smooth = height - surface.steps if isinstance(surface, SteppedSurface) else height
    off_dsm, off_dtm = height - fitted.dsm[window], height - data.dtm[window]
    spread = scatter(fitted.dsm[window], data.dtm[window], kept, data.core.cell)
    residual = height - ground_to_fit(fitted, clusters, window)
    residual[classes == HeightSource.NONE] = np.nan
    estimate = error_estimate(residual, off_dtm, spread, kept, on_road, data.core.cell, only_road)
    inferred = classes == HeightSource.INFERRED
    away = deviation(off_dsm, off_dtm, spread, kept, inferred)
    on_object = climbed(smooth, data.dtm[window], kept, data.core.cell, dsm_dtm_tolerance_m)
    # Within `dsm_dtm_tolerance_m` DSM and DTM show the same ground, and residuals are a better estimate.
    least = np.where(
        on_object, np.abs(off_dtm), np.where(on_road & (away > dsm_dtm_tolerance_m), away, np.nan)
    )
    estimate = np.fmax(estimate, least)
    distance = np.where(inferred, estimate, away)
    excess = (data.dsm - fitted.dsm)[window]
    return Compared(
        on_road, kept, classes, height, smooth, off_dsm, excess, off_dtm, distance, estimate,
        goes_on=off_ground(road.levels if clusters.level is None else (), data.grid)[window],
        lacking=on_road & _lacking(road.mask, every, below, data.grid.cell)[window],
    )  # fmt: skip


def _lacking(road: Bools, classes: NDArray[np.uint8], below: Bools, cell: float) -> Bools:
    """Return the inferred road cells that no deck explains, ``(H, W)``; see `Compared.lacking`."""
    lacking = road & (classes == HeightSource.INFERRED)
    by_deck = lacking & below
    if by_deck.any():
        known = road & ((classes == HeightSource.MEASURED) | (classes == HeightSource.DTM))
        lacking[by_deck] = distances(by_deck, known) * cell > TUNNEL_M / 2
    return np.asarray(lacking)
