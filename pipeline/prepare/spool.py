"""Points of many files in square blocks on disk: each file is decoded once, each block read by itself.

Coordinates are kept in whole tenths of a millimetre: they do not depend on how land is cut into blocks.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, CatalogError, Grid
from flexroad.catalog.headers.point_clouds import CHUNK, Chunk, Cloud, chunks
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks.acquire.types import Points

PER_METRE = 10_000
"""Units of the stored coordinates: tenths of a millimetre."""
RECORD = np.dtype(
    [("east", "<i4"), ("north", "<i4"), ("height", "<i4"), ("kind", "u1"), ("colour", "u1", (3,))]
)
"""East and north from the block's south-west corner."""
LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Heights beyond are nodata, as everywhere in FlexRoad."""
POINTS_PER_BLOCK = 2_000_000
"""What a worker is to hold at once, rim and all."""
SHORTEST_EDGE_M, LONGEST_EDGE_M = 50.0, 500.0
BYTE = 255

Integers = NDArray[np.int64]
Place = tuple[int, int]
"""Column and row of a block: its south-west corner lies at these multiples of the edge."""


def edge_m(clouds: Sequence[Cloud], frame: MetricTransform, reach_m: float, step: float) -> float:
    """Return the edge of blocks that hold about `POINTS_PER_BLOCK` with their rim, in whole steps (m)."""
    points, area = sum(cloud.points for cloud in clouds), 0.0
    for cloud in clouds:
        west, south, east, north = cloud.bounds
        x, y, _ = frame.metres(np.array([west, east]), np.array([south, north]), np.zeros(2))
        area += max(float(abs((x[1] - x[0]) * (y[1] - y[0]))), 1.0)
    return edge_for(points, area, reach_m, step)


def edge_for(points: float, area: float, reach_m: float, step: float) -> float:
    """Return the edge of blocks where so many points lie on so much ground (m2), in whole steps (m)."""
    fitting = math.sqrt(POINTS_PER_BLOCK * area / points) - 2 * reach_m
    edge = LONGEST_EDGE_M if points <= POINTS_PER_BLOCK else np.clip(fitting, SHORTEST_EDGE_M, LONGEST_EDGE_M)
    return max(1, math.floor(edge / step)) * step


@dataclass(frozen=True)
class Blocks:
    """Points in files of square blocks; as in a `Grid`, a border belongs to what lies east or south of it."""

    folder: Path
    edge: float
    """Edge of the blocks (m)."""

    def path(self, place: Place) -> Path:
        """Return the file of a block; it is missing where there are no points."""
        return self.folder / f"{place[0]}_{place[1]}.points"

    def corner(self, place: Place) -> tuple[int, int]:
        """Return easting and northing of a block's south-west corner, in stored units."""
        return round(place[0] * self.edge * PER_METRE), round(place[1] * self.edge * PER_METRE)

    def append(self, east: Integers, north: Integers, records: NDArray[np.void]) -> set[Place]:
        """Add points, ``(n,)``, at eastings and northings in stored units; return the blocks they went to."""
        edge = self.edge * PER_METRE
        col = np.floor(east / edge).astype(np.int64)
        row = np.ceil(north / edge).astype(np.int64) - 1
        width = int(np.ptp(col)) + 1
        block = (row - row.min()) * width + (col - col.min())
        # Numbers of one or two bytes are sorted by radix.
        order = np.argsort(block.astype(np.min_scalar_type(int(block.max()))), kind="stable")
        ends = np.flatnonzero(np.diff(block[order])) + 1
        places = set()
        for which in np.split(order, ends):
            place = int(col[which[0]]), int(row[which[0]])
            corner = self.corner(place)
            part = records[which]
            part["east"], part["north"] = east[which] - corner[0], north[which] - corner[1]
            with self.path(place).open("ab") as file:
                file.write(part.tobytes())
            places.add(place)
        return places

    def over(self, grid: Grid, reach_m: float = 0) -> list[Place]:
        """Return the blocks that a grid and a rim around it lie on, whether they hold points or not."""
        west, south, east, north = (round(side * PER_METRE) for side in grid.buffered(reach_m).bounds)
        edge = self.edge * PER_METRE
        columns = range(math.floor(west / edge), math.floor(east / edge) + 1)
        rows = range(math.ceil(south / edge) - 1, math.ceil(north / edge))
        return list(itertools.product(columns, rows))

    def near(self, grid: Grid, reach_m: float, coloured: bool) -> Points:
        """Return the points on a grid and a rim around it, in an order that follows from them alone."""
        west, south, east, north = (round(side * PER_METRE) for side in grid.buffered(reach_m).bounds)
        easts, norths, rest = [], [], []
        for place in self.over(grid, reach_m):
            if not self.path(place).exists():
                continue
            records, corner = np.fromfile(self.path(place), RECORD), self.corner(place)
            x, y = records["east"].astype(np.int64) + corner[0], records["north"].astype(np.int64) + corner[1]
            inside = (x >= west) & (x <= east) & (y >= south) & (y <= north)
            easts.append(x[inside])
            norths.append(y[inside])
            rest.append(records[inside])
        if not rest:
            return _points(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, RECORD), coloured)
        x, y, records = np.concatenate(easts), np.concatenate(norths), np.concatenate(rest)
        order = _order(x - west, y - south, records)
        return _points(x[order], y[order], records[order], coloured)


