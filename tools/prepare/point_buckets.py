"""Points on disk, sorted into buckets: square blocks of ground, each of which can be read separately.

A file has the points of many blocks, those of a block side by side, so that several processes can write files
at the same time. Coordinates are stored as integers in tenths of a millimetre, so that they do not depend on
the division into blocks.
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
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats
from flexroad.tools.prepare.points.binning import Points

PER_METRE = 10_000
"""Units of the stored coordinates: tenths of a millimetre."""
RECORD = np.dtype(
    [("east", "<i4"), ("north", "<i4"), ("height", "<i4"), ("kind", "u1"), ("colour", "u1", (3,))]
)
"""One point; ``east`` and ``north`` are relative to the block's south-west corner."""
POINTS_PER_BLOCK = 2_000_000
"""Target number of points that a worker holds in memory, including the rim around its block."""
SHORTEST_EDGE_M, LONGEST_EDGE_M = 50.0, 500.0
"""Limits of the edge of a block (m)."""
WORDS = 4
"""Number of 32-bit words of a record; the last one has the class in its lowest byte, then the colour."""
BYTE, BYTE_BITS = 255, 8

Integers = NDArray[np.int64]
Words = NDArray[np.int32]
"""Records as 32-bit words, ``(n, 4)``, or some of these words."""
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

    A block then has about `POINTS_PER_BLOCK` points, including those of its rim.
    """
    fitting = math.sqrt(POINTS_PER_BLOCK * area / points) - 2 * reach_m
    edge = LONGEST_EDGE_M if points <= POINTS_PER_BLOCK else np.clip(fitting, SHORTEST_EDGE_M, LONGEST_EDGE_M)
    return max(1, math.floor(edge / step)) * step


@dataclass(frozen=True)
class BlockPart:
    """Points of one block that lie side by side in a file."""

    block: BlockIndex
    path: Path
    first: int
    """Number of records before them."""
    count: int

    def read(self, count: int = -1) -> Words:
        """Return the records as words, ``(n, 4)``, at most ``count`` if that is not negative."""
        number = self.count if count < 0 else min(count, self.count)
        words = np.fromfile(self.path, "<i4", number * WORDS, offset=self.first * RECORD.itemsize)
        return words.reshape(-1, WORDS)


@dataclass(frozen=True)
class PointBuckets:
    """Points in square blocks of ground; a border belongs to the block to its east or south."""

    edge: float
    """Edge of a block (m)."""
    parts: Mapping[BlockIndex, Sequence[BlockPart]] = field(default_factory=dict)
    """Where the points of each block are; blocks without points are left out."""

    @classmethod
    def of(cls, edge: float, parts: Iterable[BlockPart]) -> PointBuckets:
        """Return the buckets with the points of some parts."""
        by_block: dict[BlockIndex, list[BlockPart]] = {}
        for part in parts:
            by_block.setdefault(part.block, []).append(part)
        return cls(edge, by_block)

    def around(self, grid: Grid, reach_m: float) -> PointBuckets:
        """Return only the blocks that overlap a grid and a rim around it: a worker needs no others."""
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
        ((east, north, *_),), (x, y) = self.parts[index][0].read(1), _corner(index, self.edge)
        return (int(east) + x) / PER_METRE, (int(north) + y) / PER_METRE

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
        keys, rest = [np.zeros(0, np.int64)], [np.zeros((0, 2), np.int32)]
        for index in self.overlapping(grid, reach_m):
            x, y = _corner(index, self.edge)
            for part in self.parts.get(index, ()):
                inside = _inside(part.read(), west - x, south - y, east - x, north - y)
                keys.append(inside[0])
                rest.append(inside[1])
        plan, words = np.concatenate(keys), np.concatenate(rest)
        columns = _columns(plan, words, _order(plan, words), west, south, with_colours)
        return Points(*columns[:4], colour=columns[4] if with_colours else None)


def append(
    path: Path, edge: float, east: Integers, north: Integers, records: NDArray[np.void]
) -> list[BlockPart]:
    """Add points, ``(n,)``, with coordinates in stored units, to a file; return where they are."""
    side = edge * PER_METRE
    west, south = math.floor(east.min() / side), math.ceil(north.min() / side) - 1
    width = math.floor(east.max() / side) - west + 1
    block = _block_numbers(east, north, side, west, south, width)
    # NumPy sorts integers of one or two bytes by radix, which is faster.
    order = np.argsort(block.astype(np.min_scalar_type(int(block.max()))), kind="stable")
    ends = np.flatnonzero(np.diff(block[order])) + 1
    words = records.view("<i4").reshape(-1, WORDS)
    parts = []
    with path.open("ab") as file:
        for members in np.split(order, ends):
            row, col = divmod(int(block[members[0]]), width)
            index = west + col, south + row
            parts.append(BlockPart(index, path, file.tell() // RECORD.itemsize, members.size))
            file.write(_relative(words, east, north, members, *_corner(index, edge)).tobytes())
    return parts


def _corner(index: BlockIndex, edge: float) -> tuple[int, int]:
    """Return easting and northing of a block's south-west corner, in stored units."""
    return round(index[0] * edge * PER_METRE), round(index[1] * edge * PER_METRE)


