"""NURBS surfaces whose plan moves with the weights: the paper's S(u, v) in space (Eq. nurbs), as it stands.

Control points have fixed places in plan. With weights that differ, the point S(u, v) is not at the place that
belongs to (u, v): x and y are rational splines like the height. The fit compares heights with the rasters at
(u, v), as the paper's R^S does, and takes no notice of the place of S(u, v). The mesh has its vertices there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.tasks.spline.objective import Objective
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Floats, Surface

DECIMALS = 6
"""Decimals of a metre that places are rounded to: what lies on the tile's edge stays exactly on it."""


@dataclass(frozen=True, eq=False)
class MovingNurbs(Surface):
    """A NURBS in space, where places stand for their parameters (u, v).

    `height` at a place is that of S(u, v), where u and v are affine in the place: a value of the paper's R^S,
    not the height of the surface above the place. `moved` says where S(u, v) is in plan.
    """

    crs: str
    bounds: Bounds
    """The domain: west, south, east, north (m)."""
    degree: tuple[int, int]
    """Degree along u and v."""
    knots_u: Floats
    knots_v: Floats
    A: Floats
    """Weight times height above the datum, ``(m, n)``, m; row 0 in the south."""
    W: Floats
    """Weights, ``(m, n)``."""
    X: Floats
    """Weight times easting of the control points from the origin, ``(m, n)``, m."""
    Y: Floats
    """Weight times northing of the control points from the origin, ``(m, n)``, m."""
    datum: float
    """Height that heights in ``A`` are relative to (m)."""
    origin: tuple[float, float]
    """Whole-metre (easting, northing) that ``X`` and ``Y`` are relative to."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return the heights (m) of S at the parameters of scattered places."""
        return self._graph.height(easting, northing)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return the heights (m) of S at the parameters of every pair, ``(northings, eastings)``."""
        return self._graph.lattice(eastings, northings)

    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals of the heights over the parameters at scattered places, ``(..., 3)``."""
        return self._graph.normal(easting, northing)

    def moved(self, easting: Floats, northing: Floats) -> tuple[Floats, Floats]:
        """Return easting and northing (m from the origin) of S at the parameters of scattered places."""
        x, y = (replace(self._graph, A=xw, datum=0.0).height(easting, northing) for xw in (self.X, self.Y))
        return x.round(DECIMALS), y.round(DECIMALS)

    @property
    def _graph(self) -> NurbsSurface:
        return NurbsSurface(
            self.crs, self.bounds, self.degree, self.knots_u, self.knots_v, self.A, self.W, self.datum,
            self.origin,
        )  # fmt: skip


def moving(surface: NurbsSurface, uniform: bool = False) -> MovingNurbs:
    """Return a surface with the same control heights and weights whose control points stay where they are.

    - `uniform`: whether the control points have equal distances in plan; else they are at the Greville
      abscissae, where S(u, v) with unit weights is at the place of (u, v).
    """
    west, south, east, north = surface.bounds
    x, y = surface.control_points[..., 0], surface.control_points[..., 1]
    if uniform:
        m, n = surface.W.shape
        x, y = np.meshgrid(np.linspace(west, east, n), np.linspace(south, north, m))
    (east_0, north_0), w = surface.origin, surface.W
    return MovingNurbs(
        surface.crs, surface.bounds, surface.degree, surface.knots_u, surface.knots_v, surface.A, w,
        w * (x - east_0), w * (y - north_0), surface.datum, surface.origin,
    )  # fmt: skip


Weights = tuple[float, Callable[[Floats], Floats], Callable[[Floats], Floats]]
"""Weights without bounds by the variables of the fit: the variable of weight 1, the weights, their slopes."""
WEIGHTS: dict[str, Weights] = {
    "softplus": (
        math.log(math.e - 1), lambda s: np.logaddexp(0.0, s), lambda s: np.exp(-np.logaddexp(0.0, -s)),
    ),
    "unbounded": (1.0, np.asarray, np.ones_like),
}  # fmt: skip
"""By the names of the option ``weights``."""


def loss_by_variables(objective: Objective, weights: Weights) -> Callable[[Floats], tuple[float, Floats]]:
    """Return the loss (m) and its gradient as a function of heights and variables, ``(2, m, n)``."""
    _, value, slope = weights

    def at(variables: Floats) -> tuple[float, Floats]:
        loss, by_z, by_w = objective.by_weight(variables[0], value(variables[1]))
        return loss, np.stack([by_z, by_w * slope(variables[1])])

    return at
