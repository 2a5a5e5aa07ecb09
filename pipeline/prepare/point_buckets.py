"""Points of many files, sorted into buckets on disk: one file per square block of ground.

Each input file is decoded once, and each block can be read separately. Coordinates are stored as integers
in tenths of a millimetre, so that they do not depend on the division into blocks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, CatalogError, Grid
from flexroad.catalog.headers.point_clouds import CHUNK, Chunk, Cloud, chunks, survey_dates
from flexroad.catalog.limits import HIGHEST_M, LOWEST_M
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.prepare.limits import check_extent
from flexroad.pipeline.prepare.output import disk_errors
from flexroad.tasks.acquire.types import Points
from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Floats

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
class PointBuckets:
    """A folder with one file of points per block; a border belongs to the block to its east or south."""

    folder: Path
    edge: float
    """Edge of a block (m)."""

    def path(self, index: BlockIndex) -> Path:
        """Return the file of a block; it does not exist if the block has no points."""
        return self.folder / f"{index[0]}_{index[1]}.points"

    def corner(self, index: BlockIndex) -> tuple[int, int]:
        """Return easting and northing of a block's south-west corner, in stored units."""
        return round(index[0] * self.edge * PER_METRE), round(index[1] * self.edge * PER_METRE)

    def share(self, index: BlockIndex, bounds: Bounds) -> float:
        """Return the share of a block's area that is inside bounds (m)."""
        west, south = index[0] * self.edge, index[1] * self.edge
        wide = min(bounds[2], west + self.edge) - max(bounds[0], west)
        tall = min(bounds[3], south + self.edge) - max(bounds[1], south)
        return max(wide, 0) * max(tall, 0) / self.edge**2

    def first_point(self, index: BlockIndex) -> tuple[float, float]:
        """Return easting and northing (m) of a point of a block."""
        (record,), corner = np.fromfile(self.path(index), RECORD, count=1), self.corner(index)
        return (int(record["east"]) + corner[0]) / PER_METRE, (int(record["north"]) + corner[1]) / PER_METRE

    def count(self, index: BlockIndex) -> int:
        """Return the number of points of a block."""
        file = self.path(index)
        return file.stat().st_size // RECORD.itemsize if file.exists() else 0

    def remove(self, blocks: Collection[BlockIndex]) -> None:
        """Remove the files of blocks that have points."""
        for index in blocks:
            self.path(index).unlink()

    def append(self, east: Integers, north: Integers, records: NDArray[np.void]) -> set[BlockIndex]:
        """Add points, ``(n,)``, with coordinates in stored units; return the blocks that received any."""
        edge = self.edge * PER_METRE
        west, south = math.floor(east.min() / edge), math.ceil(north.min() / edge) - 1
        width = math.floor(east.max() / edge) - west + 1
        block = _block_numbers(east, north, edge, west, south, width)
        # NumPy sorts integers of one or two bytes by radix, which is faster.
        order = np.argsort(block.astype(np.min_scalar_type(int(block.max()))), kind="stable")
        ends = np.flatnonzero(np.diff(block[order])) + 1
        occupied = set()
        for members in np.split(order, ends):
            row, col = divmod(int(block[members[0]]), width)
            index = west + col, south + row
            part = _relative(
                records.view("<i4").reshape(-1, WORDS), east, north, members, *self.corner(index)
            )
            with self.path(index).open("ab") as file:
                file.write(part.tobytes())
            occupied.add(index)
        return occupied

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
            if self.path(index).exists():
                # Mapped: of most buckets around a block only a rim is used.
                words = np.memmap(self.path(index), "<i4", "r").reshape(-1, WORDS)
                x, y = self.corner(index)
                inside = _inside(words, west - x, south - y, east - x, north - y)
                keys.append(inside[0])
                rest.append(inside[1])
        plan, words = np.concatenate(keys), np.concatenate(rest)
        columns = _columns(plan, words, _order(plan, words), west, south, with_colours)
        return Points(*columns[:4], colour=columns[4] if with_colours else None)


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


@dataclass(frozen=True, eq=False)
class BucketedPoints:
    """The points in the buckets, and statistics of the input files."""

    buckets: PointBuckets
    occupied: frozenset[BlockIndex]
    """PointBuckets with points."""
    bounds: Bounds
    """Bounds of all points: west, south, east, north (m)."""
    kinds: tuple[Integers, ...]
    """Number of points of each class, ``(256,)``, per file; without noise."""
    has_colours: tuple[bool, ...]
    """Whether the points have colours, per file."""
    out_of_range: int
    """Number of points left out because their height is outside `LOWEST_M`..`HIGHEST_M`."""
    dates: tuple[datetime, datetime] | None = None
    """When the first and the last point were measured, or None if that is not known of every file."""

    @property
    def points(self) -> int:
        """Number of points in all buckets."""
        return int(sum(kinds.sum() for kinds in self.kinds))


