"""Point clouds (LAS, LAZ, COPC): read their headers, and their points in chunks."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.guard import las_header
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.inputs import files_of
from flexroad.catalog.text import access_reason, one_line

laspy = lazy("laspy")

T = TypeVar("T")
Floats = NDArray[np.float64]

NOISE = (7, 18)
"""Classes of low and high noise (ASPRS LAS 1.4)."""
CHUNK = 1_000_000
"""Points decoded at a time, so that memory does not grow with the file."""
CHUNK_BYTES = 256 * 2**20
"""Largest size of points decoded at a time; a point has at most 64 KiB."""
RGB = ("red", "green", "blue")
USED = ("Z", "CLASSIFICATION", "FLAGS", "RGB", "GPS_TIME")
"""Fields that are decoded besides the coordinates in plan, as laspy calls them."""
DEGREES = 360.0
SLACK = 0.01
"""Points may exceed the header's bounds by this fraction of the extent plus one unit."""


@dataclass(frozen=True)
class Cloud:
    """The header of a point cloud; coordinates and heights in the file's own units."""

    path: Path
    points: int
    bounds: Bounds
    """West, south, east, north."""
    heights: tuple[float, float]
    """Lowest and highest."""
    crs: str | None
    """As WKT, or None if the file has no valid CRS."""
    has_colours: bool
    """Whether the point format has colours; they may all be zero."""
    created: date | None
    """Date when the file was written (not of the survey), or None."""
    has_dates: bool = False
    """Whether the header declares GPS times as standard, so that they are dates and not seconds of a week."""
    chunk: int = 0
    """Number of points of the largest chunk of a compressed file, which are decoded together; else 0."""

    def parts(self, size: int) -> list[range]:
        """Return ranges of about ``size`` points that can be decoded apart; larger if chunks are larger."""
        step = size * max(1, math.ceil(self.chunk / size))
        return [range(first, min(first + step, self.points)) for first in range(0, self.points, step)]


@dataclass(frozen=True, eq=False)
class Chunk:
    """Some points of a cloud, ``(n,)`` each, in the file's own units."""

    x: Floats
    y: Floats
    z: Floats
    kind: NDArray[np.uint8]
    """Class by ASPRS, ``(n,)``."""
    colour: NDArray[np.uint16] | None
    """Red, green, blue as stored, ``(n, 3)``, or None if the file has none."""
    gps: Floats | None = None
    """Seconds of GPS since 1980-01-06, less 10^9, ``(n,)``, or None if the file has no standard GPS times."""


def find(inputs: Collection[Path]) -> tuple[Path, ...]:
    """Return the clouds among files and folders, each once, ordered by path."""
    clouds = {file.resolve(): file for file in files_of(inputs, "points")}
    return tuple(clouds[path] for path in sorted(clouds))


def inspect(path: Path) -> Cloud:
    """Read the header of a cloud."""
    largest = _checked(path)
    with _opened(path) as reader:
        cloud = _attempt(path, lambda: _cloud(path, reader.header, largest))
        needed = reader.header.offset_to_point_data + cloud.points * reader.header.point_format.size
        plain = not reader.header.are_points_compressed
    if cloud.points == 0:
        raise CatalogError(f"{path} has no points; leave it out, or write it again")
    if not np.isfinite((*cloud.bounds, *cloud.heights)).all():
        raise CatalogError(f"{path} is damaged: its header gives no bounds; download it again")
    if plain and path.stat().st_size < needed:
        raise CatalogError(
            f"{path} is cut short: {path.stat().st_size:,} of {needed:,} bytes; download it again"
        )
    return cloud


def _cloud(path: Path, header: Any, largest: int) -> Cloud:
    west, south, low = map(float, header.mins)
    east, north, high = map(float, header.maxs)
    bounds = west, south, east, north
    return Cloud(
        path,
        header.point_count,
        bounds,
        (low, high),
        _crs(header, bounds),
        set(RGB) <= set(header.point_format.dimension_names),
        header.creation_date if header.creation_date and header.creation_date.year > 1 else None,
        _has_dates(header),
        largest // header.point_format.size,
    )


def _has_dates(header: Any) -> bool:
    has_times = "gps_time" in header.point_format.dimension_names
    # 1 in LAS: adjusted standard GPS time; 0: seconds of the week.
    return has_times and int(header.global_encoding.gps_time_type) == 1


