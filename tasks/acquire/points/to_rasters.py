"""Rasters from a point cloud: DSM and its top layer, DTM, bridge decks and orthophoto of a block of ground.

Values depend only on the points within `reach_m` of the block, not on the division into blocks or on the
order of the points; heights agree to 1e-8 m, the rounding error of sums and large coordinates.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.tasks import options as base
from flexroad.tasks.acquire.points import ground_filter as slope_filter
from flexroad.tasks.acquire.points import morphological as morphological_filter
from flexroad.tasks.acquire.points import tin
from flexroad.tasks.acquire.points.binning import Cells, bins, highest, means, spikes, top_layer
from flexroad.tasks.acquire.points.orthophoto import photo
from flexroad.tasks.acquire.types import Points, Rasters, TopLayer
from flexroad.tasks.types import Bools, Floats, Orthophoto

BRIDGE_CLASSES = {"asprs": (17,), "ahn": (26,)}
"""Classes of bridge decks by the scheme of a point cloud: ASPRS LAS 1.4, also in Switzerland, Sweden and
North Rhine-Westphalia; the Dutch AHN, whose class of structures (kunstwerken) also has locks and weirs."""


class Options(base.Options):
    """How points become rasters."""

    despike_m: float | None = Field(
        None,
        gt=0,
        description="drop single points that are this much above all others around (m); null keeps all",
    )
    fill_m: float = Field(5.0, ge=0, le=100, description="DSM voids up to this width are filled (m)")
    top_layer_m: float = Field(
        0.25,
        gt=0,
        le=10,
        description="points up to this much below a cell's highest one make the height of roads (m)",
    )
    ground: Literal["classes", "filter", "morphological"] = Field(
        "classes",
        description="classes: ground points have a ground class; filter: the slope filter identifies them; "
        "morphological: the morphological filter does",
    )
    ground_classes: tuple[int, ...] = Field((2,), description="classes of ground points")
    bridge_classes: tuple[int, ...] = Field(
        BRIDGE_CLASSES["asprs"], description="classes of bridge decks; never ground"
    )
    dtm: Literal["tin", "mean"] = Field(
        "tin",
        description="tin: linear between the cells' ground centroids; mean: mean ground height per cell",
    )
    void_m: float = Field(50.0, ge=0, le=500, description="DTM voids up to this width are filled (m)")
    dop_fill_m: float = Field(
        2.0, ge=0, le=20, description="pixels without colour take the nearest within this distance (m)"
    )
    filter: slope_filter.Options = Field(
        slope_filter.Options(), description="the slope filter, used with ground: filter"
    )
    morphological: morphological_filter.Options = Field(
        morphological_filter.Options(),
        description="the morphological filter, used with ground: morphological",
    )


def rasterise(points: Points, grid: Grid, options: Options, dop_cell: float | None) -> Rasters:
    """Make the rasters of a block of ground.

    Parameters
    ----------
    points : Points
        In the grid's CRS (m), including a rim of `reach_m` around the grid; others have no effect.
    dop_cell : float, optional
        Pixel of the orthophoto (m); None makes no orthophoto.

    Returns
    -------
    Rasters
        NaN without points, and the DTM without ground points; no orthophoto if the points have no colours.
    """
    rim = grid.buffered(reach_m(options, grid.cell))
    inner = rim.window(grid)
    if options.despike_m is not None:
        points = _without_spikes(points, rim, options.despike_m)
    cells = bins(points.easting, points.northing, rim)
    highest_points = highest(cells, points.height, rim.shape)
    top = top_layer(cells, points.height, highest_points, options.top_layer_m, rim.shape)
    decks = np.isin(points.kind, options.bridge_classes)
    (bridges,) = means(cells[decks], rim.shape, points.height[decks])
    ground = _is_ground(points, options) & ~decks
    return Rasters(
        grid,
        dsm=tin.fill_voids(highest_points, rim, options.fill_m)[inner],
        dtm=_dtm(points[ground], rim, options)[inner],
        top=TopLayer(
            tin.fill_voids(top.height, rim, options.fill_m)[inner], top.count[inner], top.spread[inner]
        ),
        ground=_occupied(cells[ground], rim.shape)[inner],
        bridges=bridges[inner] if np.isfinite(bridges[inner]).any() else None,
        photo=_photo(points, grid, options, dop_cell),
    )


def reach_m(options: Options, cell: float) -> float:
    """Return the largest distance from a grid of such cells at which points can change a value in it (m)."""
    if options.dtm == "tin":
        ground = tin.tin_reach_m(options.void_m, cell)
    else:
        ground = tin.voids_reach_m(options.void_m, cell)
    if options.ground == "filter":
        ground += options.filter.reach_m
    if options.ground == "morphological":
        ground += options.morphological.reach_m
    farthest = max(ground, tin.voids_reach_m(options.fill_m, cell), options.dop_fill_m)
    # Whether a point is a spike depends on its own and the neighbouring cells.
    return farthest if options.despike_m is None else farthest + 2 * cell


def tags(options: Options) -> dict[str, str]:
    """Return the processing of each layer, for the TIFF tags of the rasters."""
    spikes = (
        ""
        if options.despike_m is None
        else f"; single points {options.despike_m:g} m above all around dropped"
    )
    if options.ground == "classes":
        ground = f"points of {_classes(options.ground_classes)}"
    elif options.ground == "morphological":
        of = options.morphological
        ground = (
            f"morphologically filtered points (Zhang et al. 2003: radius {of.radius_m:g} m, "
            f"slope {of.slope:g}, tolerance {of.tolerance_m:.2f} m)"
        )
    else:
        ground = (
            f"slope-filtered points (Vosselman 2000: radius {options.filter.radius_m:g} m, "
            f"slope {options.filter.slope:g}, tolerance {options.filter.tolerance_m:.2f} m)"
        )
    kind = "TIN of the cells' centroids" if options.dtm == "tin" else "mean per cell"
    return {
        "DSM": f"highest point per cell{spikes}; voids up to {options.fill_m:g} m filled linearly",
        "DTM": f"{kind} of {ground}; voids up to {options.void_m:g} m bridged linearly",
        "ROAD_HEIGHT": f"mean, number and standard deviation of the points within {options.top_layer_m:g} m "
        f"of the cell's highest{spikes}; voids up to {options.fill_m:g} m filled linearly, with the number 0",
        "BRIDGES": f"mean per cell of points of {_classes(options.bridge_classes)}",
        "DOP": f"colour of the highest point; voids take the nearest within {options.dop_fill_m:g} m",
    }


def _classes(classes: tuple[int, ...]) -> str:
    return f"class{'es' if len(classes) > 1 else ''} {', '.join(map(str, classes))}"


def _without_spikes(points: Points, grid: Grid, despike_m: float) -> Points:
    cells = bins(points.easting, points.northing, grid)
    kept = np.ones(len(points), bool)
    kept[spikes(cells, points.height, grid.shape, despike_m)] = False
    return points[kept]


def _is_ground(points: Points, options: Options) -> Bools:
    if options.ground == "classes":
        return np.isin(points.kind, options.ground_classes)
    if options.ground == "morphological":
        of = options.morphological
        return morphological_filter.ground(points.easting, points.northing, points.height, of)
    return slope_filter.ground(points.easting, points.northing, points.height, options.filter)


def _occupied(cells: Cells, shape: tuple[int, int]) -> Bools:
    """Return the cells that have a point, ``(H, W)``."""
    occupied = np.zeros(shape, bool)
    occupied.flat[cells[cells >= 0]] = True
    return occupied


def _dtm(ground: Points, grid: Grid, options: Options) -> Floats:
    cells = bins(ground.easting, ground.northing, grid)
    if options.dtm == "mean":
        return tin.averaged(cells, ground.height, grid, options.void_m)
    return tin.triangulated(cells, ground.easting, ground.northing, ground.height, grid, options.void_m)


def _photo(points: Points, grid: Grid, options: Options, dop_cell: float | None) -> Orthophoto | None:
    if points.colour is None or dop_cell is None:
        return None
    return photo(points, Grid.covering(grid.crs, grid.bounds, dop_cell), options.dop_fill_m)