def bucket_points(
    clouds: Sequence[Cloud], frame: MetricTransform, folder: Path, edge: float, log: Callable[[str], None]
) -> BucketedPoints:
    """Move the points of all files to metres and sort them into buckets, except noise and withheld points.

    Parameters
    ----------
    clouds : Sequence[Cloud]
        The input files.
    frame : MetricTransform
        Transforms their coordinates to metres.
    folder : Path
        Folder of the buckets; they take 16 bytes per point.
    edge : float
        Edge of a block (m).
    log : Callable[[str], None]
        Called with one line of progress per file.

    Raises
    ------
    CatalogError
        If a file cannot be read, points are too far apart or have no position in metres, or no point is left.
    ConfigError
        If the disk is full.
    """
    buckets, occupied, out_of_range = PointBuckets(folder, edge), set[BlockIndex](), 0
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    kinds, has_colours = [], []
    dates: list[tuple[datetime, datetime] | None] = []
    for number, cloud in enumerate(clouds, 1):
        log(f"reading {cloud.path} ({number} of {len(clouds)}, {cloud.points:,} points)")
        counts, colours = np.zeros(256, np.int64), _ByteColours()
        days: list[datetime] = []
        for chunk in chunks(cloud.path, CHUNK):
            try:
                plan, records = _records(chunk, frame, colours)
            except CatalogError as error:
                raise CatalogError(f"{cloud.path}: {error}") from error
            days += (chunk.gps is not None and survey_dates(chunk.gps)) or ()
            out_of_range += len(chunk.z) - len(records)
            if not len(records):
                continue
            before = (*low / PER_METRE, *high / PER_METRE) if occupied else None
            check_extent(str(cloud.path), plan / PER_METRE, before)
            counts += np.bincount(records["kind"], minlength=256)
            low, high = np.minimum(low, plan.min(axis=1)), np.maximum(high, plan.max(axis=1))
            with disk_errors(folder.parent):
                occupied |= buckets.append(plan[0], plan[1], records)
        kinds.append(counts)
        has_colours.append(colours.present)
        dates.append((min(days), max(days)) if days else None)
    if not occupied:
        raise CatalogError(f"{clouds[0].path} has only noise points; leave it out")
    west, south, east, north = (float(side) / PER_METRE for side in (*low, *high))
    return BucketedPoints(
        buckets,
        frozenset(occupied),
        (west, south, east, north),
        tuple(kinds),
        tuple(has_colours),
        out_of_range,
        _over_all(dates),
    )


def _over_all(dates: Sequence[tuple[datetime, datetime] | None]) -> tuple[datetime, datetime] | None:
    known = [pair for pair in dates if pair]
    if len(known) < len(dates):
        return None
    return min(first for first, _ in known), max(last for _, last in known)


class _ByteColours:
    """Converts the colours of one file to bytes; 8 or 16 bits is decided by the first chunk with a colour."""

    def __init__(self) -> None:
        self._shift: int | None = None

    @property
    def present(self) -> bool:
        """Whether any colour so far was not black."""
        return self._shift is not None

    def shift(self, colour: NDArray[np.uint16]) -> int:
        """Return by how many bits the colours of a chunk are moved to the right."""
        if self._shift is None and colour.any():
            self._shift = 8 if colour.max() > BYTE else 0
        return self._shift or 0


def _records(
    chunk: Chunk, frame: MetricTransform, colours: _ByteColours
) -> tuple[Integers, NDArray[np.void]]:
    """Return eastings and northings in stored units, ``(2, n)``, and records with all other fields set."""
    metres = frame.metres(chunk.x, chunk.y, chunk.z)
    colour = np.zeros((1, 3), np.uint16) if chunk.colour is None else chunk.colour
    plan, words = _in_units(*metres, chunk.kind, colour, colours.shift(colour))
    return plan, words.view(RECORD).reshape(-1)


@compiled()
def _in_units(
    easting: Floats,
    northing: Floats,
    height: Floats,
    kind: NDArray[np.uint8],
    colour: NDArray[np.uint16],
    shift: int,
) -> tuple[Integers, Words]:
    """Return plan coordinates, ``(2, n)``, and records of the points whose height is in range."""
    count = 0
    for i in range(height.size):
        count += LOWEST_M <= height[i] <= HIGHEST_M
    plan, words = np.empty((2, count), np.int64), np.zeros((count, WORDS), np.int32)
    k = 0
    for i in range(height.size):
        if LOWEST_M <= height[i] <= HIGHEST_M:
            plan[0, k] = np.rint(easting[i] * PER_METRE)
            plan[1, k] = np.rint(northing[i] * PER_METRE)
            words[k, 2] = np.rint(height[i] * PER_METRE)
            word = np.uint32(kind[i])
            if colour.shape[0] == height.size:
                for band in range(3):
                    shade = np.uint32(min(colour[i, band] >> shift, BYTE))
                    word |= shade << np.uint32(8 * (band + 1))
            words[k, 3] = np.int32(word)
            k += 1
    return plan, words
