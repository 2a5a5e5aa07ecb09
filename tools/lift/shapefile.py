"""Shapefile: the geometries are written again, with heights; the table and all other files are copied.

The index of the geometries (``.shx``) is written again, too. Indices of their extents in plan stay valid: new
vertices lie on existing segments.
"""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from flexroad.catalog.guard.open_vector import ERRORS, in_its_encoding, vector_name
from flexroad.catalog.guard.source_files import SHAPEFILE_PARTS
from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import reason
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.lift.features import (
    BATCH_BYTES,
    BATCH_FEATURES,
    Feature,
    level_columns,
    lifted,
    percent_columns,
    vector_info,
    wanted_levels,
    with_zero,
)
from flexroad.tools.lift.shapes import COLLECTION, LINE, MULTI_POINT, POINT, POLYGON, Shape
from flexroad.tools.lift.types import Frame, Lifted, Options, RunSurface

pyogrio = lazy("pyogrio")

SUFFIXES = (".shp",)
KEPT = (*(end for end in SHAPEFILE_PARTS if end not in (".shx", ".dbf")), ".qpj", ".qml", ".sld", ".shp.xml")
"""Files that are copied: projection, encoding, indices, styles, description."""
TYPES = {1: POINT, 3: LINE, 5: POLYGON, 8: MULTI_POINT}
"""Types of geometries by their number in the file, without z (11 and more) and m (21 and more)."""
NO_M = -1e39
"""Value that means: no m."""
COLUMNS = (b"grade_pct", b"crossf_pct", b"error_m")
"""The requested columns; names have at most ten characters in this format."""
WIDTH, DECIMALS = 12, 4


_Record = tuple[int, bytes]
"""Number and data of a geometry of the file."""


def frame(source: Path) -> Frame:
    """Return the CRS in the ``.prj``."""
    return Frame(vector_info(source)["crs"])


