"""Rasters from a point cloud: DSM and its top layer, DTM, bridge decks and orthophoto of a block of ground.

Values depend only on the points near the block (`points_reach_m` + `cells_reach_m`), not on the division into
blocks or the order of the points. Heights agree within 1e-8 m, the rounding of sums and large coordinates.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.tasks import options as base
from flexroad.tasks.types import Bools, Floats, Orthophoto
from flexroad.tools.prepare.points import ground_filter as slope_filter
from flexroad.tools.prepare.points import morphological as morphological_filter
from flexroad.tools.prepare.points import tin
from flexroad.tools.prepare.points.binning import (
    Points,
    bins,
    highest,
    means,
    photo,
    spikes,
    top_layer,
)

BRIDGE_CLASSES = {"asprs": (17,), "ahn": (26,)}
"""Classes of bridge decks by the scheme of a point cloud: ASPRS LAS 1.4, also in Switzerland, Sweden and
North Rhine-Westphalia; the Dutch AHN, whose class of structures (kunstwerken) also has locks and weirs."""


CELL_LAYERS = (
    *("highest point (m)", "top layer: mean height (m)", "number of points", "spread (m)"),
    *("ground: easting from the grid's west (m)", "northing from its north (m)", "height (m)"),
    "bridge decks: mean height (m)",
)
"""Values of each cell from its own points; NaN without points."""
GROUND = "ground"
"""Layer of the cells with ground points, for the refinement of a mesh's DTM; it is not published."""


class Options(base.Options):
    """How points become rasters."""

    despike_m: float | None = Field(
        None,
        gt=0,
        description="drop single points that are this much above all points around them (m); null keeps all",
    )
    fill_m: float = Field(5.0, ge=0, le=100, description="DSM voids up to this width are filled (m)")
    top_layer_m: float = Field(
        0.25,
        gt=0,
        le=10,
        description="points up to this much below a cell's highest point make the height of roads (m)",
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


def of_points(
    points: Points, grid: Grid, options: Options, pixels: Grid | None
) -> tuple[Floats, Orthophoto | None]:
    """Return the values of each cell (`CELL_LAYERS`), ``(8, H, W)``, and the orthophoto.

    - `points`: points in the grid's CRS (m), including a rim of `points_reach_m` around the grid.
    - `pixels`: pixels of the orthophoto; None: no orthophoto.
    - result: no orthophoto if the points have no colours.
    """
    if options.despike_m is not None:
        rim = grid.buffered(points_reach_m(options, grid.cell))
        cells = bins(points.easting, points.northing, rim)
        kept = np.ones(len(points), bool)
        kept[spikes(cells, points.height, rim.shape, options.despike_m)] = False
        points = points[kept]
    cells = bins(points.easting, points.northing, grid)
    highest_points = highest(cells, points.height, grid.shape)
    top = top_layer(cells, points.height, highest_points, options.top_layer_m, grid.shape)
    decks = _has_class(points, options.bridge_classes)
    (bridges,) = means(np.where(decks, cells, -1), grid.shape, points.height)
    ground = _is_ground(points, cells >= 0, options) & ~decks
    of_ground = means(
        np.where(ground, cells, -1),
        grid.shape,
        points.easting - grid.west,
        points.northing - grid.north,
        points.height,
    )
    image = photo(points, pixels, options.dop_fill_m) if pixels and points.colour is not None else None
    return np.stack([highest_points, *top, *of_ground, bridges]), image


def of_cells(cells: Floats, rim: Grid, grid: Grid, options: Options) -> dict[str, Floats | Bools]:
    """Return the rasters of a block of ground by layer: heights (m; NaN where unknown), and `GROUND`.

    ``road_height`` has three bands, ``(3, H, W)``: where a void is filled, the number of points is 0. Without
    decks there is no layer ``bridges``.

    - `cells`: `CELL_LAYERS` on the cells of ``rim``: the grid and `cells_reach_m` around it.
    """
    inner = rim.window(grid)
    highest, top, ground, bridges = cells[0], cells[1:4], cells[4:7], cells[7][inner]
    dsm, road_height = tin.fill_voids(np.stack([highest, top[0]]), rim, options.fill_m)
    if options.dtm == "mean":
        dtm = tin.fill_voids(ground[2], rim, options.void_m)
    else:
        dtm = tin.triangulated(ground, rim, options.void_m, inner)
    layers: dict[str, Floats | Bools] = {"dsm": dsm[inner], "dtm": dtm[inner]}
    layers["road_height"] = np.stack([road_height[inner], top[1][inner], top[2][inner]])
    if np.isfinite(bridges).any():
        layers["bridges"] = bridges
    layers[GROUND] = np.isfinite(ground[2][inner])
    return layers


def points_reach_m(options: Options, cell: float) -> float:
    """Return the largest distance at which points can change the result of `of_points` (m)."""
    farthest = options.dop_fill_m
    if options.ground == "filter":
        farthest = max(farthest, options.filter.reach_m)
    if options.ground == "morphological":
        farthest = max(farthest, options.morphological.reach_m)
    # Whether a point is a spike depends on its cell and the neighbouring cells.
    return farthest if options.despike_m is None else farthest + 2 * cell


def cells_reach_m(options: Options, cell: float) -> float:
    """Return the largest distance at which cells can change the result of `of_cells` (m)."""
    reach = tin.tin_reach_m if options.dtm == "tin" else tin.voids_reach_m
    return max(reach(options.void_m, cell), tin.voids_reach_m(options.fill_m, cell))


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


def _is_ground(points: Points, asked: Bools, options: Options) -> Bools:
    """Return which of the requested points are ground, ``(n,)``."""
    if options.ground == "classes":
        return _has_class(points, options.ground_classes)
    if options.ground == "morphological":
        of = options.morphological
        return morphological_filter.ground(points.easting, points.northing, points.height, of)
    return slope_filter.ground(points.easting, points.northing, points.height, options.filter, asked)


def _has_class(points: Points, classes: tuple[int, ...]) -> Bools:
    """Return which points have one of some classes, ``(n,)``."""
    chosen = np.isin(np.arange(256), classes)
    return chosen[points.kind]