def chunks(
    path: Path, size: int = CHUNK, drop: Collection[int] = NOISE, points: range | None = None
) -> Iterator[Chunk]:
    """Yield the points of a cloud, decoded once; withheld points are left out.

    - `points`: points to decode, in the order of the file; None: all.
    """
    _checked(path)
    with _opened(path, fields=USED) as reader:
        header = reader.header
        wanted = range(header.point_count) if points is None else points
        done = wanted.start
        low, high = np.asarray(header.mins), np.asarray(header.maxs)
        slack = SLACK * (high - low) + 1
        size = max(1, min(size, CHUNK_BYTES // header.point_format.size))
        limits = low - slack, high + slack
        if done:
            _attempt(path, lambda: reader.seek(done))
        while done < wanted.stop:
            number = min(size, wanted.stop - done)
            read = _attempt(path, functools.partial(reader.read_points, number), f" after {done:,} points")
            if not len(read):
                break
            done += len(read)
            yield _attempt(path, functools.partial(_chunk, path, read, limits, drop, _has_dates(header)))
    if done != wanted.stop:
        raise CatalogError(
            f"{path} is cut short: {done:,} of {header.point_count:,} points; download it again"
        )


def _chunk(
    path: Path, points: Any, limits: tuple[Floats, Floats], drop: Collection[int], has_dates: bool
) -> Chunk:
    x, y, z = (np.asarray(axis, np.float64) for axis in (points.x, points.y, points.z))
    for axis, low, high in zip((x, y, z), *limits, strict=True):
        if axis.min() < low or axis.max() > high:
            raise CatalogError(
                f"{path} is damaged: its header gives {low:.0f} to {high:.0f} where its points have "
                f"{axis.min():.0f} to {axis.max():.0f}; download it again"
            )
    kind = np.asarray(points.classification, np.uint8)
    colour = None
    if set(RGB) <= set(points.point_format.dimension_names):
        colour = np.stack([np.asarray(points[name], np.uint16) for name in RGB], axis=1)
    kept = ~(np.asarray(points.withheld, bool) | np.isin(np.arange(256), list(drop))[kind])
    gps = np.asarray(points.gps_time, np.float64) if has_dates else None
    if kept.all():
        return Chunk(x, y, z, kind, colour, gps)
    colour = None if colour is None else colour[kept]
    return Chunk(x[kept], y[kept], z[kept], kind[kept], colour, None if gps is None else gps[kept])


def _checked(path: Path) -> int:
    """Check that a file exists, and its header; return the size of its largest chunk (bytes)."""
    if not _attempt(path, path.is_file):
        missing = "is not a file" if path.exists() else "does not exist"
        raise CatalogError(f"{path} {missing}; give LAS or LAZ files, or folders of them")
    return _attempt(path, lambda: las_header.check(path))


def _opened(path: Path, fields: Collection[str] = ()) -> Any:
    """Open a checked cloud. Only the named fields of compressed points are decoded; without names, all."""
    selection = {}
    if fields:
        # Formats before LAS 1.4 are always decoded completely.
        chosen = laspy.DecompressionSelection.xy_returns_channel()
        for name in fields:
            chosen |= laspy.DecompressionSelection[name]
        selection = {"decompression_selection": chosen}
    # The parallel decoder allocates a complete chunk, which may have 2^32 points by the header. In files with
    # chunks of different sizes, such as COPC, it finds wrong points (laz-rs #62).
    return _attempt(path, lambda: laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, **selection))


def _attempt(path: Path, read: Callable[[], T], when: str = "") -> T:
    """Return the result of ``read``; turn any error of the decoders into a `CatalogError` of one line."""
    try:
        return read()
    except CatalogError:
        raise
    except BaseException as error:
        # For a damaged file, laspy raises exceptions of many types, and lazrs one that is no `Exception`.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        if isinstance(error, ImportError):
            raise
        if why := access_reason(error):
            raise CatalogError(f"{path} {why}{when}") from error
        raise CatalogError(
            f"{path} cannot be read as a point cloud{when}: {one_line(error)}; download it again"
        ) from error


def _crs(header: Any, bounds: Bounds) -> str | None:
    try:
        crs = header.parse_crs()
    except Exception:  # laspy and pyproj raise many types for damaged records
        return None
    # GeoTIFF keys of a user-defined projection also name its geographic base CRS, which laspy then returns.
    if crs is None or (crs.is_geographic and max(map(abs, bounds)) > DEGREES):
        return None
    text: str = crs.to_wkt()
    return text