def lift(source: Path, out: Path, run: RunSurface, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report."""
    vector_name(source)
    parts = _parts(source)
    for end in KEPT:
        if end in parts:
            shutil.copyfile(parts[end], out.with_suffix(end))
    rows = _lifted(source, out, run, options)
    table = parts.get(".dbf")
    if table is None:
        yield from rows
    elif options.columns:
        yield from _with_columns(table, out.with_suffix(".dbf"), rows)
    else:
        shutil.copyfile(table, out.with_suffix(".dbf"))
        yield from rows


def _parts(source: Path) -> dict[str, Path]:
    """Return the files beside a Shapefile by their ending in small letters."""
    found = dict[str, Path]()
    for end in (*KEPT, ".shx", ".dbf"):
        for case in (end, end.upper()):
            path = source.with_suffix(case)
            if path.is_file() and not path.is_symlink():
                found.setdefault(end, path)
    return found


def _lifted(source: Path, out: Path, run: RunSurface, options: Options) -> Iterator[Lifted]:
    """Write ``.shp`` and ``.shx``; yield the rows."""
    with ExitStack() as stack:
        file = stack.enter_context(source.open("rb"))
        shapes = stack.enter_context(out.open("wb"))
        index = stack.enter_context(out.with_suffix(".shx").open("wb"))
        header = file.read(100)
        if len(header) < 100:
            raise TaskError("is a damaged Shapefile: it has no header; repair it with ogr2ogr")
        (code,) = struct.unpack_from("<i", header, 32)
        if code % 10 not in TYPES or code > 28:
            raise TaskError(
                f"has geometries of the type {code}, not points, lines or polygons; write "
                "them as such with ogr2ogr -nlt"
            )
        copy = _Copy(shapes, index, code % 10, header)
        for records, levels in _batches(source, file):
            features = []
            for (number, data), level in zip(records, levels, strict=True):
                try:
                    shape = _shape(data, code)
                except (struct.error, ValueError) as error:
                    raise TaskError(
                        f"has the damaged feature {number}; repair the file with ogr2ogr"
                    ) from error
                features.append(Feature(str(number), shape, level))
            for shape, row in lifted(features, run, options):
                shape, row = with_zero(shape, row)
                copy.add(shape)
                yield row
        copy.finish()


def _batches(source: Path, file: BinaryIO) -> Iterator[tuple[list[_Record], list[int]]]:
    """Yield geometries in the order of the file, with the levels in their attributes."""
    batch, size, first = list[_Record](), 0, 0
    for record in _records(file):
        batch.append(record)
        size += len(record[1])
        if size > BATCH_BYTES or len(batch) == BATCH_FEATURES:
            yield batch, _levels(source, first, len(batch))
            first += len(batch)
            batch, size = [], 0
    if batch:
        yield batch, _levels(source, first, len(batch))


def _records(file: BinaryIO) -> Iterator[_Record]:
    whole, at, number = os.fstat(file.fileno()).st_size, 100, 0
    while head := file.read(8):
        size = 2 * struct.unpack(">ii", head)[1] if len(head) == 8 else -1
        at += 8 + size
        if size < 4 or at > whole:
            raise TaskError("is a damaged Shapefile: it ends in a feature; repair it with ogr2ogr")
        yield number, file.read(size)
        number += 1


def _levels(source: Path, first: int, count: int) -> list[int]:
    """Return the levels of some features."""
    columns = level_columns(vector_info(source)["fields"])
    if not columns:
        return wanted_levels({}, count)
    try:
        options: dict[str, Any] = {"skip_features": first, "max_features": count, "columns": columns}
        read = partial(pyogrio.read_dataframe, vector_name(source), read_geometry=False, **options)
        table, _ = in_its_encoding(read)
    except ERRORS as error:
        raise TaskError(f"cannot be read: {reason(error)}") from error
    if len(table) != count:
        raise TaskError(
            "is a damaged Shapefile: its table has another number of rows; repair it with ogr2ogr"
        )
    return wanted_levels({name: table[name].tolist() for name in columns}, count)


def _shape(data: bytes, of_file: int) -> Shape | None:
    (code,) = struct.unpack_from("<i", data)
    if code == 0:
        return None
    if code != of_file:
        raise ValueError
    kind, z, has_m = TYPES[code % 10], 10 < code < 20, code > 10
    if kind == POINT:
        values = np.frombuffer(data, "<f8", 4 if z and len(data) >= 36 else 2 + z + (has_m and not z), 4)
        m = has_m and len(values) > 2 + z and values[-1] > -1e38
        return Shape(POINT, z, bool(m), [values[None, : 2 + z + m].astype(np.float64)])
    at, lines = 36, 1
    if kind != MULTI_POINT:
        lines, count = struct.unpack_from("<ii", data, at)
        starts = np.frombuffer(data, "<i4", lines, at + 8)
        at += 8 + 4 * lines
    else:
        (count,) = struct.unpack_from("<i", data, at)
        starts, at = np.zeros(1, np.int32), at + 4
    columns = [np.frombuffer(data, "<f8", 2 * count, at).reshape(-1, 2)]
    at += 16 * count
    if z:
        columns.append(np.frombuffer(data, "<f8", count, at + 16)[:, None])
        at += 16 + 8 * count
    m = has_m and len(data) >= at + 16 + 8 * count
    if m:
        columns.append(np.frombuffer(data, "<f8", count, at + 16)[:, None])
    values = np.hstack(columns).astype(np.float64)
    if kind == MULTI_POINT:
        return Shape(kind, z, m, parts=[Shape(POINT, z, m, [row[None]]) for row in values])
    if len(starts) and (starts[0] != 0 or (np.diff(starts) < 0).any() or starts[-1] > count):
        raise ValueError
    # The rings of all polygons of a feature follow each other, like the parts of lines.
    paths = [path for path in np.split(values, starts[1:]) if len(path)]
    if kind == POLYGON:
        return Shape(kind, z, m, paths)
    return Shape(COLLECTION, z, m, parts=[Shape(LINE, z, m, [path]) for path in paths])


class _Copy:
    """The files ``.shp`` and ``.shx`` that are written."""

    def __init__(self, shapes: BinaryIO, index: BinaryIO, code: int, header: bytes) -> None:
        self.shapes, self.index, self.code, self.header = shapes, index, 10 + code, header
        self.count, self.at = 0, 100
        self.low, self.high = np.full(2, np.inf), np.full(2, -np.inf)
        """Least and largest z and m."""
        for file in (shapes, index):
            file.write(bytes(100))

    def add(self, shape: Shape | None) -> None:
        """Write a geometry."""
        paths = [] if shape is None else [(m, path) for _, _, m, path in shape.all_paths()]
        data = self._content([path for _, path in paths], any(m for m, _ in paths)) if paths else bytes(4)
        self.count += 1
        self.index.write(struct.pack(">ii", self.at // 2, len(data) // 2))
        self.shapes.write(struct.pack(">ii", self.count, len(data) // 2) + data)
        self.at += 8 + len(data)

    def _content(self, paths: list[Floats], m: bool) -> bytes:
        values = np.concatenate(paths)
        ranges = self._ranges(values, m)
        head = struct.pack("<i", self.code)
        if self.code == 11:
            own = values[0] if m else np.append(values[0], NO_M)
            return head + own.astype("<f8").tobytes()
        box = np.concatenate([values[:, :2].min(axis=0), values[:, :2].max(axis=0)])
        pieces = [head, box.astype("<f8").tobytes()]
        if self.code != 18:
            starts = np.cumsum([0, *(len(path) for path in paths[:-1])])
            pieces += [struct.pack("<ii", len(paths), len(values)), starts.astype("<i4").tobytes()]
        else:
            pieces.append(struct.pack("<i", len(values)))
        pieces.append(values[:, :2].astype("<f8").tobytes())
        for column in range(2, 3 + m):
            pieces += [struct.pack("<dd", *ranges[column - 2]), values[:, column].astype("<f8").tobytes()]
        return b"".join(pieces)

    def _ranges(self, values: Floats, m: bool) -> list[tuple[float, float]]:
        found = []
        for column in range(2, 3 + m):
            known = values[:, column][values[:, column] > -1e38]
            low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
            self.low[column - 2] = min(self.low[column - 2], low)
            self.high[column - 2] = max(self.high[column - 2], high)
            found.append((low, high))
        return found

    def finish(self) -> None:
        """Write the headers: the header of the source with the new type, length and range of z."""
        bounds = np.where(np.isfinite(self.low), [self.low, self.high], 0.0)
        for file, size in ((self.shapes, self.at), (self.index, 100 + 8 * self.count)):
            file.seek(0)
            plan = self.header[36:68]
            file.write(self.header[:24] + struct.pack(">i", size // 2) + self.header[28:32])
            file.write(struct.pack("<i", self.code) + plan + bounds.T.astype("<f8").tobytes())


def _with_columns(source: Path, out: Path, rows: Iterator[Lifted]) -> Iterator[Lifted]:
    """Copy the table with the requested columns, filled from the rows."""
    with source.open("rb") as file, out.open("wb") as copy:
        head = file.read(32)
        (count, start, width) = struct.unpack_from("<IHH", head, 4) if len(head) == 32 else (0, 0, 0)
        fields = file.read(max(start - 32, 0))
        end = fields.find(b"\r")
        if end < 0 or end % 32:
            raise TaskError("has a damaged table (.dbf); repair it with ogr2ogr")
        names = {fields[i : i + 11].split(b"\0")[0].lower() for i in range(0, end, 32)}
        if names & set(COLUMNS):
            taken = b", ".join(sorted(names & set(COLUMNS))).decode()
            raise TaskError(f"has the columns {taken} already; remove them, or leave out --columns")
        new = b"".join(
            name.ljust(11, b"\0") + b"N" + bytes(4) + bytes([WIDTH, DECIMALS]) + bytes(14) for name in COLUMNS
        )
        sizes = struct.pack("<IHH", count, start + len(new), width + WIDTH * len(COLUMNS))
        copy.write(head[:4] + sizes + head[12:] + fields[:end] + new + fields[end:])
        for row in rows:
            data = file.read(width)
            if len(data) != width:
                raise TaskError("has a table (.dbf) with fewer rows than features; repair it with ogr2ogr")
            values = percent_columns(row)
            texts = ("" if value is None else f"{value:.{DECIMALS}f}" for value in values)
            copy.write(data + "".join(text[:WIDTH].rjust(WIDTH) for text in texts).encode())
            yield row
        copy.write(file.read())
