"""Ground among points by slope: what stands too steeply over something lower near by is an object.

Vosselman (2000), "Slope based filtering of laser altimetry data", IAPRS 33: a point is ground unless another
one within the radius lies lower by more than ground can fall over that distance. The result is that of the
literal comparison of all pairs; points in square buckets, sorted by height, spare nearly all of the work.
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
"""A bucket has about so many points and no less than this part of the radius: dense clouds fill them more."""
SLACK_M = 1e-6
"""Buckets count as this much nearer: a point that rounding put over a bucket's edge is never missed."""
OUTNUMBERED = 20
"""So many times more points must stand over low ones: in thin clouds a lone one may be true ground."""


class Options(base.Options):
    """How steeply ground may fall, how far one looks, and what is too low to be true."""

    radius_m: float = Field(
        30.0, gt=0, le=200, description="points this near in plan are compared (m): half the widest roof"
    )
    slope: float = Field(0.35, ge=0, le=5, description="steepest fall of the ground: 0.35 is 35 %")
    noise_m: float = Field(0.05, ge=0, le=2, description="standard deviation of the heights (m)")
    confidence: float = Field(
        1.65, ge=0, le=10, description="tolerated noise of a height difference, in its standard deviations"
    )
    low_m: float | None = Field(
        0.5,
        gt=0,
        description="points lower than all around by this much are left out (m); null: none",
    )
    low_radius_m: float = Field(10.0, gt=0, le=100, description="what is around a low point (m)")
    low_companions: int = Field(5, ge=0, description="other points that may be as low as a low one")

    @property
    def tolerance_m(self) -> float:
        """What two heights may differ by at no distance (m): noise of both."""
        return self.confidence * math.sqrt(2) * self.noise_m


def ground(easting: Floats, northing: Floats, height: Floats, options: Options) -> Bools:
    """Tell which points are ground.

    Point p is ground if ``h_p - h_q <= slope * d + confidence * sqrt(2) * noise_m`` for all q at a distance
    ``d <= radius_m`` in plan. Low outliers are no ground and take no part: points that, within
    ``low_radius_m``, have at most ``low_companions`` others that are lower or no more than ``low_m`` higher,
    and 20 times as many points above these and themselves.

    Parameters
    ----------
    easting, northing, height : ndarray, (n,)
        In metres. Points with a NaN or an infinity are not ground.
    options : Options

    Returns
    -------
    ndarray of bool, (n,)
        The same for any order of the points.

    Raises
    ------
    TaskError
        If the arrays are not of one length.
    """
    if not (easting.shape == northing.shape == height.shape == (height.size,)):
        shapes = f"{easting.shape}, {northing.shape} and {height.shape}"
        raise TaskError(f"easting, northing and height of points need one length, not {shapes}")
    out = np.zeros(height.shape, bool)
    known = np.flatnonzero(np.isfinite(easting) & np.isfinite(northing) & np.isfinite(height))
    if known.size == 0:
        return out
    points = _Buckets.of(easting[known], northing[known], height[known], options.radius_m)
    if options.low_m is not None:
        low = _low(*points.arrays, options.low_radius_m, options.low_m, options.low_companions)
        points = points.without(low)
    is_ground = _ground(*points.arrays, options.radius_m, options.slope, options.tolerance_m)
    out[known[points.order[is_ground]]] = True
    return out


