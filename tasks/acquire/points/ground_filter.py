"""Slope-based ground filter: points too far above a lower point near by are not ground.

Vosselman (2000), "Slope based filtering of laser altimetry data", IAPRS 33: a point is ground unless another
one within the radius is lower by more than the ground can fall over that distance. The result equals that of
comparing all pairs; sorting points into square buckets and by height avoids most of the comparisons.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.compiled import compiled
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats

Indices = NDArray[np.int64]

POINTS_PER_BUCKET = 16
BUCKETS_PER_RADIUS = 16
"""Buckets have about `POINTS_PER_BUCKET` points, more in dense clouds: their side is at least radius / 16."""
SLACK_M = 1e-6
"""Margin of distances to buckets (m), for points that rounding moved across the edge of a bucket."""
OUTNUMBERED = 20
"""Low outliers have this many times more points above them; with fewer they may be ground."""


class Options(base.Options):
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
    low_m: float | None = Field(
        0.5,
        gt=0,
        description="points lower than all around by this much are left out (m); null keeps all",
    )
    low_radius_m: float = Field(
        10.0, gt=0, le=100, description="radius in plan of the search for low outliers (m)"
    )
    low_companions: int = Field(
        5, ge=0, description="number of other points near a low outlier that may be as low"
    )

    @property
    def tolerance_m(self) -> float:
        """Tolerated height difference of two points at the same position (m): the noise of both."""
        return self.confidence * math.sqrt(2) * self.noise_m


def ground(easting: Floats, northing: Floats, height: Floats, options: Options) -> Bools:
    """Return which points are ground.

    Point p is ground if ``h_p - h_q <= slope * d + confidence * sqrt(2) * noise_m`` for all q at a distance
    ``d <= radius_m`` in plan. Low outliers are not ground, and are not compared. A point is a
    low outlier if within ``low_radius_m`` at most ``low_companions`` others are lower or at most ``low_m``
    higher, and 20 times as many points (counting itself) are above that.

    Parameters
    ----------
    easting, northing, height : ndarray, (n,)
        In metres. Points with NaN or infinite coordinates are not ground.
    options : Options

    Returns
    -------
    ndarray of bool, (n,)
        Independent of the order of the points.

    Raises
    ------
    TaskError
        If the arrays differ in length.
    """
    if not (easting.shape == northing.shape == height.shape == (height.size,)):
        shapes = f"{easting.shape}, {northing.shape} and {height.shape}"
        raise TaskError(f"easting, northing and height of points must have the same length, not {shapes}")
    out = np.zeros(height.shape, bool)
    valid = np.flatnonzero(np.isfinite(easting) & np.isfinite(northing) & np.isfinite(height))
    if valid.size == 0:
        return out
    points = _Buckets.of(easting[valid], northing[valid], height[valid], options.radius_m)
    if options.low_m is not None:
        low = _low_outliers(*points.arrays, options.low_radius_m, options.low_m, options.low_companions)
        points = points.without(low)
    is_ground = _ground(*points.arrays, options.radius_m, options.slope, options.tolerance_m)
    out[valid[points.order[is_ground]]] = True
    return out


def ground_cells(heights: Floats, cell: float, options: Options) -> Bools:
    """Return which cells of a surface model are ground: `ground` applied to the cell centres.

    Parameters
    ----------
    heights : ndarray, (H, W)
        In metres; cells with NaN are not ground.
    cell : float
        Cell size (m).
    options : Options

    Returns
    -------
    ndarray of bool, (H, W)
    """
    row, col = np.indices(heights.shape, np.float64).reshape(2, -1)
    return ground(col * cell, -row * cell, heights.ravel(), options).reshape(heights.shape)


@dataclass(frozen=True, eq=False)
class _Buckets:
    """Points sorted by square bucket and, within a bucket, by height."""

    x: Floats
    y: Floats
    z: Floats
    order: Indices
    """Index of each sorted point in the input."""
    start: Indices
    """Points of bucket b are ``start[b]`` to ``start[b + 1] - 1``; buckets are numbered along x first."""
    shape: tuple[int, int]
    """Number of buckets along y and x."""
    side: float
    """Side of a bucket (m)."""

    @classmethod
    def of(cls, easting: Floats, northing: Floats, height: Floats, radius: float) -> _Buckets:
        """Sort points into buckets, whose number is at most a small multiple of that of the points."""
        # Subtracting a whole-metre origin from large coordinates is exact.
        x, y = easting - math.floor(easting.min()), northing - math.floor(northing.min())
        width, depth = float(x.max()), float(y.max())
        mean_side = math.sqrt(POINTS_PER_BUCKET * width * depth / x.size)
        side = max(radius / BUCKETS_PER_RADIUS, mean_side, max(width, depth) / x.size)
        shape = int(depth / side) + 1, int(width / side) + 1
        bucket = (y / side).astype(np.int64) * shape[1] + (x / side).astype(np.int64)
        order = np.argsort(height, kind="stable")
        order = order[np.argsort(bucket[order], kind="stable")]
        start = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=shape[0] * shape[1]))])
        return cls(x[order], y[order], height[order], order, start, shape, side)

    def without(self, excluded: Bools) -> _Buckets:
        """Return a copy without the excluded points, given in sorted order."""
        if not excluded.any():
            return self
        keep = ~excluded
        start = np.concatenate([[0], np.cumsum(keep)])[self.start]
        return replace(
            self, x=self.x[keep], y=self.y[keep], z=self.z[keep], order=self.order[keep], start=start
        )

    @property
    def arrays(self) -> tuple[Floats, Floats, Floats, Indices, tuple[int, int], float]:
        """Arguments of the compiled functions below."""
        return self.x, self.y, self.z, self.start, self.shape, self.side


@compiled()
def _span(position: float, reach: float, side: float, count: int) -> tuple[int, int]:
    """Return the first bucket within reach of a coordinate, and the last one plus 1."""
    first = math.floor((position - reach - SLACK_M) / side)
    last = math.floor((position + reach + SLACK_M) / side)
    return max(first, 0), min(last, count - 1) + 1


@compiled()
def _gap(low: float, high: float, index: int, side: float) -> float:
    """Return the smallest distance of a bucket from the interval ``low`` to ``high`` along one axis (m)."""
    return max(index * side - high, low - (index + 1) * side, SLACK_M) - SLACK_M


@compiled()
def _low_outliers(
    x: Floats,
    y: Floats,
    z: Floats,
    start: Indices,
    shape: tuple[int, int],
    side: float,
    radius: float,
    step: float,
    companions: int,
) -> Bools:
    out = np.zeros(z.size, np.bool_)
    bucket_is_near = math.sqrt(2) * side + SLACK_M <= radius
    for b in range(start.size - 1):
        end = start[b + 1]
        # Points are sorted by height, so only the first ones of a bucket can have too few companions.
        if bucket_is_near:
            end = min(end, start[b] + companions + 1)
        for p in range(start[b], end):
            # The count includes the point itself.
            as_low = _count(x, y, z, start, shape, side, radius, p, step, companions + 2)
            if as_low <= companions + 1:
                enough = (OUTNUMBERED + 1) * as_low
                out[p] = _count(x, y, z, start, shape, side, radius, p, np.inf, enough) == enough
    return out


@compiled()
def _count(
    x: Floats,
    y: Floats,
    z: Floats,
    start: Indices,
    shape: tuple[int, int],
    side: float,
    radius: float,
    p: int,
    step: float,
    enough: int,
) -> int:
    """Count the points near p, itself included, at most ``step`` above it; stop at ``enough``."""
    count = 0
    first_col, end_col = _span(x[p], radius, side, shape[1])
    first_row, end_row = _span(y[p], radius, side, shape[0])
    for row in range(first_row, end_row):
        for b in range(row * shape[1] + first_col, row * shape[1] + end_col):
            for q in range(start[b], start[b + 1]):
                if z[q] - z[p] > step:
                    break
                if math.sqrt((x[q] - x[p]) ** 2 + (y[q] - y[p]) ** 2) <= radius:
                    count += 1
                    if count == enough:
                        return count
    return count


@compiled()
def _ground(
    x: Floats,
    y: Floats,
    z: Floats,
    start: Indices,
    shape: tuple[int, int],
    side: float,
    radius: float,
    slope: float,
    tolerance: float,
) -> Bools:
    out = np.ones(z.size, np.bool_)
    rows, cols = shape
    floor = np.full(rows * cols, np.inf)
    for b in range(rows * cols):
        if start[b] < start[b + 1]:
            floor[b] = z[start[b]]
    candidates = np.empty((2 * math.ceil(radius / side) + 3) ** 2, np.int64)
    for b in range(rows * cols):
        if start[b] == start[b + 1]:
            continue
        # Comparing with one low point near by rejects most points that are not ground.
        low = start[_lowest(floor, shape, side, b, radius, slope)]
        top = -np.inf
        for p in range(start[b], start[b + 1]):
            out[p] = not _over(x, y, z, p, low, low + 1, radius, slope, tolerance, 0.0)
            if out[p]:
                top = z[p]
        # The remaining points are compared with all buckets low enough to reject the highest of them.
        count = _low_buckets(floor, shape, side, b, radius, slope, tolerance, top, candidates)
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
def _lowest(floor: Floats, shape: tuple[int, int], side: float, b: int, radius: float, slope: float) -> int:
    """Return the bucket that allows the lowest ground at bucket b, by the distance of their centres."""
    row, col = divmod(b, shape[1])
    reach = int(radius / side)
    best, lowest = b, floor[b]
    for r in range(max(row - reach, 0), min(row + reach + 1, shape[0])):
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
    first_col, end_col = _span(west, radius, side, shape[1])[0], _span(west + side, radius, side, shape[1])[1]
    first_row, end_row = (
        _span(south, radius, side, shape[0])[0],
        _span(south + side, radius, side, shape[0])[1],
    )
    count = 0
    for r in range(first_row, end_row):
        away = _gap(south, south + side, r, side)
        for c in range(first_col, end_col):
            drop = top - floor[r * shape[1] + c]
            if drop <= slope * away + tolerance:
                continue
            gap = math.sqrt(_gap(west, west + side, c, side) ** 2 + away**2)
            if gap <= radius and drop > slope * gap + tolerance:
                candidates[count] = r * shape[1] + c
                count += 1
    return count
