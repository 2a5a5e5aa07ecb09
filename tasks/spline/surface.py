"""NURBS surfaces over a tile (the paper's step C, section "Surface Fitting", Eqs. nurbs and cox_de_boor).

The surface is a graph: easting is affine in u, northing in v, and the height is the rational spline ``z(u, v)
= datum + A(u, v) / W(u, v)`` with the coefficients ``A = weight * (height - datum)`` and ``W = weight``.
Coefficient arrays are ``(m, n)``. Row i belongs to the i-th basis function along v, so **row 0 is in the
south** (rasters have row 0 in the north). Column j belongs to the j-th function along u, from west to east.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats, Surface

Starts = NDArray[np.intp]
SplineOf = Callable[..., Floats]
"""The spline of coefficients at given places; with ``du=1`` or ``dv=1`` its first derivative along u or v."""

KEPT = 16
"""Number of axes whose basis functions are kept: tiles, corners and edges have few different axes."""

MAX_LOG_WEIGHT = math.log(10)
"""Bound on abs(ln w). Unbounded weights became negative on real streets, which gives the surface poles."""


def clamped_knots(points: int, degree: int) -> Floats:
    """Return uniform knots on [0, 1] with ``degree + 1`` equal knots per end, ``(points + degree + 1,)``."""
    if not 1 <= degree < points:
        raise ValueError(f"degree {degree} needs at least {degree + 1} control points, not {points}")
    inner = np.linspace(0.0, 1.0, points - degree + 1)
    return np.concatenate([np.zeros(degree), inner, np.ones(degree)])


def uniform_knots(first: int, last: int, degree: int) -> Floats:
    """Return the whole numbers from ``first - degree`` to ``last + degree``: uniform knots of [first, last].

    At each whole number of the domain ``degree`` basis functions are not zero. Their values do not depend on
    the domain, to the last bit: differences of whole numbers are exact.
    """
    return np.arange(first - degree, last + degree + 1, dtype=np.float64)


def domain(knots: Floats, degree: int) -> tuple[float, float]:
    """Return the first and the last parameter at which all basis functions add up to 1."""
    return float(knots[degree]), float(knots[-degree - 1])


def greville(knots: Floats, degree: int) -> Floats:
    """Return the Greville abscissae, ``(points,)``: control heights there reproduce any linear function."""
    windows = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree)
    return np.asarray(windows.mean(axis=1))


def basis(knots: Floats, degree: int, u: Floats) -> tuple[Starts, Floats, Floats]:
    """Evaluate the ``degree + 1`` basis functions that are not zero at each ``u`` (Eq. cox_de_boor).

    - `u` ``(N,)``: parameters in the domain. A knot belongs to the span on its right, the last to the span on
      its left.
    - `start` ``(N,)``: index of the first function that is not zero.
    - `values`, `slopes` ``(N, degree + 1)``: the functions ``start ... start + degree`` and their first
      derivatives by u.
    """
    u = np.asarray(u, dtype=np.float64)[:, None]
    last = len(knots) - degree - 2
    span = np.clip(np.searchsorted(knots, u, side="right") - 1, degree, last)
    values = share = np.ones((len(u), 1))
    for k in range(1, degree + 1):
        # Each function of degree k - 1 adds a rising part to a function of degree k, and a falling part to
        # its left neighbour. Its support contains the span, which is not empty, so the divisor is positive.
        i = span + np.arange(1 - k, 1)
        left, right = knots[i], knots[i + k]
        share = values / (right - left)
        values = _pair((u - left) * share, (right - u) * share)
    return span[:, 0] - degree, values, _pair(degree * share, -degree * share)


@lru_cache(maxsize=KEPT)
def kept_basis(knots: bytes, degree: int, u: bytes) -> tuple[Starts, Floats]:
    """Return first functions and values of `basis`, kept for the next call: they must not be changed."""
    start, values, _ = basis(np.frombuffer(knots), degree, np.frombuffer(u))
    return start, values


def _pair(rising: Floats, falling: Floats) -> Floats:
    """Return ``(N, k + 1)``: the rising parts one column to the right, plus the falling parts."""
    out = np.zeros((rising.shape[0], rising.shape[1] + 1))
    out[:, 1:] = rising
    out[:, :-1] += falling
    return out


def basis_matrix(knots: Floats, degree: int, u: Floats) -> tuple[Floats, Floats]:
    """Return all basis functions at each ``u`` and their first derivatives, both ``(N, points)``."""
    start, values, slopes = basis(knots, degree, u)
    return dense(start, values, len(knots) - degree - 1), dense(start, slopes, len(knots) - degree - 1)


def dense(start: Starts, values: Floats, points: int) -> Floats:
    """Spread the values of `basis` over all functions, ``(N, points)``."""
    matrix = np.zeros((len(start), points))
    np.put_along_axis(matrix, start[:, None] + np.arange(values.shape[1]), values, axis=1)
    return matrix


@dataclass(frozen=True, eq=False)
class NurbsSurface(Surface):
    """A NURBS height field over a rectangle (Eq. nurbs).

    Beyond its domain it is extrapolated linearly: first-order Taylor expansion about the nearest domain
    point.
    """

    crs: str
    bounds: Bounds
    """The domain: west, south, east, north (m)."""
    degree: tuple[int, int]
    """Degree along easting (the paper's p) and along northing (q)."""
    knots_u: Floats
    """Knots along easting, ``(n + p + 1,)``; the domain is from the p-th to the n-th."""
    knots_v: Floats
    """Knots along northing, ``(m + q + 1,)``; the domain is from the q-th to the m-th."""
    A: Floats
    """Weight times height above the datum, ``(m, n)``, m; row 0 in the south."""
    W: Floats
    """Weights, ``(m, n)``, positive; row 0 in the south."""
    datum: float
    """Datum of the heights in ``A`` (m)."""
    origin: tuple[float, float]
    """Origin of exported coordinates: whole-metre (easting, northing) near the south-west."""

    def height(self, easting: Floats, northing: Floats) -> Floats:
        """Return heights (m) at scattered points, in their broadcast shape."""
        shape, (u, v) = self._scattered(easting, northing)
        inside_u, inside_v = self._clipped(u, v)
        return self._height(self._at_points(inside_u, inside_v), u - inside_u, v - inside_v).reshape(shape)

    def lattice(self, eastings: Floats, northings: Floats) -> Floats:
        """Return heights (m) at every pair, ``(len(northings), len(eastings))``."""
        if np.isnan(self.A).any():
            # A surface over several tiles may lack a tile: sums over all points would then be NaN everywhere.
            return NurbsSurface.height(self, np.asarray(eastings), np.asarray(northings)[:, None])
        u, v = self._parameters(eastings, northings)
        inside_u, inside_v = self._clipped(u, v)
        along_u = basis_matrix(self.knots_u, self.degree[0], inside_u)
        along_v = basis_matrix(self.knots_v, self.degree[1], inside_v)

        def spline(coefficients: Floats, du: int = 0, dv: int = 0) -> Floats:
            return np.asarray(along_v[dv] @ coefficients @ along_u[du].T)

        return self._height(spline, (u - inside_u)[None, :], (v - inside_v)[:, None])

    def slope(self, easting: Floats, northing: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of the height by easting and by northing (m/m) at scattered points.

        Beyond the domain, the derivatives at the nearest domain point are returned.
        """
        shape, (u, v) = self._scattered(easting, northing)
        _, by_u, by_v = self._taylor(self._at_points(*self._clipped(u, v)))
        west, south, east, north = self.bounds
        (low_u, high_u), (low_v, high_v) = self._domain
        by_easting = by_u * (high_u - low_u) / (east - west)
        return by_easting.reshape(shape), (by_v * (high_v - low_v) / (north - south)).reshape(shape)

    def normal(self, easting: Floats, northing: Floats) -> Floats:
        """Return upward unit normals at scattered points, ``(..., 3)``; see `slope` beyond the domain."""
        by_easting, by_northing = self.slope(easting, northing)
        normals = np.stack([-by_easting, -by_northing, np.ones_like(by_easting)], axis=-1)
        return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))

    @property
    def control_points(self) -> Floats:
        """Control points at the Greville abscissae, ``(m, n, 4)``: easting, northing, height (m), weight.

        With unit weights these are the control points of the surface. With other weights they are not,
        because the position of a point in plan depends on the weights: use `exact` to export the surface.
        """
        west, south, east, north = self.bounds
        (low_u, high_u), (low_v, high_v) = self._domain
        u, v = greville(self.knots_u, self.degree[0]), greville(self.knots_v, self.degree[1])
        x = west + (u - low_u) * (east - west) / (high_u - low_u)
        y = south + (v - low_v) * (north - south) / (high_v - low_v)
        return np.stack([*np.meshgrid(x, y), self.A / self.W + self.datum, self.W], axis=-1)

    @property
    def _domain(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """First and last parameter along u, and along v."""
        return domain(self.knots_u, self.degree[0]), domain(self.knots_v, self.degree[1])

    def _parameters(self, easting: Floats, northing: Floats) -> tuple[Floats, Floats]:
        west, south, east, north = self.bounds
        (low_u, high_u), (low_v, high_v) = self._domain
        # The product is computed before the division: the edges of a tile are then exactly on their knots.
        u = low_u + (np.asarray(easting) - west) * (high_u - low_u) / (east - west)
        return u, low_v + (np.asarray(northing) - south) * (high_v - low_v) / (north - south)

    def _clipped(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Return the parameters of the nearest points of the domain."""
        domain_u, domain_v = self._domain
        return np.clip(u, *domain_u), np.clip(v, *domain_v)

    def _scattered(self, easting: Floats, northing: Floats) -> tuple[tuple[int, ...], tuple[Floats, Floats]]:
        u, v = np.broadcast_arrays(*self._parameters(easting, northing))
        return u.shape, (u.ravel(), v.ravel())

    def _at_points(self, u: Floats, v: Floats) -> SplineOf:
        start_u, *along_u = basis(self.knots_u, self.degree[0], u)
        start_v, *along_v = basis(self.knots_v, self.degree[1], v)

        def spline(coefficients: Floats, du: int = 0, dv: int = 0) -> Floats:
            out = np.empty(len(start_u))
            _contract(start_u, along_u[du], start_v, along_v[dv], coefficients, out)
            return out

        return spline

    def _height(self, spline: SplineOf, beyond_u: Floats, beyond_v: Floats) -> Floats:
        if not (beyond_u.any() or beyond_v.any()):
            return np.asarray(spline(self.A) / spline(self.W) + self.datum)
        z, by_u, by_v = self._taylor(spline)
        return z + by_u * beyond_u + by_v * beyond_v + self.datum

    def _taylor(self, spline: SplineOf) -> tuple[Floats, Floats, Floats]:
        """Return height above the datum and its derivatives by u and v (quotient rule)."""
        w = spline(self.W)
        z = spline(self.A) / w
        by_u = (spline(self.A, du=1) - z * spline(self.W, du=1)) / w
        by_v = (spline(self.A, dv=1) - z * spline(self.W, dv=1)) / w
        return z, by_u, by_v


@compiled()
def _contract(
    start_u: Starts, along_u: Floats, start_v: Starts, along_v: Floats, coefficients: Floats, out: Floats
) -> None:
    for k in range(out.size):
        total = 0.0
        for i in range(along_v.shape[1]):
            row = 0.0
            for j in range(along_u.shape[1]):
                row += along_u[k, j] * coefficients[start_v[k] + i, start_u[k] + j]
            total += along_v[k, i] * row
        out[k] = total


@dataclass(frozen=True, eq=False)
class ExactNurbs:
    """A surface as a NURBS with control points in space, the form that other programs read."""

    degree: tuple[int, int]
    """Degree along u (easting) and v (northing)."""
    knots_u: Floats
    knots_v: Floats
    points: Floats
    """Control points, ``(m', n', 4)``: x, y (m from `origin`), z (height, m), weight; row 0 in the south."""
    origin: tuple[float, float]
    """Origin of x and y: whole-metre (easting, northing)."""


def exact(surface: NurbsSurface) -> ExactNurbs:
    """Return the surface as an ordinary NURBS; the conversion is exact.

    Plan coordinates are affine in the parameters, so ``x * W`` and ``y * W`` have one degree more than
    ``W`` and the same smoothness: with ``A`` and ``W`` they lie in the spline space of degree p + 1 with
    every inner knot doubled (35 -> 67 points for p = 3). Degree elevation is a convex combination, so
    weights stay positive.
    """
    west, south, east, north = surface.bounds
    p, q = surface.degree
    knots_u, raise_u, times_u = _raised(surface.knots_u, p)
    knots_v, raise_v, times_v = _raised(surface.knots_v, q)
    w = raise_v @ surface.W @ raise_u.T
    x = west - surface.origin[0] + (east - west) * (raise_v @ surface.W @ times_u.T) / w
    y = south - surface.origin[1] + (north - south) * (times_v @ surface.W @ raise_u.T) / w
    z = surface.datum + raise_v @ surface.A @ raise_u.T / w
    return ExactNurbs((p + 1, q + 1), knots_u, knots_v, np.stack([x, y, z, w], axis=-1), surface.origin)


def _raised(knots: Floats, degree: int) -> tuple[Floats, Floats, Floats]:
    """Return knots of the space one degree up, and the maps of f and of t * f into it, ``(points', points)``.

    t runs from 0 to 1 over the domain. Both products lie in that space, so interpolating them at its Greville
    abscissae is exact. The knots are clamped, as other programs expect them, on [0, 1].
    """
    low, high = domain(knots, degree)
    inner = knots[(knots > low) & (knots < high)]
    ends = [np.full(degree + 2, low), np.full(degree + 2, high)]
    raised = np.sort(np.concatenate([inner, np.unique(inner), *ends]))
    u = greville(raised, degree + 1)
    collocation, _ = basis_matrix(raised, degree + 1, u)
    f, _ = basis_matrix(knots, degree, u)
    t = (u - low) / (high - low)
    return (raised - low) / (high - low), _solve(collocation, f), _solve(collocation, t[:, None] * f)


def _solve(matrix: Floats, values: Floats) -> Floats:
    return np.asarray(np.linalg.solve(matrix, values), dtype=np.float64)
