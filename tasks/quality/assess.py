"""Assess a tile's surface without ground truth: figures, flags and a map of its height sources.

All figures are over the raw segmented mask, where the surface is used as road. The error estimate is computed
from the residuals of the fit (`quality.estimate`); tiles with the largest estimate should be checked first. A
local fault appears as a patch of road that is far from both DSM and DTM.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.levels.abutments import lack_abutment
from flexroad.tasks.levels.seen import level_data, level_road
from flexroad.tasks.metrics.evaluate import mean, nmad, percentile
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.quality.flagged import bends, edge_steps, flagged_cells, largest_patch, worst_piece
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.quality.holdout import Refit, holdout
from flexroad.tasks.roads.dtm_validity import DSM_DTM_TOLERANCE_M
from flexroad.tasks.spline.surface import MAX_LOG_WEIGHT, NurbsSurface
from flexroad.tasks.types import (
    Floats,
    Quality,
    RoadClusters,
    RoadMask,
    Structures,
    Surface,
    TileData,
)

VERSION = 6

FLAGS = {
    "error-estimate": "error_estimate_m",
    "worst-error": "worst_error_estimate_m",
    "patch": "max_unexplained_area_m2",
    "spike": "curvature_per_m",
    "edge-step": "edge_step_m",
    "loose": "residual_p95_m",
    "off-dtm": "off_dtm_road",
    "inferred": "inferred_road",
    "dropped": "dropped_road",
    "weights": "bounded_weights",
}
"""Figure of each flag."""
LIMITS = {
    "error-estimate": 0.1,  # m
    "worst-error": 0.5,  # m; good roads have at most 0.32
    "patch": 50.0,  # m2
    "spike": 0.2,  # 1/m; a speed hump has less
    "edge-step": 0.15,  # m; higher than a kerb
    "loose": 0.5,  # m
    "off-dtm": 0.1,  # from here on: shares of the road
    "inferred": 0.05,
    "dropped": 0.5,
    "weights": 0.25,  # share of the NURBS weights
}
"""Threshold of each flag. The flag is raised if its figure is larger."""
NO_ROAD = "no-road"
"""The flag of a tile without road: its mask is empty, or the filter dropped the complete road. With an empty
mask it is the only flag."""
BELOW, NO_RISE, NO_ABUTMENT = "below", "no-rise", "no-abutment"
STRUCTURE_FLAGS = (BELOW, NO_RISE, NO_ABUTMENT)
"""Flags of decks and tunnels, which their tile has as well."""
MOST_CROSSED = 0.01
"""Largest share of a deck below level 0 without a flag."""
LEAST_RISE_M = 0.3
"""Least median clearance without a flag (m)."""
FROM_ABUTMENTS_M = 2.0
"""Within this distance of an abutment (m) both levels have nearly the same height."""


class Options(base.Options):
    """Tolerance between two heights of the same ground, and the check of the error estimate."""

    dsm_dtm_tolerance_m: float = Field(
        DSM_DTM_TOLERANCE_M, gt=0, description="largest difference between two heights of the same ground (m)"
    )
    holdout: float = Field(
        0.0,
        ge=0,
        le=0.5,
        description="share of the road's squares of 5 m that a second fit leaves out, to check the error "
        "estimate there; 0: no second fit",
    )


def assess(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    surface: Surface,
    options: Options,
    refit: Refit | None = None,
) -> Quality:
    """Assess a surface by the data to which it was fitted.

    Parameters
    ----------
    data : TileData
        DSM and DTM, m; the reference and its road mask are not used.
    road : RoadMask
        The raw mask and the cells beyond the survey.
    clusters : RoadClusters
        The road cells that the filter kept.
    options : Options
        Tolerance, and the share of the road that is withheld.
    refit : callable, optional
        Fits other data of the tile in the same way as the surface; needed if a share is withheld.

    Returns
    -------
    Quality
        Figures over the road cells of the core; NaN where the tile or the surface has no such data. With
        levels, they are figures of level 0, and of each other level on its decks or tunnels, without a second
        fit. Flags of decks and tunnels are also flags of level 0.
    """
    own = _assess(data, road, clusters, surface, options, refit)
    others = []
    for of_level in clusters.levels:
        number = of_level.number
        if number not in surface.numbers:
            continue
        seen, there = level_data(data, clusters, number), level_road(road, number)
        quality = _assess(seen, there, of_level, surface.at(number), options)
        found, flags = structures(road, surface, number)
        # A level without decks on the tile gets no flags: no road is lost there.
        own_flags = (*quality.flags, *flags) if found else ()
        height_source = _hidden(quality.height_source) if number < 0 else quality.height_source
        others.append(
            (number, replace(quality, structures=found, flags=own_flags, height_source=height_source))
        )
    raised = {flag for _, quality in others for flag in quality.flags}
    flags = (*own.flags, *(flag for flag in STRUCTURE_FLAGS if flag in raised))
    return replace(own, flags=flags, levels=tuple(others))


def _assess(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    surface: Surface,
    options: Options,
    refit: Refit | None = None,
) -> Quality:
    """Return the figures of one level."""
    cells = compare(data, road, clusters, surface, options.dsm_dtm_tolerance_m, only_road=True)
    on_road, kept, classes, cell = cells.on_road, cells.kept, cells.classes, data.core.cell
    worst_m, worst = worst_piece(cells.estimate, on_road, data.core)
    unexplained = largest_patch(on_road & (cells.deviation > options.dsm_dtm_tolerance_m))
    residuals, to_dtm = _finite(cells.off_dsm[kept]), _finite(cells.off_dtm[on_road])
    figures: dict[str, Any] = {
        "residual_median_m": percentile(residuals, 50),
        "residual_nmad_m": nmad(residuals),
        "residual_p95_m": percentile(np.abs(residuals), 95),
        "curvature_per_m": percentile(_finite(bends(cells.height, on_road)) / cell**2, 100),
        "edge_step_m": percentile(_finite(edge_steps(cells)), 95),
        "measured_road": mean(classes[on_road] == HeightSource.MEASURED),
        "dtm_road": mean(classes[on_road] == HeightSource.DTM),
        "inferred_road": mean(classes[on_road] == HeightSource.INFERRED),
        "dropped_road": mean(~kept[on_road]),
        "dsm_excess_m": percentile(_finite(cells.excess[kept]), 50),
        "off_dtm_m": percentile(to_dtm, 50),
        "off_dtm_road": mean(np.abs(to_dtm) > options.dsm_dtm_tolerance_m),
        "bounded_weights": mean(np.abs(np.log(surface.W)) > MAX_LOG_WEIGHT * (1 - 1e-9))
        if isinstance(surface, NurbsSurface)
        else np.nan,
        "error_estimate_m": mean(_finite(cells.estimate[on_road])),
        "worst_error_estimate_m": worst_m,
        "worst_easting": worst[0],
        "worst_northing": worst[1],
        **holdout(data, road, clusters, refit, options.dsm_dtm_tolerance_m, options.holdout),
        "max_unexplained_area_m2": np.count_nonzero(unexplained) * cell**2,
    }
    judged = figures | {"inferred_road": mean(cells.lacking[on_road])}
    flags = [flag for flag, name in FLAGS.items() if judged[name] > LIMITS[flag]]
    if not on_road.any():
        figures["max_unexplained_area_m2"] = float("nan")
        flags = []
    if not kept.any():
        flags = [NO_ROAD, *flags]
    flagged = flagged_cells(cells, cell, LIMITS, options.dsm_dtm_tolerance_m, flags)
    return Quality(**figures, flags=tuple(flags), height_source=classes, flagged=flagged)


def structures(road: RoadMask, surface: Surface, number: int) -> tuple[Structures | None, tuple[str, ...]]:
    """Return the figures and flags of the decks or tunnels of a level; None without any on the core."""
    level = next(level for level in road.levels if level.number == number)
    west, south, east, north = road.core.bounds
    core = shapely.box(west, south, east, north)
    area = shapely.intersection(level.areas, core).area
    if area == 0.0:
        return None, ()
    lines = shapely.get_parts(level.abutments)
    x, y = shapely.get_coordinates(shapely.line_interpolate_point(lines, 0.5, normalized=True)).T
    # Abutments on a border belong to only one of the two tiles.
    abutments = int(np.count_nonzero((west <= x) & (x < east) & (south <= y) & (y < north)))
    window = road.grid.window(road.core)
    rows, cols = np.nonzero(level_road(road, number).mask[window] & ~road.outside[window])
    x, y = road.core.eastings[cols], road.core.northings[rows]
    rise = np.sign(number) * (surface.at(number).height(x, y) - surface.height(x, y))
    # The distance is NaN without abutments.
    inner = rise[~(shapely.distance(level.abutments, shapely.points(x, y)) < FROM_ABUTMENTS_M)]
    found = Structures(
        float(area),
        abutments,
        float(np.median(rise)) if rise.size else float("nan"),
        float(np.mean(inner < 0)) if inner.size else 0.0,
    )
    alone = lack_abutment(shapely.get_parts(level.areas), level.abutments, road.grid, road.core).any()
    raised = (found.crossed > MOST_CROSSED, found.clearance_m < LEAST_RISE_M, alone)
    return found, tuple(flag for flag, is_raised in zip(STRUCTURE_FLAGS, raised, strict=True) if is_raised)


def cell_errors(
    data: TileData,
    road: RoadMask,
    clusters: RoadClusters,
    surface: Surface,
    options: Options,
    number: int = 0,
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the estimated error (m) and the `HeightSource` of each cell of the core, ``(H, W)``.

    If the tile does not have the level, level 0 is used. The estimate is NaN beyond the survey, and beyond
    decks and tunnels.
    """
    own = [own for own in clusters.levels if own.number == number and number in surface.numbers]
    if own:
        data, road, surface = level_data(data, clusters, number), level_road(road, number), surface.at(number)
        clusters = own[0]
    cells = compare(data, road, clusters, surface, options.dsm_dtm_tolerance_m)
    classes = _hidden(cells.classes) if number < 0 else cells.classes
    return np.where(classes == HeightSource.NONE, np.nan, cells.estimate), classes


def _hidden(classes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the height source in tunnels, where no height is measured."""
    return np.where(classes == HeightSource.NONE, classes, np.uint8(HeightSource.INFERRED))


def top_errors(
    data: TileData, road: RoadMask, clusters: RoadClusters, surface: Surface, options: Options
) -> tuple[Floats, NDArray[np.uint8]]:
    """Return `cell_errors` of the highest level in each cell."""
    estimate, classes = cell_errors(data, road, clusters, surface, options)
    top = surface.top(*np.meshgrid(data.core.eastings, data.core.northings))
    for number in (of_level.number for of_level in clusters.levels):
        here = (top == number) & (number > 0)
        if here.any():
            own = cell_errors(data, road, clusters, surface, options, number)
            estimate, classes = np.where(here, own[0], estimate), np.where(here, own[1], classes)
    return estimate, classes


def _finite(values: Floats) -> Floats:
    return values[np.isfinite(values)]
