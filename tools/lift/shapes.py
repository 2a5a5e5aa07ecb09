"""Geometries as coordinates, with z and m, parts and collections: read from WKB, and written to WKB."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

POINT, LINE, POLYGON, MULTI_POINT, MULTI_LINE, MULTI_POLYGON, COLLECTION = range(1, 8)
NAMES = (
    *("", "Point", "LineString", "Polygon", "MultiPoint", "MultiLineString", "MultiPolygon"),
    *("GeometryCollection", "CircularString", "CompoundCurve", "CurvePolygon", "MultiCurve", "MultiSurface"),
    *("Curve", "Surface", "PolyhedralSurface", "TIN", "Triangle"),
)
"""Types of geometries by their code in WKB; types up to collections are read."""
DEEPEST = 32
"""Largest depth of collections within collections."""


@dataclass(slots=True, eq=False)
class Shape:
    """A geometry of one of the seven simple types."""

    code: int
    z: bool
    m: bool
    paths: list[Floats] = field(default_factory=list)
    """The coordinates of a point, a line, or the rings of a polygon: ``(n, 2 + z + m)`` each."""
    parts: list[Shape] = field(default_factory=list)
    """The geometries of multi-geometries and collections."""

    def all_paths(self) -> Iterator[tuple[int, bool, bool, Floats]]:
        """Yield type, z, m and coordinates of each path of the shape and its parts."""
        for path in self.paths:
            yield self.code, self.z, self.m, path
        for part in self.parts:
            yield from part.all_paths()

    def with_paths(self, paths: Iterator[Floats]) -> Shape:
        """Return the shape with other coordinates, with z, in the order of `all_paths`."""
        own = [next(paths) for _ in self.paths]
        return Shape(self.code, True, self.m, own, [part.with_paths(paths) for part in self.parts])

    def flat(self) -> Shape:
        """Return the shape with a z of 0 where z is missing."""
        if self.z:
            return self
        paths = [np.insert(path, 2, 0.0, axis=1) for path in self.paths]
        return Shape(self.code, True, self.m, paths, [part.flat() for part in self.parts])


def of_wkb(data: bytes | memoryview) -> Shape:
    """Return the geometry of a WKB, in ISO's form or with the flags of EWKB."""
    try:
        shape, _ = _read(data, 0, 0)
    except (struct.error, ValueError, IndexError) as error:
        raise TaskError("has a damaged geometry; repair the file, e.g. with ogr2ogr -makevalid") from error
    return shape


def _read(data: bytes | memoryview, at: int, depth: int) -> tuple[Shape, int]:
    shape, order, at = _head(data, at)
    code, width = shape.code, 2 + shape.z + shape.m
    if code == POINT:
        path, at = _coordinates(data, at, order, 1, width)
        if not np.isnan(path[0, :2]).all():
            shape.paths.append(path)
        return shape, at
    (count,) = struct.unpack_from(order + "I", data, at)
    at += 4
    if code == LINE:
        path, at = _coordinates(data, at, order, count, width)
        if count:
            shape.paths.append(path)
    elif code == POLYGON:
        for _ in range(count):
            (length,) = struct.unpack_from(order + "I", data, at)
            path, at = _coordinates(data, at + 4, order, length, width)
            shape.paths.append(path)
    else:
        if depth == DEEPEST:
            raise TaskError(f"has more than {DEEPEST} collections within each other")
        for _ in range(count):
            part, at = _read(data, at, depth + 1)
            shape.parts.append(part)
    return shape, at


def _head(data: bytes | memoryview, at: int) -> tuple[Shape, str, int]:
    """Return a geometry without its coordinates, the order of bytes, and the place of the coordinates."""
    order = "<" if data[at] else ">"
    (code,) = struct.unpack_from(order + "I", data, at + 1)
    at += 5
    if code & 0x20000000:
        at += 4
    number = code & 0x0FFFFFFF
    z = bool(code & 0x80000000) or number // 1000 in (1, 3)
    m = bool(code & 0x40000000) or number // 1000 in (2, 3)
    code = number % 1000
    if not POINT <= code <= COLLECTION:
        name = NAMES[code] if code < len(NAMES) else f"of the number {code}"
        raise TaskError(
            f"has a geometry of the type {name}; write it as lines and polygons, e.g. "
            "ogr2ogr -nlt CONVERT_TO_LINEAR NEW FILE"
        )
    return Shape(code, z, m), order, at


def _coordinates(data: bytes | memoryview, at: int, order: str, count: int, width: int) -> tuple[Floats, int]:
    values = np.frombuffer(data, order + "f8", count * width, at)
    return values.reshape(count, width).astype(np.float64), at + 8 * count * width


def to_wkb(shape: Shape) -> bytes:
    """Return the WKB of a geometry, in ISO's form."""
    pieces = list[bytes]()
    _write(shape, pieces)
    return b"".join(pieces)


def _write(shape: Shape, pieces: list[bytes]) -> None:
    code = shape.code + 1000 * shape.z + 2000 * shape.m
    if shape.code == POINT:
        path = shape.paths[0] if shape.paths else np.full((1, 2 + shape.z + shape.m), np.nan)
        pieces += [struct.pack("<BI", 1, code), path.astype("<f8").tobytes()]
    elif shape.code == LINE:
        pieces.append(struct.pack("<BII", 1, code, sum(map(len, shape.paths))))
        pieces += [path.astype("<f8").tobytes() for path in shape.paths]
    else:
        pieces.append(struct.pack("<BII", 1, code, len(shape.paths) + len(shape.parts)))
        for path in shape.paths:
            pieces += [struct.pack("<I", len(path)), path.astype("<f8").tobytes()]
        for part in shape.parts:
            _write(part, pieces)
