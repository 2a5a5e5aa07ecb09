"""NURBS surfaces whose plan moves with the weights: the paper's S(u, v) in space (Eq. nurbs), unchanged.

Control points have fixed places in plan. If weights differ, the point S(u, v) is not at the place of (u, v):
x and y are rational splines like the height. The fit compares heights with the rasters at (u, v), like the
paper's R^S, and ignores the place of S(u, v). The mesh has its vertices at S(u, v).
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
"""Decimals (of a metre) to which places are rounded: points on the tile's edge stay exactly on it."""


@dataclass(frozen=True, eq=False)
class MovingNurbs(Surface):
    """A NURBS in space; its arguments are places that mean parameters (u, v).

    `height` at a place is the height of S(u, v), where u and v are affine in the place. It is a value of the
    paper's R^S, not the height of the surface above the place. `moved` returns the place of S(u, v) in plan.
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
    """Datum of the heights in ``A`` (m)."""
    origin: tuple[float, float]
    """Origin of ``X`` and ``Y``: whole-metre (easting, northing)."""

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
    """Return a surface with the same control heights and weights and fixed control points in plan.

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
"""Unbounded weights as functions of the fit's variables: the variable of weight 1, weights, slopes."""
WEIGHTS: dict[str, Weights] = {
    "softplus": (
        math.log(math.e - 1), lambda s: np.logaddexp(0.0, s), lambda s: np.exp(-np.logaddexp(0.0, -s)),
    ),
    "unbounded": (1.0, np.asarray, np.ones_like),
}  # fmt: skip
"""`Weights` by the value of the option ``weights``."""


def loss_by_variables(objective: Objective, weights: Weights) -> Callable[[Floats], tuple[float, Floats]]:
    """Return the loss (m) and its gradient as a function of heights and variables, ``(2, m, n)``."""
    _, value, slope = weights

    def at(variables: Floats) -> tuple[float, Floats]:
        loss, by_z, by_w = objective.by_weight(variables[0], value(variables[1]))
        return loss, np.stack([by_z, by_w * slope(variables[1])])

    return at