def _order(east: Integers, north: Integers, records: NDArray[np.void]) -> NDArray[np.intp]:
    """Return the order by northing, easting and, where points coincide in plan, by all else."""
    plan = (north << 32) | east
    order = np.argsort(plan)
    again = np.flatnonzero(np.diff(plan[order]) == 0)
    again = np.union1d(again, again + 1)
    tied = order[again]
    keys = [records["colour"][tied, band] for band in range(3)]
    order[again] = tied[np.lexsort((*keys, records["kind"][tied], records["height"][tied], plan[tied]))]
    return order


def _points(east: Integers, north: Integers, records: NDArray[np.void], coloured: bool) -> Points:
    # Divided, not multiplied: whole centimetres come back as they were written.
    return Points(
        east / PER_METRE,
        north / PER_METRE,
        records["height"] / PER_METRE,
        records["kind"],
        records["colour"] if coloured else None,
    )


@dataclass(frozen=True, eq=False)
class Spooled:
    """What went into the blocks."""

    blocks: Blocks
    places: frozenset[Place]
    """Blocks with points."""
    bounds: Bounds
    """West, south, east, north of all points (m)."""
    kinds: tuple[Integers, ...]
    """Points by class, ``(256,)``, of each file; without noise."""
    colours: tuple[bool, ...]
    """Whether a file has colours."""
    beyond: int
    """Points left out for heights that cannot be."""

    @property
    def points(self) -> int:
        """Number of points in all blocks."""
        return int(sum(kinds.sum() for kinds in self.kinds))


def spool(
    clouds: Sequence[Cloud], frame: MetricTransform, folder: Path, edge: float, say: Callable[[str], None]
) -> Spooled:
    """Move the points of all files to metres and into blocks; noise and withheld points stay out.

    Parameters
    ----------
    clouds : Sequence[Cloud]
        The files.
    frame : Frame
        From their coordinates to metres.
    folder : Path
        Where the blocks are written; 16 bytes per point.
    edge : float
        Edge of the blocks (m).
    say : Callable[[str], None]
        Told of every file.

    Raises
    ------
    CatalogError
        If a file cannot be read, or no point is left.
    ConfigError
        If the disk is full.
    """
    blocks, places, beyond = Blocks(folder, edge), set[Place](), 0
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    kinds, colours = [], []
    for number, cloud in enumerate(clouds, 1):
        say(f"reading {cloud.path} ({number} of {len(clouds)}, {cloud.points:,} points)")
        counts, colour = np.zeros(256, np.int64), _Colours()
        for chunk in chunks(cloud.path, CHUNK):
            plan, records = _records(chunk, frame, colour)
            beyond += len(chunk.z) - len(records)
            if not len(records):
                continue
            counts += np.bincount(records["kind"], minlength=256)
            low, high = np.minimum(low, plan.min(axis=1)), np.maximum(high, plan.max(axis=1))
            with room(folder.parent):
                places |= blocks.append(plan[0], plan[1], records)
        kinds.append(counts)
        colours.append(colour.seen)
    if not places:
        raise CatalogError(f"{clouds[0].path} has no points but noise; leave it out")
    west, south, east, north = (float(side) / PER_METRE for side in (*low, *high))
    return Spooled(
        blocks, frozenset(places), (west, south, east, north), tuple(kinds), tuple(colours), beyond
    )


class _Colours:
    """Colours of one file as bytes; the first that are not black tell whether they have 8 bits or 16."""

    def __init__(self) -> None:
        self._shift: int | None = None

    @property
    def seen(self) -> bool:
        """Whether there was any."""
        return self._shift is not None

    def bytes(self, colour: NDArray[np.uint16]) -> NDArray[np.uint8]:
        if self._shift is None and colour.any():
            self._shift = 8 if colour.max() > BYTE else 0
        scaled: NDArray[np.uint16] = np.minimum(colour >> (self._shift or 0), BYTE)
        return scaled.astype(np.uint8)


def _records(chunk: Chunk, frame: MetricTransform, colours: _Colours) -> tuple[Integers, NDArray[np.void]]:
    """Return eastings and northings in stored units, ``(2, n)``, and records that lack but these."""
    easting, northing, height = frame.metres(chunk.x, chunk.y, chunk.z)
    kept = (height >= LOWEST_M) & (height <= HIGHEST_M)
    records = np.zeros(int(kept.sum()), RECORD)
    records["height"] = np.rint(height[kept] * PER_METRE)
    records["kind"] = chunk.kind[kept]
    if chunk.colour is not None:
        records["colour"] = colours.bytes(chunk.colour[kept])
    plan = np.stack([easting[kept], northing[kept]])
    return np.rint(plan * PER_METRE).astype(np.int64), records


@contextlib.contextmanager
def room(out: Path) -> Iterator[None]:
    """Turn what goes wrong with the disk into one line.

    Raises
    ------
    ConfigError
        If the disk is full or the folder cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise ConfigError(
            f"cannot write to {out}: {error.strerror or error}; make room and repeat"
        ) from error


@contextlib.contextmanager
def scratch(out: Path) -> Iterator[Path]:
    """Lend a hidden folder inside ``out``, which is made if missing; a failure leaves neither.

    Raises
    ------
    ConfigError
        If the folder cannot be written.
    """
    # Named like a sheet's own, which sweeps those of makers that were killed.
    folder, new = out / f".prepare-points-{os.getpid()}", not out.exists()
    shutil.rmtree(folder, ignore_errors=True)
    with room(out):
        folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if new:
            # Published rasters keep it.
            with contextlib.suppress(OSError):
                out.rmdir()