def _order(plan: Integers, words: Words) -> NDArray[np.intp]:
    """Return the order by plan coordinates and, where they are equal, by height, class and colour."""
    order = np.argsort(plan)
    ties = np.flatnonzero(np.diff(plan[order]) == 0)
    ties = np.union1d(ties, ties + 1)
    tied = order[ties]
    kind_and_colour = words[tied, 1].view(np.uint32)
    keys = kind_and_colour >> BYTE_BITS, kind_and_colour & BYTE, words[tied, 0], plan[tied]
    order[ties] = tied[np.lexsort(keys)]
    return order


@compiled()
def _block_numbers(
    east: Integers, north: Integers, edge: float, west: int, south: int, width: int
) -> Integers:
    """Return the row-major number of each point's block, from column ``west`` and row ``south``."""
    numbers = np.empty(east.size, np.int64)
    for i in range(east.size):
        row = math.ceil(north[i] / edge) - 1 - south
        numbers[i] = row * width + math.floor(east[i] / edge) - west
    return numbers


@compiled()
def _relative(
    words: Words, east: Integers, north: Integers, members: NDArray[np.intp], west: int, south: int
) -> Words:
    """Return some records, with plan coordinates from the corner of their block."""
    part = np.empty((members.size, words.shape[1]), np.int32)
    for k in range(members.size):
        i = members[k]
        part[k, 0], part[k, 1] = east[i] - west, north[i] - south
        part[k, 2], part[k, 3] = words[i, 2], words[i, 3]
    return part


@compiled()
def _inside(words: Words, west: int, south: int, east: int, north: int) -> tuple[Integers, Words]:
    """Return the plan coordinates of the records in an area, as one number each, and their other words."""
    count = 0
    for i in range(words.shape[0]):
        count += west <= words[i, 0] <= east and south <= words[i, 1] <= north
    plan, rest = np.empty(count, np.int64), np.empty((count, 2), np.int32)
    k = 0
    for i in range(words.shape[0]):
        x, y = words[i, 0], words[i, 1]
        if west <= x <= east and south <= y <= north:
            plan[k] = (np.int64(y) - south) << 32 | (np.int64(x) - west)
            rest[k, 0], rest[k, 1] = words[i, 2], words[i, 3]
            k += 1
    return plan, rest


@compiled()
def _columns(
    plan: Integers, words: Words, order: NDArray[np.intp], west: int, south: int, with_colours: bool
) -> tuple[Floats, Floats, Floats, NDArray[np.uint8], NDArray[np.uint8]]:
    """Return eastings, northings and heights (m), classes and colours in an order."""
    n = order.size
    easting, northing, height = np.empty(n), np.empty(n), np.empty(n)
    kind, colour = np.empty(n, np.uint8), np.empty((n if with_colours else 0, 3), np.uint8)
    for k in range(n):
        i = order[k]
        # Division, not multiplication by 1e-4: whole centimetres are restored exactly.
        easting[k] = ((plan[i] & 0xFFFFFFFF) + west) / PER_METRE
        northing[k] = ((plan[i] >> 32) + south) / PER_METRE
        height[k] = words[i, 0] / PER_METRE
        kind[k] = words[i, 1] & 255
        if with_colours:
            for band in range(3):
                colour[k, band] = words[i, 1] >> 8 * (band + 1) & 255
    return easting, northing, height, kind, colour
