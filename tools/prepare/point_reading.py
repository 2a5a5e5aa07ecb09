"""Points of many files, decoded by jobs and sorted into buckets on disk; each point is decoded once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from itertools import groupby
from pathlib import Path

import numpy as np

from flexroad.catalog import Bounds, CatalogError
from flexroad.catalog.scan.point_clouds import CHUNK, Chunk, Cloud, chunks
from flexroad.catalog.tile import HIGHEST_M, LOWEST_M
from flexroad.catalog.to_metres import Floats, MetricTransform
from flexroad.pipeline.execute import Executor
from flexroad.tools.prepare.options import check_extent
from flexroad.tools.prepare.output import disk_errors, on_failure
from flexroad.tools.prepare.point_buckets import (
    PER_METRE,
    RECORD,
    BlockIndex,
    BlockPart,
    Integers,
    PointBuckets,
    Records,
    append,
)

Dates = tuple[datetime, datetime]
"""Times of the first and the last point."""
GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(seconds=10**9)
"""The zero of adjusted standard GPS time (ASPRS LAS 1.4), without leap seconds."""
FIRST_GPS = (datetime(1990, 1, 1, tzinfo=UTC) - GPS_EPOCH).total_seconds()
WEEK_S = 604_800
SHIFT, BYTE = 8, 255
"""Number of bits by which 16-bit colours are shifted to the right, and the largest 8-bit colour."""


@dataclass(frozen=True, eq=False)
class BucketedPoints:
    """The points in the buckets, and statistics of the input files."""

    buckets: PointBuckets
    bounds: Bounds
    """Bounds of all points: west, south, east, north (m)."""
    kinds: tuple[Integers, ...]
    """Number of points of each class, ``(256,)``, per file; without noise."""
    has_colours: tuple[bool, ...]
    """Whether the points have colours, per file."""
    out_of_range: int
    """Number of points left out because their height is outside `LOWEST_M`..`HIGHEST_M`."""
    dates: Dates | None = None
    """Times of the first and the last point; None if they are unknown for a file."""

    @property
    def occupied(self) -> frozenset[BlockIndex]:
        """The blocks with points."""
        return frozenset(self.buckets.parts)

    @property
    def points(self) -> int:
        """Number of points in all buckets."""
        return int(sum(kinds.sum() for kinds in self.kinds))


@dataclass(frozen=True)
class _Job:
    """The input of a worker call that reads a part of a file."""

    cloud: Cloud
    file: int
    """Number of the file."""
    points: range
    frame: MetricTransform
    edge: float
    """Edge of a block (m)."""
    target: Path
    """File of the points."""
    shift: int | None = None
    """Number of bits by which colours are shifted to the right; None: `_Part.shift`."""


@dataclass(frozen=True, eq=False)
class _Part:
    """The result of a job."""

    job: _Job
    block_parts: list[BlockPart]
    outermost: Integers
    """Easting and northing of the western-, southern-, eastern- and northernmost point, ``(2, 4)``, in stored
    units; ``(2, 0)`` without points."""
    kinds: Integers
    """Number of points of each class, ``(256,)``."""
    out_of_range: int
    dates: Dates | None
    shift: int | None
    """`SHIFT` if the first chunk with colours other than black has 16 bits, 0 if 8, None if all are black."""


def bucket_points(
    clouds: Sequence[Cloud],
    frame: MetricTransform,
    folder: Path,
    edge: float,
    executor: Executor,
    log: Callable[[str], None],
) -> BucketedPoints:
    """Move the points of all files to metres and sort them into buckets, except noise and withheld points.

    - `folder`: folder for the files of points; they take 16 bytes per point.
    - `executor`: runs a worker call per million points.
    """
    parts: list[_Part] = []
    bounds: Bounds | None = None
    fail = on_failure(lambda job: job.cloud.path)
    for part in executor.map(_read, _jobs(clouds, frame, folder, edge, log), fail):
        parts.append(part)
        if part.block_parts:
            bounds = check_extent(str(part.job.cloud.path), part.outermost / PER_METRE, bounds)
    if bounds is None:
        raise CatalogError(f"{clouds[0].path} has only noise points; leave it out")
    parts.sort(key=lambda part: (part.job.file, part.job.points.start))
    of_files = [list(of_file) for _, of_file in groupby(parts, lambda part: part.job.file)]
    again = list[_Job]()
    for of_file in of_files:
        # Whether colours have 8 or 16 bits is decided by the first part of a file that has colours.
        shift = next((part.shift for part in of_file if part.shift is not None), None)
        again += [replace(part.job, shift=shift) for part in of_file if part.shift not in (None, shift)]
    for _ in executor.map(_read, again, fail):
        pass
    dates = [_span(part.dates for part in of_file) for of_file in of_files]
    return BucketedPoints(
        PointBuckets.of(edge, (own for part in parts for own in part.block_parts)),
        bounds,
        tuple(np.sum([part.kinds for part in of_file], axis=0) for of_file in of_files),
        tuple(any(part.shift is not None for part in of_file) for of_file in of_files),
        sum(part.out_of_range for part in parts),
        None if None in dates else _span(dates),
    )


def _jobs(
    clouds: Sequence[Cloud],
    frame: MetricTransform,
    folder: Path,
    edge: float,
    log: Callable[[str], None],
) -> Iterator[_Job]:
    for number, cloud in enumerate(clouds):
        log(f"reading {cloud.path} ({number + 1} of {len(clouds)}, {cloud.points:,} points)")
        for points in cloud.parts(CHUNK):
            yield _Job(cloud, number, points, frame, edge, folder / f"{number}_{points.start}.points")


def _span(dates: Iterable[Dates | None]) -> Dates | None:
    """Return the first and the last of the known dates; None if all are unknown."""
    known = [pair for pair in dates if pair]
    return (min(first for first, _ in known), max(last for _, last in known)) if known else None


def _read(job: _Job) -> _Part:
    path, shift = job.cloud.path, job.shift
    block_parts, outermost = list[BlockPart](), np.zeros((2, 0), np.int64)
    kinds, out_of_range, dates = np.zeros(256, np.int64), 0, list[Dates | None]()
    with disk_errors(job.target.parent.parent):
        # A worker that died may have written a part of the file.
        job.target.unlink(missing_ok=True)
    for chunk in chunks(path, CHUNK, points=job.points):
        if shift is None and chunk.colour is not None and chunk.colour.any():
            shift = SHIFT if chunk.colour.max() > BYTE else 0
        try:
            plan, records = _records(chunk, job.frame, shift or 0)
        except CatalogError as error:
            raise CatalogError(f"{path}: {error}") from error
        dates.append(None if chunk.gps is None else _survey_dates(chunk.gps))
        out_of_range += len(chunk.z) - len(records)
        if not len(records):
            continue
        check_extent(str(path), plan / PER_METRE)
        points = np.concatenate([outermost, plan], axis=1)
        outermost = points[:, [*points.argmin(axis=1), *points.argmax(axis=1)]]
        kinds += np.bincount(records["kind"], minlength=256)
        with disk_errors(job.target.parent.parent):
            block_parts += append(job.target, job.edge, plan[0], plan[1], records)
    return _Part(job, block_parts, outermost, kinds, out_of_range, _span(dates), shift)


def _records(chunk: Chunk, frame: MetricTransform, shift: int) -> tuple[Integers, Records]:
    """Return eastings and northings in stored units, ``(2, n)``, and records with all other fields."""
    metres = frame.metres(chunk.x, chunk.y, chunk.z)
    in_range = (metres[2] >= LOWEST_M) & (metres[2] <= HIGHEST_M)
    east, north, height = (np.rint(axis[in_range] * PER_METRE).astype(np.int64) for axis in metres)
    records = np.zeros(len(height), RECORD)
    records["height"], records["kind"] = height, chunk.kind[in_range]
    if chunk.colour is not None:
        records["colour"] = np.minimum(chunk.colour[in_range] >> shift, BYTE)
    return np.stack([east, north]), records


def _survey_dates(gps: Floats) -> Dates | None:
    """Return the dates of the first and the last point; None if no time can belong to a survey.

    - `gps`: see `Chunk.gps`. Times of a week (0 to 604,800 s) are left out: some files have them although
      their header declares standard times. Times before 1990 and in the future are left out, too.
    """
    latest = (datetime.now(UTC) - GPS_EPOCH).total_seconds()
    times = gps[np.isfinite(gps) & ((gps < 0) | (gps > WEEK_S)) & (gps > FIRST_GPS) & (gps < latest)]
    if not len(times):
        return None
    first, last = (GPS_EPOCH + timedelta(seconds=float(time)) for time in (times.min(), times.max()))
    return first, last
