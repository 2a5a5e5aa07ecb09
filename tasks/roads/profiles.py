"""Elevation and superelevation along a reference line, as OpenDRIVE has them, and what they cannot describe.

At each point of the line the cross-section of the carriageway becomes a straight line. Its height and its
slope become cubic splines along the road. What a road has beside that (crown, ruts, kerbs, bumps) is missed;
`profile_error` says by how much. OpenCRG has it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.roads.height_grid import HeightGrid
from flexroad.tasks.types import Bools, Floats


class Options(base.Options):
    """Detail of the profiles."""

    knot_m: float = Field(5.0, ge=1, le=500, description="length of a cubic piece of the profiles (m)")


@dataclass(frozen=True, eq=False)
class Profiles:
    """Cubic splines over the length along the curve, `ReferenceLine.s`."""

    elevation: scipy.interpolate.PPoly
    """Height on the line (m)."""
    superelevation: scipy.interpolate.PPoly
    """Slope across the road (radians), positive where the left side is higher."""


@dataclass(frozen=True)
class ProfileError:
    """How far elevation and superelevation alone miss the surface on the carriageway (m)."""

    mean_m: float
    max_m: float


def profiles(grid: HeightGrid, options: Options) -> Profiles:
    """Return the profiles that fit the heights of the carriageway by least squares.

    Cross-sections with less than two heights do not count; what is between their neighbours is used.
    """
    inside = _carriageway(grid)
    height, slope = _straight(np.where(inside, grid.heights, 0.0), grid.v, inside)
    s = grid.line.s
    return Profiles(_spline(s, height, options.knot_m), _spline(s, np.arctan(slope), options.knot_m))


def profile_error(grid: HeightGrid, profiles: Profiles) -> ProfileError:
    """Return the error of profiles against the heights of the carriageway; NaN if it has none."""
    s = grid.line.s[:, None]
    fitted = profiles.elevation(s) + grid.v * np.tan(profiles.superelevation(s))
    missed = np.abs(fitted - grid.heights)[_carriageway(grid)]
    if not len(missed):
        return ProfileError(np.nan, np.nan)
    return ProfileError(float(missed.mean()), float(missed.max()))


def _carriageway(grid: HeightGrid) -> Bools:
    beyond = np.abs(grid.v) - grid.line.width[:, None] / 2
    return np.asarray((beyond < 1e-6) & np.isfinite(grid.heights))


def _straight(heights: Floats, v: Floats, inside: Bools) -> tuple[Floats, Floats]:
    """Return height at v = 0 and slope of the line that fits each row; 0 heights where not inside."""
    count = inside.sum(axis=1)
    known = count > 1
    mean_v = (inside * v).sum(axis=1)[known] / count[known]
    mean_z = heights.sum(axis=1)[known] / count[known]
    away = (v - mean_v[:, None]) * inside[known]
    slope = (away * heights[known]).sum(axis=1) / (away**2).sum(axis=1)
    rows = np.arange(len(heights))
    at = rows[known]
    if not len(at):
        return np.zeros(len(rows)), np.zeros(len(rows))
    return np.interp(rows, at, mean_z - slope * mean_v), np.interp(rows, at, slope)


def _spline(s: Floats, values: Floats, knot_m: float) -> scipy.interpolate.PPoly:
    """Return the cubic spline with pieces of about ``knot_m`` that fits values by least squares."""
    # With at least two values a piece the fit is unique.
    pieces = max(1, min(round(s[-1] / knot_m), (len(s) - 1) // 2 - 3))
    knots = np.concatenate([[s[0]] * 3, np.linspace(s[0], s[-1], pieces + 1), [s[-1]] * 3])
    whole = scipy.interpolate.PPoly.from_spline(scipy.interpolate.make_lsq_spline(s, values, knots, 3))
    # The repeated knots at the ends have given pieces without length.
    return scipy.interpolate.PPoly(whole.c[:, 3:-3], whole.x[3:-3])
