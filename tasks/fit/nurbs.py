"""Fit a NURBS surface to road and terrain (the paper's step C, section "Surface Fitting").

The heights and weights of a fixed grid of control points, from the DTM. The paper's way is Adam on
`tasks.spline.objective`; with unit weights the problem is convex and `tasks.spline.irls` solves it. The
surface is `tasks.spline.surface`. docs/fit.md compares the choices.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.ndimage import distance_transform_edt, map_coordinates

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.metrics.plane_lstsq import least_squares_plane
from flexroad.tasks.options import Options as BaseOptions
from flexroad.tasks.roads.dtm_validity import without_unsound
from flexroad.tasks.spline import adam, irls, torch_engine
from flexroad.tasks.spline.cross_validation import stiffest
from flexroad.tasks.spline.objective import Objective, objective
from flexroad.tasks.spline.surface import MAX_LOG_WEIGHT, NurbsSurface, clamped_knots, greville
from flexroad.tasks.spline.thin_plate import plate
from flexroad.tasks.types import Bools, Floats, RoadClusters, TileData

VERSION = 1

Space = tuple[Floats, Floats, tuple[int, int]]
"""Knots along easting and northing, degrees along both."""


class Options(BaseOptions):
    """How the surface is fitted; the defaults are the paper's."""

    method: Literal["nurbs"] = "nurbs"
    degree: int = Field(3, ge=1, le=10, description="degree of the basis along easting and northing, p = q")
    control_points: tuple[int, int] = Field(
        (35, 35), description="number of control points along easting and along northing"
    )
    spacing_m: float | None = Field(
        None, gt=0, description="distance of control points (m); if given, in place of control_points"
    )
    lambda_terrain: float = Field(1.0, ge=0, description="weight of the terrain term")
    lambda_reg: float = Field(
        0.01, ge=0, description="weight of the control points' height differences (1/m)"
    )
    terrain: bool = Field(
        True,
        description="false: no DTM support; the terrain term is off and the start a plane through the road",
    )
    weights: Literal["free", "unit"] = Field(
        "free", description="free: weights are optimised between 1/10 and 10; unit: all are 1"
    )
    solver: Literal["adam", "irls"] = Field(
        "adam", description="irls: reweighted least squares, for unit weights; takes neither rate nor window"
    )
    huber_m: float = Field(
        0.0, ge=0, description="differences below it (m) count by their square, for irls; 0 is L1"
    )
    smoothness: Literal["range", "bending"] = Field(
        "range",
        description="range: lambda_reg on the control points; bending: the mean squared curvature, for irls",
    )
    bending_m3: float | Literal["auto"] = Field(
        100.0,
        description="weight of the road's squared curvature (m3); auto: by generalised cross-validation, "
        "for masks without spoilers",
    )
    bending_terrain: float = Field(
        0.02, gt=0, le=1000, description="the terrain's weight as a part of the road's"
    )
    learning_rate: float = Field(0.1, gt=0, description="Adam's step, m for heights, 1 for ln w")
    iterations: int = Field(200, ge=0, description="most Adam steps")
    stop_tolerance: float = Field(1e-4, ge=0, description="stop when the loss changes by less than this part")
    stop_window: int = Field(20, ge=1, description="steps over which that change is taken")
    engine: Literal["numba", "torch"] = Field("numba", description="what computes the gradient")
    device: str = Field(
        "cpu", pattern=r"^(cpu|cuda(:\d+)?)$", description="cpu; with torch also cuda, cuda:1"
    )

    @model_validator(mode="after")
    def _enough_control_points(self) -> Options:
        if self.spacing_m is None and min(self.control_points) <= self.degree:
            n, m = self.control_points
            raise ValueError(f"degree {self.degree} needs more control points each way than {n} x {m}")
        if self.engine == "numba" and self.device != "cpu":
            raise ValueError(f"device {self.device} needs engine torch; numba runs on the cpu")
        return self

    @model_validator(mode="after")
    def _what_the_solver_can(self) -> Options:
        if self.solver == "irls":
            if self.weights == "free" or self.engine == "torch" or not self.iterations:
                raise ValueError("solver irls needs weights unit, engine numba and at least one iteration")
        elif self.smoothness == "bending" or self.huber_m:
            raise ValueError("smoothness bending and huber_m need solver irls")
        if self.smoothness == "bending" and self.degree < 2:
            raise ValueError("smoothness bending needs degree 2 or more: planes between lines do not bend")
        if self.bending_m3 != "auto" and self.bending_m3 <= 0:
            raise ValueError(f"bending_m3 {self.bending_m3} must be above 0, or auto")
        return self


def fit(data: TileData, clusters: RoadClusters, options: Options) -> NurbsSurface:
    """Fit the surface to the DSM on filtered road cells and to the DTM elsewhere, where that is sound.

    Raises
    ------
    TaskError
        If there are fewer cells with a height than control points, if there is nothing to start from, or if
        the device is not there.
    """
    data, space = without_unsound(data, clusters), spline_space(data.grid, options)
    start, datum = start_heights(data, clusters.mask, space, options.terrain)
    loss = objective_of(data, clusters.mask, space, datum, options)
    if options.solver == "irls":
        z = _irls(data, clusters.mask, loss, start - datum, space, options)
        weights = np.ones_like(z)
    else:
        z, weights = _adam(loss, start - datum, options)
    east, north = data.grid.origin
    return NurbsSurface(
        crs=data.grid.crs,
        bounds=data.grid.hull,
        degree=space[2],
        knots_u=space[0],
        knots_v=space[1],
        A=weights * z,
        W=weights,
        datum=datum,
        origin=(float(east), float(north)),
    )