def ground_cells(heights: Floats, cell: float, options: Options) -> Bools:
    """Tell which cells of a surface model are ground: `ground` of the cells' centres.

    Parameters
    ----------
    heights : ndarray, (H, W)
        In metres; NaN is unknown and never ground.
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
    """Points sorted by square bucket and, in a bucket, by height."""

    x: Floats
    y: Floats
    z: Floats
    order: Indices
    """Where each sorted point was."""
    start: Indices
    """Those of bucket b are ``start[b]`` to ``start[b + 1]``; buckets count along x first."""
    shape: tuple[int, int]
    side: float

    @classmethod
    def of(cls, easting: Floats, northing: Floats, height: Floats, radius: float) -> _Buckets:
        """Sort points into no more than some buckets per point, however they lie."""
        # A whole-metre origin: what is left of large coordinates is exact.
        x, y = easting - math.floor(easting.min()), northing - math.floor(northing.min())
        width, depth = float(x.max()), float(y.max())
        full = math.sqrt(POINTS_PER_BUCKET * width * depth / x.size)
        side = max(radius / BUCKETS_PER_RADIUS, full, max(width, depth) / x.size)
        shape = int(depth / side) + 1, int(width / side) + 1
        bucket = (y / side).astype(np.int64) * shape[1] + (x / side).astype(np.int64)
        order = np.argsort(height, kind="stable")
        order = order[np.argsort(bucket[order], kind="stable")]
        start = np.concatenate([[0], np.cumsum(np.bincount(bucket, minlength=shape[0] * shape[1]))])
        return cls(x[order], y[order], height[order], order, start, shape, side)

    def without(self, some: Bools) -> _Buckets:
        """Leave some of the sorted points out."""
        if not some.any():
            return self
        keep = ~some
        start = np.concatenate([[0], np.cumsum(keep)])[self.start]
        return replace(
            self, x=self.x[keep], y=self.y[keep], z=self.z[keep], order=self.order[keep], start=start
        )

    @property
    def arrays(self) -> tuple[Floats, Floats, Floats, Indices, tuple[int, int], float]:
        """What the loops below take."""
        return self.x, self.y, self.z, self.start, self.shape, self.side


@compiled()
def _span(at: float, reach: float, side: float, count: int) -> tuple[int, int]:
    """Return the first bucket within reach of a coordinate and the one past the last."""
    first = math.floor((at - reach - SLACK_M) / side)
    last = math.floor((at + reach + SLACK_M) / side)
    return max(first, 0), min(last, count - 1) + 1


@compiled()
def _gap(low: float, high: float, index: int, side: float) -> float:
    """Return how far a bucket is at least from low to high along one axis."""
    return max(index * side - high, low - (index + 1) * side, SLACK_M) - SLACK_M


@compiled()
def _low(
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
        # The points before one in its bucket are no higher: only the first of them may lack companions.
        if bucket_is_near:
            end = min(end, start[b] + companions + 1)
        for p in range(start[b], end):
            # Itself is counted too.
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
    """Count the points near p and at most a step above it; stop when there are enough."""
    found = 0
    first_col, end_col = _span(x[p], radius, side, shape[1])
    first_row, end_row = _span(y[p], radius, side, shape[0])
    for row in range(first_row, end_row):
        for b in range(row * shape[1] + first_col, row * shape[1] + end_col):
            for q in range(start[b], start[b + 1]):
                if z[q] - z[p] > step:
                    break
                if math.sqrt((x[q] - x[p]) ** 2 + (y[q] - y[p]) ** 2) <= radius:
                    found += 1
                    if found == enough:
                        return found
    return found


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
    quarantined = np.empty((2 * math.ceil(radius / side) + 3) ** 2, np.int64)
    for b in range(rows * cols):
        if start[b] == start[b + 1]:
            continue
        # One point, low and near, does away with most of what is not ground.
        culprit = start[_lowest(floor, shape, side, b, radius, slope)]
        top = -np.inf
        for p in range(start[b], start[b + 1]):
            out[p] = not _over(x, y, z, p, culprit, culprit + 1, radius, slope, tolerance, 0.0)
            if out[p]:
                top = z[p]
        # The rest is compared with all buckets that are low enough for the highest of them.
        count = _suspects(floor, shape, side, b, radius, slope, tolerance, top, quarantined)
        for p in range(start[b], start[b + 1]):
            for k in range(count):
                if not out[p]:
                    break
                row, col = divmod(quarantined[k], cols)
                gap = math.sqrt(_gap(x[p], x[p], col, side) ** 2 + _gap(y[p], y[p], row, side) ** 2)
                first, end = start[quarantined[k]], start[quarantined[k] + 1]
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
    """Tell whether p stands too high over a point of a bucket that is no nearer than the gap."""
    least = slope * gap + tolerance
    for q in range(first, end):
        drop = z[p] - z[q]
        if drop <= least:
            return False
        distance = math.sqrt((x[p] - x[q]) ** 2 + (y[p] - y[q]) ** 2)
        if distance <= radius and drop > slope * distance + tolerance:
            return True
    return False


@compiled()
def _lowest(floor: Floats, shape: tuple[int, int], side: float, b: int, radius: float, slope: float) -> int:
    """Return the bucket whose lowest point leaves the least room over it at bucket b, by their middles."""
    row, col = divmod(b, shape[1])
    reach = int(radius / side)
    found, least = b, floor[b]
    for r in range(max(row - reach, 0), min(row + reach + 1, shape[0])):
        across = int(math.sqrt(reach**2 - (r - row) ** 2))
        for c in range(max(col - across, 0), min(col + across + 1, shape[1])):
            room = floor[r * shape[1] + c]
            # The root is worth taking only where the floor is lower.
            if room < least:
                room += slope * side * math.sqrt((r - row) ** 2 + (c - col) ** 2)
                if room < least:
                    found, least = r * shape[1] + c, room
    return found


@compiled()
def _suspects(
    floor: Floats,
    shape: tuple[int, int],
    side: float,
    b: int,
    radius: float,
    slope: float,
    tolerance: float,
    top: float,
    quarantined: Indices,
) -> int:
    """List the buckets a point of bucket b at a height of top might stand too high over; return how many."""
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
                quarantined[count] = r * shape[1] + c
                count += 1
    return count
