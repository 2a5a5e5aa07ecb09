"""Fit a NURBS surface to road and terrain (the paper's step C, section "Surface Fitting").

Adam optimises the heights and weights of a fixed grid of control points under the loss of
`tasks.spline.objective`, starting from the DTM. The surface is defined in `tasks.spline.surface`, or with
``plan: moving`` in `tasks.spline.moving`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from flexroad.tasks.options import Options as BaseOptions
from flexroad.tasks.roads.dtm_validity import valid_dtm
from flexroad.tasks.roads.road_height import with_road_heights
from flexroad.tasks.spline import adam
from flexroad.tasks.spline.moving import WEIGHTS, MovingNurbs, loss_by_variables, moving
from flexroad.tasks.spline.objective import Objective, objective
from flexroad.tasks.spline.space import (
    Space,
    check_cells,
    clamped_space,
    points_at_spacing,
    start_heights,
    surface_on,
)
from flexroad.tasks.spline.surface import MAX_LOG_WEIGHT, NurbsSurface
from flexroad.tasks.types import Bools, Floats, RoadClusters, TileData

VERSION = 1


class Options(BaseOptions):
    """Options of the NURBS fit; the defaults are the paper's."""

    method: Literal["nurbs"] = "nurbs"
    degree: int = Field(3, ge=1, le=10, description="degree of the basis along easting and northing, p = q")
    control_points: tuple[int, int] = Field(
        (35, 35), description="number of control points along easting and along northing"
    )
    spacing_m: float | None = Field(
        None, gt=0, description="distance of control points (m); if given, control_points is ignored"
    )
    lambda_terrain: float = Field(1.0, ge=0, description="weight of the terrain term")
    lambda_reg: float = Field(
        0.01, ge=0, description="weight of the control points' height differences (1/m)"
    )
    terrain: bool = Field(
        True,
        description="false: no DTM support, which means no terrain term, and a start from the plane through "
        "the road. A tile without roads gets the plane through the DTM",
    )
    plan: Literal["fixed", "moving", "uniform"] = Field(
        "fixed",
        description="fixed: a graph over easting and northing; moving: x and y move with the weights, to "
        "compare with the paper. uniform: like moving, with control points at equal distances",
    )
    weights: Literal["free", "unit", "softplus", "unbounded"] = Field(
        "free",
        description="free: weights are optimised between 1/10 and 10; unit: all are 1; softplus: positive, "
        "without bounds; unbounded: of any sign",
    )
    start: Literal["dtm", "level"] = Field(
        "dtm", description="dtm: start from the DTM; level: from its mean height"
    )
    result: Literal["best", "last"] = Field("best", description="step of the fit that is its result")
    learning_rate: float = Field(
        0.1, gt=0, description="learning rate of Adam (m for heights, no unit for ln w)"
    )
    iterations: int = Field(200, ge=0, description="largest number of Adam steps")
    engine: Literal["numba", "torch"] = Field("numba", description="library that computes the gradient")
    device: str = Field(
        "cpu", pattern=r"^(cpu|cuda(:\d+)?)$", description="cpu; with torch also cuda, cuda:1"
    )

    @model_validator(mode="after")
    def _check_consistent(self) -> Options:
        if self.spacing_m is None and min(self.control_points) <= self.degree:
            n, m = self.control_points
            raise ValueError(f"degree {self.degree} needs more control points each way than {n} x {m}")
        if self.engine == "numba" and self.device != "cpu":
            raise ValueError(f"device {self.device} needs engine torch; numba runs on the cpu")
        if self.engine == "torch" and (self.weights in ("softplus", "unbounded") or self.result == "last"):
            raise ValueError("weights softplus and unbounded, and result last, need engine numba")
        if self.weights == "unbounded" and self.plan == "fixed":
            raise ValueError("weights unbounded may be negative, which needs plan moving or uniform")
        return self


def fit(data: TileData, clusters: RoadClusters, options: Options) -> NurbsSurface | MovingNurbs:
    """Fit the surface to the DSM on filtered road cells and to the valid DTM elsewhere.

    Raises
    ------
    TaskError
        If there are fewer cells with a height than control points, if neither the DTM nor the road has a
        height to start from, or if the device is not available.
    """
    data = with_road_heights(data, clusters)
    data = replace(data, dtm=valid_dtm(data, clusters))
    space = space_of(data, options)
    start, datum = start_heights(data.dsm, data.dtm, clusters.mask, space, options.terrain)
    loss = objective_of(data, clusters.mask, space, datum, options)
    z, weights = (start - datum) * (options.start == "dtm"), np.ones_like(start)
    # Without terrain term and road, only the regulariser is left. It would flatten the plane of the start.
    if options.terrain or (clusters.mask & np.isfinite(data.dsm)).any():
        z, weights = _adam(loss, z, options)
    surface = surface_on(space, data.grid, data.grid.hull, weights * z, weights, datum)
    return surface if options.plan == "fixed" else moving(surface, options.plan == "uniform")


def space_of(data: TileData, options: Options) -> Space:
    """Return the splines over a tile."""
    points = options.control_points
    if options.spacing_m is not None:
        points = points_at_spacing(data.grid, options.degree, options.spacing_m)
    return clamped_space(data.grid, options.degree, points)


def objective_of(data: TileData, road: Bools, space: Space, datum: float, options: Options) -> Objective:
    """Return the loss function of a tile."""
    heights = np.where(road, data.dsm, data.dtm) - datum
    check_cells(heights, space.points)
    factor = np.where(road, 1.0, options.lambda_terrain if options.terrain else 0.0)
    return objective(heights, factor, space, options.lambda_reg, options.weights == "free")


def _adam(loss: Objective, start: Floats, options: Options) -> tuple[Floats, Floats]:
    """Return the optimised control heights above the datum (m) and the weights."""
    steps, last = (options.learning_rate, options.iterations), options.result == "last"
    if weights := WEIGHTS.get(options.weights):
        one, value, _ = weights
        variables = np.stack([start, np.full_like(start, one)])
        (z, s), _ = adam.minimise(
            loss_by_variables(loss, weights), variables, np.array(math.inf), *steps, last
        )
        return z, value(s)
    variables = np.stack([start, np.zeros_like(start)])
    limit = np.array([math.inf, MAX_LOG_WEIGHT])[:, None, None]
    if options.engine == "torch":
        (z, rho), _ = adam.minimise_with_torch(loss, variables, limit, *steps, options.device)
    else:
        (z, rho), _ = adam.minimise(loss, variables, limit, *steps, last)
    return z, np.exp(rho)
