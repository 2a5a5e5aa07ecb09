"""Heights along a reference line: on a grid for OpenCRG, and as profiles of OpenDRIVE.

Each cross-section of a road becomes a straight line, with a height on the reference line and a slope. Along
the road both become cubic pieces within a tolerance. Neighbouring pieces have the same value and slope where
they meet. Other shapes of a road (crown, ruts, kerbs, bumps) are missed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats, HeightAt
from flexroad.tools.export.reference_line import ReferenceLine

MARGIN_M = 1.0
"""Width of a grid beside the widest carriageway (m); less in narrow bends, so that rows do not cross."""
NONE = np.zeros((1, 5))
"""A profile that is 0 everywhere."""
TOLERANCE_M = 0.0005
"""Largest distance of a profile from the straight lines that fit the cross-sections (m)."""


@dataclass(frozen=True, eq=False)
class Profiles:
    """Cubic pieces over the length of a road, ``(k, 5)``: s, a, b, c, d as in OpenDRIVE."""

    elevation: Floats
    """Height on the line (m)."""
    superelevation: Floats
    """Slope across the road (radians), positive where the left side is higher."""

    def at(self, s: Floats, t: Floats) -> Floats:
        """Return heights at distances along the road and from its reference line."""
        return value_at(self.elevation, s) + t * np.tan(value_at(self.superelevation, s))


def straight_lines(
    t: Floats, z: Floats, inside: Bools, through: Floats | None = None
) -> tuple[Floats, Floats]:
    """Return height at t = 0 and slope of the best straight line of each cross-section, ``(n,)`` each.

    NaN where a cross-section has too few points.

    - `t` ``(m,)``: distances from the reference line (m).
    - `z` ``(n, m)``: heights (m).
    - `inside` ``(n, m)``: the points that are used; their heights are known.
    - `through` ``(n,)``: fixed heights of the lines at t = 0; None: they are fitted, too.
    """
    known = np.where(inside, z, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if through is None:
            number = inside.sum(axis=1)
            middle, height = (inside * t).sum(axis=1) / number, known.sum(axis=1) / number
        else:
            middle, height = np.zeros(len(z)), through
        away = np.where(inside, t - middle[:, None], 0.0)
        rise = np.where(away != 0, known - height[:, None], 0.0)
        slope = (away * rise).sum(axis=1) / (away**2).sum(axis=1)
    return height - slope * middle, slope


def cubic_pieces(s: Floats, z: Floats, slope: Floats, tolerance: float) -> Floats:
    """Return the cubic pieces of a profile, ``(k, 5)``: s, a, b, c, d as in OpenDRIVE.

    At its ends a piece has the values and slopes of the profile. So profiles with the same value and slope at
    a place meet exactly there. Each piece is as long as the tolerance allows.

    - `s` ``(n,)``: distances along the road, ascending (m); at least two.
    - `z`, `slope` ``(n,)``: values of the profile there, and their derivatives by s.
    - `tolerance`: largest distance of a piece from the values between its ends.
    """
    ends = _ends(s, z, slope, tolerance)
    a, b = ends[:-1], ends[1:]
    length = s[b] - s[a]
    rise = (z[b] - z[a]) / length
    c = (3 * rise - 2 * slope[a] - slope[b]) / length
    d = (slope[a] + slope[b] - 2 * rise) / length**2
    return np.column_stack([s[a], z[a], slope[a], c, d])


def value_at(pieces: Floats, s: Floats) -> Floats:
    """Return the values of cubic pieces, ``(k, 5)``, at distances s."""
    at = np.maximum(np.searchsorted(pieces[:, 0], s, side="right") - 1, 0)
    start, a, b, c, d = np.moveaxis(pieces[at], -1, 0)
    along = s - start
    return np.asarray(a + along * (b + along * (c + along * d)))


@compiled()
def _ends(s: Floats, z: Floats, slope: Floats, tolerance: float) -> NDArray[np.intp]:
    """Return the indices of the ends of the pieces."""
    ends, start, last = [0], 0, len(s) - 1
    while start < last:
        # The length is doubled while the piece fits; the largest length is between the last two tries.
        fits, step = start + 1, 2
        while fits < last:
            end = min(start + step, last)
            if not _cubic_fits(s, z, slope, start, end, tolerance):
                break
            fits, step = end, 2 * step
        beyond = min(start + step, last + 1)
        while beyond - fits > 1:
            middle = (fits + beyond) // 2
            if _cubic_fits(s, z, slope, start, middle, tolerance):
                fits = middle
            else:
                beyond = middle
        ends.append(fits)
        start = fits
    return np.array(ends)


@compiled()
def _cubic_fits(s: Floats, z: Floats, slope: Floats, a: int, b: int, tolerance: float) -> bool:
    length = s[b] - s[a]
    rise = (z[b] - z[a]) / length
    c = (3 * rise - 2 * slope[a] - slope[b]) / length
    d = (slope[a] + slope[b] - 2 * rise) / length**2
    for i in range(a + 1, b):
        along = s[i] - s[a]
        if not math.fabs(z[a] + along * (slope[a] + along * (c + along * d)) - z[i]) <= tolerance:
            return False
    return True


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights beside the points of a reference line."""

    line: ReferenceLine
    v: Floats
    """Distances from the line, ``(m,)``, m; ascending by equal steps, positive to the left."""
    heights: Floats
    """``(n, m)``, m; NaN beyond the surface and beyond gaps, so that no row has NaN between heights."""


