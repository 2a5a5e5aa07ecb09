"""Points on disk, sorted into buckets: square blocks of ground, each of which can be read separately.

A file has the points of many blocks, sorted by block, so that several processes can write files at the same
time. Coordinates are stored as integers in tenths of a millimetre, so that they do not depend on the division
into blocks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, Grid
from flexroad.catalog.scan.point_clouds import Cloud
from flexroad.catalog.to_metres import MetricTransform
from flexroad.tools.prepare.points.binning import Points

PER_METRE = 10_000
"""Units of the stored coordinates: tenths of a millimetre."""
RECORD = np.dtype(
    [("east", "<i4"), ("north", "<i4"), ("height", "<i4"), ("kind", "u1"), ("colour", "u1", (3,))]
)
"""One point; ``east`` and ``north`` are relative to the block's south-west corner."""
POINTS_PER_BLOCK = 2_000_000
"""Target number of points in the memory of a worker, including the rim around its block."""
SHORTEST_EDGE_M, LONGEST_EDGE_M = 50.0, 500.0
"""Limits of the edge of a block (m)."""

Integers = NDArray[np.int64]
Records = NDArray[np.void]
"""Points as `RECORD`, ``(n,)``."""
BlockIndex = tuple[int, int]
"""Column and row of a block: easting and northing of its south-west corner, in multiples of the edge."""


def block_edge_of(clouds: Sequence[Cloud], frame: MetricTransform, reach_m: float, step: float) -> float:
    """Return the edge of a block (m) for the points and the extent of the files; see `block_edge`."""
    points, area = sum(cloud.points for cloud in clouds), 0.0
    for cloud in clouds:
        west, south, east, north = cloud.bounds
        x, y, _ = frame.metres(np.array([west, east]), np.array([south, north]), np.zeros(2))
        area += max(float(abs((x[1] - x[0]) * (y[1] - y[0]))), 1.0)
    return block_edge(points, area, reach_m, step)


def block_edge(points: float, area: float, reach_m: float, step: float) -> float:
    """Return the edge of a block (m), a multiple of ``step``, for ``points`` points on ``area`` m2.

    A block and its rim then have about `POINTS_PER_BLOCK` points.
    """
    fitting = math.sqrt(POINTS_PER_BLOCK * area / points) - 2 * reach_m
    edge = LONGEST_EDGE_M if points <= POINTS_PER_BLOCK else np.clip(fitting, SHORTEST_EDGE_M, LONGEST_EDGE_M)
    return max(1, math.floor(edge / step)) * step


@dataclass(frozen=True)
class BlockPart:
    """Consecutive points of one block in a file."""

    block: BlockIndex
    path: Path
    first: int
    """Number of records before them."""
    count: int

    def read(self) -> Records:
        """Return the points."""
        return np.fromfile(self.path, RECORD, self.count, offset=self.first * RECORD.itemsize)