def _adam(loss: Objective, start: Floats, options: Options) -> tuple[Floats, Floats]:
    """Return control heights above the datum (m) and weights."""
    variables = np.stack([start, np.zeros_like(start)])
    limit = np.array([math.inf, MAX_LOG_WEIGHT])[:, None, None]
    schedule = adam.Schedule(
        options.learning_rate, options.iterations, options.stop_tolerance, options.stop_window
    )
    if options.engine == "torch":
        (z, rho), _ = torch_engine.minimise(loss, variables, limit, schedule, options.device)
    else:
        (z, rho), _ = adam.minimise(loss, variables, limit, schedule)
    return z, np.exp(rho)


def _irls(
    data: TileData, road: Bools, loss: Objective, start: Floats, space: Space, options: Options
) -> Floats:
    """Return control heights above the datum (m)."""
    flat = irls.Convex(loss, start.shape, options.huber_m)

    def solved(convex: irls.Convex, start: Floats) -> irls.Solution:
        return irls.minimise(convex, start, options.iterations, options.stop_tolerance)

    if options.smoothness == "range":
        return solved(flat, start).z
    west, south, east, north = data.grid.hull
    # Per cell that has a height, like the differences: voids do not make the rest of the tile softer.
    stiffness = np.where(road, 1.0, options.bending_terrain) / _cells(data, road)
    unit = plate(stiffness, space, (east - west, north - south))
    if options.bending_m3 == "auto":
        return stiffest(flat, unit, start, road, solved).z
    return solved(replace(flat, plate=unit.times(options.bending_m3)), start).z


def spline_space(grid: Grid, options: Options) -> Space:
    """Return the knots and degrees of the surface over a grid's hull.

    Raises
    ------
    TaskError
        If the grid is a single row or column, or has fewer cells than there would be control points.
    """
    if min(grid.shape) < 2:
        raise TaskError(f"a surface needs at least 2 x 2 cells, not {grid.width} x {grid.height}")
    n, m = options.control_points
    if options.spacing_m is not None:
        west, south, east, north = grid.hull
        n, m = (
            max(options.degree + 1, round(span / options.spacing_m) + 1)
            for span in (east - west, north - south)
        )
    # Before anything is allocated: a spacing in the wrong unit would ask for more than there is memory.
    if n * m > grid.width * grid.height:
        raise TaskError(_too_few(f"{grid.width} x {grid.height} cells", n, m))
    p = options.degree
    return clamped_knots(n, p), clamped_knots(m, p), (p, p)


def _too_few(cells: str, n: int, m: int) -> str:
    return f"{cells} are fewer than {n} x {m} control points; lower fit.control_points or raise fit.spacing_m"


def objective_of(data: TileData, road: Bools, space: Space, datum: float, options: Options) -> Objective:
    """Return the loss for this tile.

    Raises
    ------
    TaskError
        If fewer cells have a height than there are control points.
    """
    heights, cells = np.where(road, data.dsm, data.dtm), _cells(data, road)
    n, m = (len(knots) - options.degree - 1 for knots in space[:2])
    if cells < n * m:
        raise TaskError(_too_few(f"{cells} cells with a height", n, m))
    terrain = options.lambda_terrain if options.terrain else 0.0
    factor = np.where(road, 1.0, terrain)
    lambda_reg = options.lambda_reg if options.smoothness == "range" else 0.0
    return objective(heights - datum, factor, space, lambda_reg, options.weights == "free")


def _cells(data: TileData, road: Bools) -> int:
    """Return the number of cells that have a height to fit."""
    return int(np.count_nonzero(np.isfinite(np.where(road, data.dsm, data.dtm))))


def start_heights(data: TileData, road: Bools, space: Space, terrain: bool) -> tuple[Floats, float]:
    """Return the control heights to start from, ``(m, n)`` with row 0 in the south, and their mean (m).

    The DTM at the Greville abscissae; without DTM support the least-squares plane through the road, for the
    DTM may not leak in through the start.

    Raises
    ------
    TaskError
        If there is no height to start from.
    """
    u, v = (greville(knots, degree) for knots, degree in zip(space[:2], space[2], strict=True))
    cols, rows = u * (data.grid.width - 1), (1 - v) * (data.grid.height - 1)
    if terrain and np.isfinite(data.dtm).any():
        heights = map_coordinates(_nearest_filled(data.dtm), np.meshgrid(rows, cols, indexing="ij"), order=1)
    else:
        r, c = np.nonzero(road & np.isfinite(data.dsm))
        if not len(r):
            dtm = "empty too" if terrain else "not to be used (fit.terrain)"
            raise TaskError(f"no filtered road cell has a DSM height to start from, and the DTM is {dtm}")
        level, by_col, by_row = least_squares_plane(c.astype(float), r.astype(float), data.dsm[r, c])
        heights = level + by_col * cols[None, :] + by_row * rows[:, None]
    return heights, float(heights.mean())


def _nearest_filled(heights: Floats) -> Floats:
    missing = ~np.isfinite(heights)
    if not missing.any():
        return heights
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])
