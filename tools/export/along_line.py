"""Heights along a reference line: on a grid as OpenCRG has them, as profiles of OpenDRIVE, metre by metre."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from flexroad.tasks.types import Bools, Floats
from flexroad.tools.export.profiles import Profiles, cubic_pieces, straight_lines, value_at
from flexroad.tools.export.reference_line import ReferenceLine

HeightAt = Callable[[Floats, Floats], Floats]
"""Heights (m) of the surface at x and y of the reference line's coordinates; NaN where it has none."""
STEP_M = 1.0
"""Length of a segment (m)."""
TOLERANCE_M = 0.0005
"""Largest distance of a profile from the straight lines that fit the cross-sections (m)."""
ACROSS = np.linspace(-0.5, 0.5, 9)
"""Places across the carriageway at which the crossfall is measured, as shares of its width."""


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights beside the points of a reference line."""

    line: ReferenceLine
    v: Floats
    """Distances from the line, ``(m,)``, m; ascending by equal steps, positive to the left."""
    heights: Floats
    """``(n, m)``, m; NaN beyond the surface, and beyond a gap in it: no row has NaN between heights."""


def height_grid(
    line: ReferenceLine, height: HeightAt, v_increment_m: float = 0.25, margin_m: float = 1.0
) -> HeightGrid:
    """Return the heights of a surface beside a line, to ``margin_m`` beside its widest place.

    In narrow bends the margin is smaller, so that the grid does not fold.

    - `line`: a part of a line that `reference_line.usable` returns.
    - `height`: the surface in the line's coordinates.
    - `v_increment_m`: distance across, a multiple of 1 mm (m).
    - `margin_m`: width beside the carriageway, on either side (m).
    """
    v = across(line, v_increment_m, margin_m)
    return HeightGrid(line, v, without_gaps(v, height(*line.beside(v))))


def across(line: ReferenceLine, v_increment_m: float = 0.25, margin_m: float = 1.0) -> Floats:
    """Return the distances from a line at which `height_grid` has heights."""
    step = v_increment_m
    right, left = line.reach(float(line.width.max()) / 2 + margin_m)
    return np.arange(-round(right // step), round(left // step) + 1, dtype=np.float64) * step


def without_gaps(v: Floats, heights: Floats) -> Floats:
    """Return the heights that reach from the line without a gap: readers of OpenCRG refuse gaps in a row."""
    middle, known = int(np.argmin(np.abs(v))), np.isfinite(heights)
    right = np.logical_and.accumulate(known[:, middle::-1], axis=1)[:, ::-1]
    left = np.logical_and.accumulate(known[:, middle:], axis=1)
    return np.where(np.hstack([right, left[:, 1:]]), heights, np.nan)


def grid_error(grid: HeightGrid, height: HeightAt) -> tuple[float, float]:
    """Return how far bilinear interpolation misses a surface in the middle of cells: median, largest (m)."""
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

    Where the surface ends across the road, a cross-section is compared with the nearest complete one: a line
    through a part of it alone would have the slope of that side of the crown. Cross-sections with less than
    two heights do not count; what is between their neighbours is used.
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
    return cubic_pieces(s, values, CubicSpline(s, values)(s, 1), tolerance)


def profile_error(grid: HeightGrid, profiles: Profiles) -> tuple[float, float]:
    """Return how far profiles miss the heights of the carriageway: mean, largest (m); NaN if it has none."""
    return _missed(grid, profiles.at(grid.line.s[:, None], grid.v))


def elevation_error(grid: HeightGrid, profiles: Profiles) -> tuple[float, float]:
    """Return the same as `profile_error` for a reader that takes the elevation alone, across a level road."""
    level = value_at(profiles.elevation, grid.line.s[:, None])
    return _missed(grid, np.broadcast_to(level, grid.heights.shape))


def largest_steps(grid: HeightGrid, step: HeightAt) -> tuple[float, float]:
    """Return the largest step up or down at the nodes of a grid, and at those of the carriageway (m).

    NaN if no node has a height.
    """
    steps = np.abs(step(*grid.line.beside(grid.v)))
    known, inside = steps[np.isfinite(steps)], steps[on_carriageway(grid)]
    everywhere, carriageway = (float(part.max()) if len(part) else np.nan for part in (known, inside))
    return everywhere, carriageway


def _missed(grid: HeightGrid, fitted: Floats) -> tuple[float, float]:
    missed = np.abs(fitted - grid.heights)[on_carriageway(grid)]
    if not len(missed):
        return np.nan, np.nan
    return float(missed.mean()), float(missed.max())


def on_carriageway(grid: HeightGrid) -> Bools:
    """Return the nodes with a height between the edges of the carriageway, ``(n, m)``."""
    return _between_edges(grid) & np.isfinite(grid.heights)


def _between_edges(grid: HeightGrid) -> Bools:
    return np.asarray(np.abs(grid.v) - grid.line.width[:, None] / 2 < 1e-6)


def _crown(grid: HeightGrid, inside: Bools) -> tuple[Floats, Bools]:
    """Return how far the nearest complete row is from its straight line, for rows that are cut, and where.

    The rows of the second array are those of ``inside``, without places where the nearest row has no height.
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


@dataclass(frozen=True, eq=False)
class Stations:
    """``n`` segments of equal length, one after the other."""

    x: Floats
    """Ends of the segments, ``(n + 1,)``, m."""
    y: Floats
    z: Floats
    s: Floats
    """Distance of each end from the start of the road, along the road (m)."""
    middle_x: Floats
    """Middle of each segment, ``(n,)``, m."""
    middle_y: Floats
    height: Floats
    """At the middle, ``(n,)``, m."""
    grade: Floats
    """Rise of the segment per metre along it, ``(n,)``; positive uphill."""
    crossfall: Floats
    """Slope of the straight line that fits the cross-section, ``(n,)``; positive where the left is higher."""
    left: Floats
    """Slope from the middle of the carriageway to its left edge, ``(n,)``; negative where it falls."""
    right: Floats
    """Slope from the middle of the carriageway to its right edge, ``(n,)``."""
    curvature: Floats
    """In plan, ``(n,)``, 1/m; positive to the left."""
    width: Floats
    """Of the carriageway, ``(n,)``, m."""


def stations(line: ReferenceLine, height: HeightAt) -> Stations:
    """Return the segments of a line; what is left of a metre at its end is not one.

    - `line`: with points at an even fraction of a metre.
    - `height`: the surface in the line's coordinates; values are NaN where it has none.
    """
    each = round(STEP_M / line.increment / 2)
    middle = np.arange(each, len(line.x) - each, 2 * each)
    ends = np.append(middle - each, middle[-1] + each)
    z = height(line.x[ends], line.y[ends])
    x, y, heading, width = (values[middle] for values in (line.x, line.y, line.heading, line.width))
    away = width[:, None] * ACROSS
    across = height(
        x[:, None] - away * np.sin(heading)[:, None], y[:, None] + away * np.cos(heading)[:, None]
    )
    at_middle = across[:, len(ACROSS) // 2]
    return Stations(
        x=line.x[ends],
        y=line.y[ends],
        z=z,
        s=line.s[ends],
        middle_x=x,
        middle_y=y,
        height=at_middle,
        grade=np.diff(z) / np.diff(line.s[ends]),
        # The places are symmetric, so that the slope of the line that fits does not depend on its height.
        crossfall=(away * across).sum(axis=1) / (away**2).sum(axis=1),
        left=(across[:, -1] - at_middle) / (width / 2),
        right=(across[:, 0] - at_middle) / (width / 2),
        curvature=line.curvature[middle],
        width=width,
    )