@dataclass(frozen=True)
class PointBuckets:
    """Points in square blocks of ground; a border belongs to the block to its east or south."""

    edge: float
    """Edge of a block (m)."""
    parts: Mapping[BlockIndex, Sequence[BlockPart]] = field(default_factory=dict)
    """The parts with the points of each block; blocks without points are left out."""

    @classmethod
    def of(cls, edge: float, parts: Iterable[BlockPart]) -> PointBuckets:
        """Return the buckets with the points of some parts."""
        by_block: dict[BlockIndex, list[BlockPart]] = {}
        for part in parts:
            by_block.setdefault(part.block, []).append(part)
        return cls(edge, by_block)

    def around(self, grid: Grid, reach_m: float) -> PointBuckets:
        """Return only the blocks that overlap a grid and a rim around it: a worker needs no other blocks."""
        near = self.overlapping(grid, reach_m)
        return PointBuckets(self.edge, {index: self.parts[index] for index in near if index in self.parts})

    def remove(self) -> None:
        """Remove all files."""
        for path in {part.path for parts in self.parts.values() for part in parts}:
            path.unlink()

    def share(self, index: BlockIndex, bounds: Bounds) -> float:
        """Return the share of a block's area that is inside bounds (m)."""
        west, south = index[0] * self.edge, index[1] * self.edge
        wide = min(bounds[2], west + self.edge) - max(bounds[0], west)
        tall = min(bounds[3], south + self.edge) - max(bounds[1], south)
        return max(wide, 0) * max(tall, 0) / self.edge**2

    def first_point(self, index: BlockIndex) -> tuple[float, float]:
        """Return easting and northing (m) of a point of a block."""
        point, (x, y) = self.parts[index][0].read()[0], _corner(index, self.edge)
        return (int(point["east"]) + x) / PER_METRE, (int(point["north"]) + y) / PER_METRE

    def count(self, index: BlockIndex) -> int:
        """Return the number of points of a block."""
        return sum(part.count for part in self.parts.get(index, ()))

    def overlapping(self, grid: Grid, reach_m: float = 0) -> list[BlockIndex]:
        """Return the blocks that overlap a grid and a rim around it, with or without points."""
        west, south, east, north = (round(side * PER_METRE) for side in grid.buffered(reach_m).bounds)
        edge = self.edge * PER_METRE
        columns = range(math.floor(west / edge), math.floor(east / edge) + 1)
        rows = range(math.ceil(south / edge) - 1, math.ceil(north / edge))
        return list(itertools.product(columns, rows))

    def read(self, grid: Grid, reach_m: float, with_colours: bool) -> Points:
        """Return the points on a grid and a rim around it, in an order that depends only on the points."""
        west, south, east, north = (round(side * PER_METRE) for side in grid.buffered(reach_m).bounds)
        # Northing and easting from the south-west corner, as one number.
        plans, found = [np.zeros(0, np.int64)], [np.zeros(0, RECORD)]
        for index in self.overlapping(grid, reach_m):
            x, y = _corner(index, self.edge)
            for part in self.parts.get(index, ()):
                records = part.read()
                right, up = (records[axis].astype(np.int64) for axis in ("east", "north"))
                right, up = right + (x - west), up + (y - south)
                inside = (right >= 0) & (right <= east - west) & (up >= 0) & (up <= north - south)
                plans.append(up[inside] << 32 | right[inside])
                found.append(records[inside])
        plan, points = np.concatenate(plans), np.concatenate(found)
        order = _order(plan, points)
        plan, points = plan[order], points[order]
        return Points(
            # Division, not multiplication by 1e-4: whole centimetres are restored exactly.
            ((plan & 0xFFFFFFFF) + west) / PER_METRE,
            ((plan >> 32) + south) / PER_METRE,
            points["height"] / PER_METRE,
            np.ascontiguousarray(points["kind"]),
            np.ascontiguousarray(points["colour"]) if with_colours else None,
        )


def append(path: Path, edge: float, east: Integers, north: Integers, records: Records) -> list[BlockPart]:
    """Add points, ``(n,)``, with coordinates in stored units, to a file; return their parts."""
    side = edge * PER_METRE
    west, south = math.floor(east.min() / side), math.ceil(north.min() / side) - 1
    width = math.floor(east.max() / side) - west + 1
    row, column = np.ceil(north / side) - 1 - south, np.floor(east / side) - west
    block = (row * width + column).astype(np.int64)
    # NumPy sorts integers of one or two bytes by radix, which is faster.
    order = np.argsort(block.astype(np.min_scalar_type(int(block.max()))), kind="stable")
    ends = np.flatnonzero(np.diff(block[order])) + 1
    parts = []
    with path.open("ab") as file:
        for members in np.split(order, ends):
            up, right = divmod(int(block[members[0]]), width)
            index = west + right, south + up
            (x, y), part = _corner(index, edge), records[members]
            part["east"], part["north"] = east[members] - x, north[members] - y
            parts.append(BlockPart(index, path, file.tell() // RECORD.itemsize, members.size))
            file.write(part.tobytes())
    return parts


def _corner(index: BlockIndex, edge: float) -> tuple[int, int]:
    """Return easting and northing of a block's south-west corner, in stored units."""
    return round(index[0] * edge * PER_METRE), round(index[1] * edge * PER_METRE)


def _order(plan: Integers, records: Records) -> NDArray[np.intp]:
    """Return the order by plan coordinates and, where they are equal, by height, class and colour."""
    order = np.argsort(plan)
    ties = np.flatnonzero(np.diff(plan[order]) == 0)
    ties = np.union1d(ties, ties + 1)
    tied = order[ties]
    same = records[tied]
    order[ties] = tied[np.lexsort((*same["colour"].T, same["kind"], same["height"], plan[tied]))]
    return order
