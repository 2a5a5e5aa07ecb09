"""Low outliers of a point cloud: points far below all points around them, caused by multipath echoes.

Ground filters remove them first: a low outlier would cause the rejection of all points around it. Points are
sorted into square buckets and by height, to avoid most comparisons.
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
FEW_POINTS = 64
"""Buckets with at most this many points are sorted by insertion, which is fast for few points."""
SLACK_M = 1e-6
"""Margin of distances to buckets (m), for points that rounding moved across the edge of a bucket."""
OUTNUMBERED = 20
"""A low outlier has this many times more points above it; with fewer points it may be ground."""


class Options(base.Options):
    """Detection of low outliers."""

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
    def low_reach_m(self) -> float:
        """Distance up to which other points decide whether a point is a low outlier (m)."""
        return 0.0 if self.low_m is None else self.low_radius_m


def without_low_outliers(
    easting: Floats, northing: Floats, height: Floats, radius_m: float, options: Options
) -> _Buckets:
    """Return the finite points without low outliers, sorted into buckets.

    A point is a low outlier if within ``low_radius_m`` at most ``low_companions`` other points are lower or
    at most ``low_m`` higher, and 20 times as many points (with itself) are above that.

    - `easting`, `northing`, `height` ``(n,)``: in metres.
    - `radius_m`: radius of searches in the buckets (m), for their size.
    """
    if not (easting.shape == northing.shape == height.shape == (height.size,)):
        shapes = f"{easting.shape}, {northing.shape} and {height.shape}"
        raise TaskError(f"easting, northing and height of points must have the same length, not {shapes}")
    valid = np.flatnonzero(np.isfinite(easting) & np.isfinite(northing) & np.isfinite(height))
    if valid.size == 0:
        nothing = np.zeros(0)
        return _Buckets(nothing, nothing, nothing, valid, np.zeros(2, np.int64), (1, 1), radius_m)
    is_part = valid.size < height.size
    if is_part:
        easting, northing, height = easting[valid], northing[valid], height[valid]
    points = _Buckets.of(easting, northing, height, radius_m)
    if options.low_m is not None:
        low = _low_outliers(*points.arrays, options.low_radius_m, options.low_m, options.low_companions)
        points = points.without(low)
    return replace(points, order=valid[points.order]) if is_part else points


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
        """Sort points into buckets; there are at most a few times more buckets than points."""
        # The subtraction of a whole-metre origin from large coordinates is exact.
        x, y = easting - math.floor(easting.min()), northing - math.floor(northing.min())
        width, depth = float(x.max()), float(y.max())
        mean_side = math.sqrt(POINTS_PER_BUCKET * width * depth / x.size)
        side = max(radius / BUCKETS_PER_RADIUS, mean_side, max(width, depth) / x.size)
        shape = int(depth / side) + 1, int(width / side) + 1
        order, start = _sorted(x, y, height, shape, side)
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
def _sorted(x: Floats, y: Floats, z: Floats, shape: tuple[int, int], side: float) -> tuple[Indices, Indices]:
    """Return the order by bucket and by height within it, and the first point of each bucket."""
    bucket = np.empty(x.size, np.int64)
    start = np.zeros(shape[0] * shape[1] + 1, np.int64)
    for i in range(x.size):
        bucket[i] = int(y[i] / side) * shape[1] + int(x[i] / side)
        start[bucket[i] + 1] += 1
    for b in range(1, start.size):
        start[b] += start[b - 1]
    free, order = start[:-1].copy(), np.empty(x.size, np.int64)
    for i in range(x.size):
        order[free[bucket[i]]] = i
        free[bucket[i]] += 1
    for b in range(start.size - 1):
        first, end = start[b], start[b + 1]
        if end - first > FEW_POINTS:
            part = order[first:end].copy()
            order[first:end] = part[np.argsort(z[part], kind="mergesort")]
            continue
        for k in range(first + 1, end):
            i, place = order[k], k
            while place > first and z[order[place - 1]] > z[i]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = i
    return order, start


@compiled()
def span(position: float, reach: float, side: float, count: int) -> tuple[int, int]:
    """Return the first bucket within reach of a coordinate, and the last bucket plus 1."""
    first = math.floor((position - reach - SLACK_M) / side)
    last = math.floor((position + reach + SLACK_M) / side)
    return max(first, 0), min(last, count - 1) + 1


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
        # Points are sorted by height, so only the first points of a bucket can have too few companions.
        if bucket_is_near:
            end = min(end, start[b] + companions + 1)
        for p in range(start[b], end):
            # The count includes the point itself.
            as_low = _count(x, y, z, start, shape, side, radius, b, p, step, companions + 2)
            if as_low <= companions + 1:
                enough = (OUTNUMBERED + 1) * as_low
                out[p] = _count(x, y, z, start, shape, side, radius, b, p, np.inf, enough) == enough
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
    own: int,
    p: int,
    step: float,
    enough: int,
) -> int:
    """Count the points near p, including p, at most ``step`` above it; stop at ``enough``."""
    # Most points have enough companions in their own bucket.
    count = _count_in(x, y, z, start[own], start[own + 1], radius, p, step, enough)
    first_col, end_col = span(x[p], radius, side, shape[1])
    first_row, end_row = span(y[p], radius, side, shape[0])
    for row in range(first_row, end_row):
        for b in range(row * shape[1] + first_col, row * shape[1] + end_col):
            if count == enough:
                return count
            if b != own:
                count += _count_in(x, y, z, start[b], start[b + 1], radius, p, step, enough - count)
    return count


@compiled()
def _count_in(
    x: Floats,
    y: Floats,
    z: Floats,
    first: int,
    end: int,
    radius: float,
    p: int,
    step: float,
    enough: int,
) -> int:
    """Count like `_count`, among points ``first`` to ``end - 1``, which are sorted by height."""
    count = 0
    for q in range(first, end):
        if z[q] - z[p] > step:
            break
        if math.sqrt((x[q] - x[p]) ** 2 + (y[q] - y[p]) ** 2) <= radius:
            count += 1
            if count == enough:
                break
    return count