def height_grid(line: ReferenceLine, height: HeightAt) -> HeightGrid:
    """Return the heights of a surface beside a part of a line that `reference_line.usable` returns."""
    v = across(line, 0.25, MARGIN_M)
    heights, middle = height(*line.beside(v)), int(np.argmin(np.abs(v)))
    # Readers of OpenCRG reject gaps in a row.
    known = np.isfinite(heights)
    right = np.logical_and.accumulate(known[:, middle::-1], axis=1)[:, ::-1]
    left = np.logical_and.accumulate(known[:, middle:], axis=1)
    return HeightGrid(line, v, np.where(np.hstack([right, left[:, 1:]]), heights, np.nan))


def across(line: ReferenceLine, step: float, margin_m: float) -> Floats:
    """Return distances from a line, ``step`` apart (m), up to ``margin_m`` beside its widest place."""
    right, left = line.reach(float(line.width.max()) / 2 + margin_m)
    return np.arange(-round(right // step), round(left // step) + 1, dtype=np.float64) * step


def grid_error(grid: HeightGrid, height: HeightAt) -> tuple[float, float]:
    """Return the errors of bilinear interpolation in the middle of cells: median, largest (m)."""
    x, y = grid.line.beside((grid.v[:-1] + grid.v[1:]) / 2)
    z = grid.heights
    middle = (z[:-1, :-1] + z[1:, :-1] + z[:-1, 1:] + z[1:, 1:]) / 4
    missed = np.abs(middle - height((x[:-1] + x[1:]) / 2, (y[:-1] + y[1:]) / 2))
    missed = missed[np.isfinite(missed)]
    if not len(missed):
        return np.nan, np.nan
    return float(np.median(missed)), float(missed.max())


def profiles(grid: HeightGrid) -> Profiles:
    """Return the profiles that fit the heights of the carriageway by least squares.

    A line through an incomplete cross-section would have the slope of one side of the crown. So the crown of
    the nearest complete cross-section is subtracted. Cross-sections with less than two heights are
    interpolated from their neighbours.
    """
    s, v = grid.line.s, grid.v
    crown, inside = _crown(grid, on_carriageway(grid))
    found = np.stack(straight_lines(v, grid.heights - crown, inside))
    known = np.isfinite(found[1])
    height, slope = (
        (np.interp(s, s[known], row[known]) for row in found) if known.any() else np.zeros_like(found)
    )
    reach = max(float(np.abs(v).max()), 1.0)
    return Profiles(_pieces(s, height, TOLERANCE_M), _pieces(s, np.arctan(slope), TOLERANCE_M / reach))


def _pieces(s: Floats, values: Floats, tolerance: float) -> Floats:
    return cubic_pieces(s, values, scipy.interpolate.CubicSpline(s, values)(s, 1), tolerance)


def profile_error(grid: HeightGrid, profiles: Profiles) -> tuple[float, float]:
    """Return the errors of profiles on the carriageway: mean, largest (m); NaN without heights."""
    missed = np.abs(profiles.at(grid.line.s[:, None], grid.v) - grid.heights)[on_carriageway(grid)]
    if not len(missed):
        return np.nan, np.nan
    return float(missed.mean()), float(missed.max())


def largest_steps(grid: HeightGrid, step: HeightAt) -> tuple[float, float]:
    """Return the largest step up or down at the nodes of a grid, and at the nodes of the carriageway (m).

    NaN if no node has a height.
    """
    steps = np.abs(step(*grid.line.beside(grid.v)))
    known, inside = steps[np.isfinite(steps)], steps[on_carriageway(grid)]
    everywhere, carriageway = (float(part.max()) if len(part) else np.nan for part in (known, inside))
    return everywhere, carriageway


def on_carriageway(grid: HeightGrid) -> Bools:
    """Return the nodes with a height between the edges of the carriageway, ``(n, m)``."""
    return _between_edges(grid) & np.isfinite(grid.heights)


def _between_edges(grid: HeightGrid) -> Bools:
    return np.asarray(np.abs(grid.v) - grid.line.width[:, None] / 2 < 1e-6)


def _crown(grid: HeightGrid, inside: Bools) -> tuple[Floats, Bools]:
    """Return for incomplete rows the height of the nearest complete row above its straight line.

    Also return the usable points: ``inside`` without points where that nearest row has no height.
    """
    crown = np.zeros(grid.heights.shape)
    cut = (inside != _between_edges(grid)).any(axis=1)
    complete, (rows,) = np.flatnonzero(~cut), np.nonzero(cut)
    if not len(complete) or not len(rows):
        return crown, inside
    nearest = complete[np.rint(np.interp(rows, complete, np.arange(len(complete)))).astype(int)]
    height, slope = straight_lines(grid.v, grid.heights[nearest], inside[nearest])
    straight = height[:, None] + slope[:, None] * grid.v
    crown[rows] = np.where(inside[nearest], grid.heights[nearest] - straight, 0.0)
    common = inside.copy()
    common[rows] &= inside[nearest]
    return crown, common
