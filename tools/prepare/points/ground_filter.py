"""Slope-based ground filter: points too far above a lower point near by are not ground.

Vosselman (2000), "Slope based filtering of laser altimetry data", IAPRS 33: a point is ground unless another
point within the radius is lower by more than the ground can fall over that distance. The result is the same
as from a comparison of all pairs. Points are sorted into square buckets and by height, to avoid most
comparisons.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.points import low_outliers
from flexroad.tools.prepare.points.low_outliers import SLACK_M, Indices, span


class Options(low_outliers.Options):
    """Slope, radius and noise of the ground filter, and the detection of low outliers."""

    radius_m: float = Field(
        30.0,
        gt=0,
        le=200,
        description="points within this distance in plan are compared (m): half the widest roof",
    )
    slope: float = Field(0.35, ge=0, le=5, description="steepest slope of the ground: 0.35 is 35 %")
    noise_m: float = Field(0.05, ge=0, le=2, description="standard deviation of the heights (m)")
    confidence: float = Field(
        1.65, ge=0, le=10, description="tolerated noise of a height difference, in its standard deviations"
    )

    @property
    def tolerance_m(self) -> float:
        """Tolerated height difference of two points at the same position (m): the noise of both."""
        return self.confidence * math.sqrt(2) * self.noise_m

    @property
    def reach_m(self) -> float:
        """Distance up to which other points decide whether a point is ground (m)."""
        return self.radius_m + self.low_reach_m


def ground(
    easting: Floats, northing: Floats, height: Floats, options: Options, asked: Bools | None = None
) -> Bools:
    """Return which points are ground.

    Point p is ground if ``h_p - h_q <= slope * d + confidence * sqrt(2) * noise_m`` for all q at a distance
    ``d <= radius_m`` in plan. Low outliers are not ground, and are not compared.

    - `easting`, `northing`, `height` ``(n,)``: in metres. Points with NaN or infinite coordinates are not
      ground.
    - `asked` ``(n,)``: points for which the answer is needed; others are returned as not ground. None: all.
    - result ``(n,)``: independent of the order of the points.
    """
    points = low_outliers.without_low_outliers(easting, northing, height, options.radius_m, options)
    is_asked = np.ones(points.order.size, bool) if asked is None else asked[points.order]
    is_ground = _ground(*points.arrays, is_asked, options.radius_m, options.slope, options.tolerance_m)
    out = np.zeros(height.shape, bool)
    out[points.order[is_ground]] = True
    return out


def ground_cells(heights: Floats, cell: float, options: Options) -> Bools:
    """Return which cells of a surface model are ground: `ground` applied to the cell centres.

    - `heights` ``(H, W)``: in metres; cells with NaN are not ground.
    """
    row, col = np.indices(heights.shape, np.float64).reshape(2, -1)
    return ground(col * cell, -row * cell, heights.ravel(), options).reshape(heights.shape)


@compiled()
def _gap(low: float, high: float, index: int, side: float) -> float:
    """Return the smallest distance of a bucket from the interval ``low`` to ``high`` along one axis (m)."""
    return max(index * side - high, low - (index + 1) * side, SLACK_M) - SLACK_M


@compiled()
def _ground(
    x: Floats,
    y: Floats,
    z: Floats,
    start: Indices,
    shape: tuple[int, int],
    side: float,
    asked: Bools,
    radius: float,
    slope: float,
    tolerance: float,
) -> Bools:
    out = asked.copy()
    rows, cols = shape
    floor = np.full(rows * cols, np.inf)
    for b in range(rows * cols):
        if start[b] < start[b + 1]:
            floor[b] = z[start[b]]
    floor_of_row = _floor_of_row(floor, shape, math.ceil(radius / side) + 1)
    candidates = np.empty((2 * math.ceil(radius / side) + 3) ** 2, np.int64)
    for b in range(rows * cols):
        if not asked[start[b] : start[b + 1]].any():
            continue
        # A comparison with one low point near by rejects most points that are not ground.
        low = start[_lowest(floor, floor_of_row, shape, side, b, radius, slope)]
        top = -np.inf
        for p in range(start[b], start[b + 1]):
            out[p] = asked[p] and not _over(x, y, z, p, low, low + 1, radius, slope, tolerance, 0.0)
            if out[p]:
                top = z[p]
        # The remaining points are compared with all buckets low enough to reject the highest of them.
        count = _low_buckets(floor, floor_of_row, shape, side, b, radius, slope, tolerance, top, candidates)
        for p in range(start[b], start[b + 1]):
            for k in range(count):
                if not out[p]:
                    break
                row, col = divmod(candidates[k], cols)
                gap = math.sqrt(_gap(x[p], x[p], col, side) ** 2 + _gap(y[p], y[p], row, side) ** 2)
                first, end = start[candidates[k]], start[candidates[k] + 1]
                out[p] = not _over(x, y, z, p, first, end, radius, slope, tolerance, gap)
    return out


@compiled()
def _over(
    x: Floats,
    y: Floats,
    z: Floats,
    p: int,
    first: int,
    end: int,
    radius: float,
    slope: float,
    tolerance: float,
    gap: float,
) -> bool:
    """Return whether p is too high above one of points ``first`` to ``end - 1``, at least ``gap`` away."""
    smallest = slope * gap + tolerance
    for q in range(first, end):
        drop = z[p] - z[q]
        if drop <= smallest:
            return False
        distance = math.sqrt((x[p] - x[q]) ** 2 + (y[p] - y[q]) ** 2)
        if distance <= radius and drop > slope * distance + tolerance:
            return True
    return False


@compiled()
def _floor_of_row(floor: Floats, shape: tuple[int, int], reach: int) -> Floats:
    """Return the lowest floor of up to ``reach`` buckets on both sides in the row of each bucket."""
    rows, cols = shape
    lowest = np.full(rows * cols, np.inf)
    for r in range(rows):
        for c in range(cols):
            for near in range(max(c - reach, 0), min(c + reach + 1, cols)):
                lowest[r * cols + c] = min(lowest[r * cols + c], floor[r * cols + near])
    return lowest


@compiled()
def _lowest(
    floor: Floats,
    floor_of_row: Floats,
    shape: tuple[int, int],
    side: float,
    b: int,
    radius: float,
    slope: float,
) -> int:
    """Return the bucket that allows the lowest ground at bucket b, by the distance of their centres."""
    row, col = divmod(b, shape[1])
    reach = int(radius / side)
    best, lowest = b, floor[b]
    for r in range(max(row - reach, 0), min(row + reach + 1, shape[0])):
        if floor_of_row[r * shape[1] + col] + slope * side * abs(r - row) >= lowest:
            continue
        across = int(math.sqrt(reach**2 - (r - row) ** 2))
        for c in range(max(col - across, 0), min(col + across + 1, shape[1])):
            limit = floor[r * shape[1] + c]
            # The square root is only needed if the floor is lower.
            if limit < lowest:
                limit += slope * side * math.sqrt((r - row) ** 2 + (c - col) ** 2)
                if limit < lowest:
                    best, lowest = r * shape[1] + c, limit
    return best


@compiled()
def _low_buckets(
    floor: Floats,
    floor_of_row: Floats,
    shape: tuple[int, int],
    side: float,
    b: int,
    radius: float,
    slope: float,
    tolerance: float,
    top: float,
    candidates: Indices,
) -> int:
    """List the buckets that can reject a point of bucket b at height ``top``; return their number."""
    row, col = divmod(b, shape[1])
    west, south = col * side, row * side
    first_col, end_col = span(west, radius, side, shape[1])[0], span(west + side, radius, side, shape[1])[1]
    first_row, end_row = (
        span(south, radius, side, shape[0])[0],
        span(south + side, radius, side, shape[0])[1],
    )
    count = 0
    for r in range(first_row, end_row):
        away = _gap(south, south + side, r, side)
        if top - floor_of_row[r * shape[1] + col] <= slope * away + tolerance:
            continue
        for c in range(first_col, end_col):
            drop = top - floor[r * shape[1] + c]
            if drop <= slope * away + tolerance:
                continue
            gap = math.sqrt(_gap(west, west + side, c, side) ** 2 + away**2)
            if gap <= radius and drop > slope * gap + tolerance:
                candidates[count] = r * shape[1] + c
                count += 1
    return count
