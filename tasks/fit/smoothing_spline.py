"""Fit a smoothing spline to road and terrain: step C in production.

The surface is the NURBS graph of `tasks.spline.surface` with unit weights. It minimises Huber's function of
the height differences plus the bending energy of a thin plate that is stiffer on roads than beside them. The
problem is convex; `tasks.spline.irls` solves it. docs/fit.md compares it with the paper's fit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from flexroad.tasks.options import Options as BaseOptions
from flexroad.tasks.types import RoadClusters, TileData

if TYPE_CHECKING:
    from flexroad.tasks.spline.surface import NurbsSurface

VERSION = 1


class Options(BaseOptions):
    """Stiffness of the surface and weights of its data; the defaults are production's (docs/fit.md)."""

    method: Literal["smoothing_spline"] = "smoothing_spline"
    degree: int = Field(3, ge=2, le=10, description="degree of the basis along easting and northing")
    spacing_m: float = Field(3.6, gt=0, description="distance of control points (m)")
    lambda_terrain: float = Field(0.3, ge=0, description="weight of the terrain's height differences")
    huber_m: float = Field(
        0.1, ge=0, description="differences below this (m) are squared, larger ones count linearly; 0 is L1"
    )
    bending_m3: float = Field(30.0, gt=0, description="weight of the road's squared curvature (m3)")
    bending_terrain: float = Field(
        0.02, gt=0, le=1000, description="weight of the terrain's squared curvature, as a share of the road's"
    )
    iterations: int = Field(200, ge=1, description="largest number of steps of reweighted least squares")
    stop_tolerance: float = Field(
        1e-4, ge=0, description="stop when the relative decrease of the loss is below this"
    )


def fit(data: TileData, clusters: RoadClusters, options: Options) -> NurbsSurface:
    """Fit the surface to the DSM on filtered road cells and to the valid DTM elsewhere.

    Raises
    ------
    TaskError
        If there are fewer cells with a height than control points, or if neither the DTM nor the road has a
        height to start from.
    """
    from flexroad.tasks.roads.dtm_validity import without_invalid_dtm
    from flexroad.tasks.spline import space
    from flexroad.tasks.spline.irls import HuberObjective, minimise
    from flexroad.tasks.spline.objective import objective
    from flexroad.tasks.spline.surface import NurbsSurface
    from flexroad.tasks.spline.thin_plate import bending_energy

    data, road = without_invalid_dtm(data, clusters), clusters.mask
    points = space.points_at_spacing(data.grid, options.degree, options.spacing_m)
    knots = space.spline_space(data.grid, options.degree, points)
    start, datum = space.start_heights(data, road, knots)
    cells = space.cells_with_height(data, road, points)
    heights = np.where(road, data.dsm, data.dtm) - datum
    loss = objective(heights, np.where(road, 1.0, options.lambda_terrain), knots)
    west, south, east, north = data.grid.hull
    # Divided by the number of cells with a height, like the differences, so that voids do not change the
    # balance.
    stiffness = options.bending_m3 * (np.where(road, 1.0, options.bending_terrain) / cells)
    bending = bending_energy(stiffness, knots, (east - west, north - south))
    convex = HuberObjective(loss, start.shape, options.huber_m, bending)
    z = minimise(convex, start - datum, options.iterations, options.stop_tolerance).z
    return NurbsSurface.over(data.grid, knots, z, np.ones_like(z), datum)
