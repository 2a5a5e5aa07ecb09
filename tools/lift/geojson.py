"""GeoJSON: the text of the file is copied, and the coordinates of geometries are replaced, with heights.

All other text is copied byte by byte: ids, properties, bounding boxes, members of other programs, and order.
"""

from __future__ import annotations

import json
import math
import mmap
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from flexroad.catalog.guard.open_vector import CRS, vector_name
from flexroad.catalog.text import reason
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.lift.features import (
    BATCH_BYTES,
    BATCH_FEATURES,
    COLUMNS,
    Feature,
    level_columns,
    lifted,
    percent_columns,
    wanted_levels,
)
from flexroad.tools.lift.shapes import COLLECTION, LINE, NAMES, POINT, POLYGON, Shape
from flexroad.tools.lift.types import Frame, Lifted, Options, RunSurface

SUFFIXES = (".geojson", ".json")
DEGREES = "EPSG:4326"
"""The CRS of files that name no CRS, with longitude first."""
SPACE = re.compile(r"[ \t\r\n\x1e]*")
CHUNK = 2**22
LARGEST = 2**28
"""Largest text of one feature."""
NEAR_END = 64
"""An error less than this before the end of the text read so far may be due to the end."""
DECODER = json.JSONDecoder()
DIGITS = 9
"""Decimals of the coordinates of new vertices: 0.1 mm in degrees."""


def frame(source: Path) -> Frame:
    """Return the CRS of a file: longitude and latitude if it names no CRS."""
    vector_name(source)
    with source.open("rb") as data, mmap.mmap(data.fileno(), 0, access=mmap.ACCESS_READ) as text:
        if CRS.search(text) is None:
            return Frame(DEGREES)
    with _opened(source) as file:
        reader = _Reader(file)
        for _ in _pieces(reader):
            if reader.crs:
                return Frame(reader.crs[0])
    return Frame(DEGREES)


def lift(source: Path, out: Path, run: RunSurface, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report."""
    with _opened(source) as file, out.open("w", encoding="latin1", newline="") as copy:
        batch, size, first = list[_Item | str](), 0, 0
        for piece in _pieces(_Reader(file)):
            batch.append(piece)
            size += len(piece if isinstance(piece, str) else piece.text)
            if size > BATCH_BYTES or len(batch) >= 2 * BATCH_FEATURES:
                yield from _written(batch, first, copy, run, options)
                first += sum(isinstance(piece, _Item) for piece in batch)
                batch, size = [], 0
        yield from _written(batch, first, copy, run, options)


def _opened(path: Path) -> TextIO:
    # Each byte is a character, so that text in any encoding that extends ASCII is copied unchanged.
    return path.open(encoding="latin1", newline="")


@dataclass(frozen=True, slots=True, eq=False)
class _Item:
    """A feature, or a geometry outside of features."""

    text: str
    members: dict[str, tuple[Any, int, int]]
    """Each member with the start and end of its value in the text."""

    def of(self, name: str) -> Any:
        """Return the value of a member; None if it is missing."""
        return self.members.get(name, (None,))[0]


def _written(
    batch: list[_Item | str], first: int, copy: TextIO, run: RunSurface, options: Options
) -> Iterator[Lifted]:
    """Write pieces of text with the geometries of features replaced; yield the rows of the features."""
    items = [piece for piece in batch if isinstance(piece, _Item)]
    properties = [values if isinstance(values := item.of("properties"), dict) else {} for item in items]
    names = level_columns(dict.fromkeys(name for values in properties for name in values))
    columns = {name: [_text(values.get(name)) for values in properties] for name in names}
    features = []
    for number, (item, level) in enumerate(
        zip(items, wanted_levels(columns, len(items)), strict=True), first
    ):
        own = item.of("id")
        name = str(number) if own is None else str(_text(own))
        features.append(Feature(name, _shape(item, name), level))
    done = iter(zip(features, lifted(features, run, options), strict=True))
    for piece in batch:
        if isinstance(piece, str):
            copy.write(piece)
            continue
        feature, (shape, row) = next(done)
        edits = [] if shape is None or shape is feature.shape else _coordinates(piece, shape)
        if options.columns and "properties" in piece.members:
            edits.append(_with_columns(piece, row))
        text, at = list[str](), 0
        for start, end, new in sorted(edits):
            text += [piece.text[at:start], new]
            at = end
        copy.write("".join([*text, piece.text[at:]]))
        yield row


def _text(value: Any) -> Any:
    """Return a value with its text decoded: UTF-8, else cp1252."""
    if not isinstance(value, str):
        return value
    try:
        return value.encode("latin1").decode()
    except UnicodeError:
        return value


def _shape(item: _Item, name: str) -> Shape | None:
    value = item.of("geometry") if "geometry" in item.members else None
    if value is None and "geometry" not in item.members and item.of("type") in NAMES:
        value = {key: own[0] for key, own in item.members.items()}
    if value is None:
        return None
    try:
        return _of_json(value)
    except (KeyError, TypeError, ValueError, RecursionError, OverflowError) as error:
        raise TaskError(f"(feature {name}) has a damaged geometry; correct its coordinates") from error


def _of_json(value: dict[str, Any]) -> Shape:
    code = NAMES.index(value["type"])
    if not POINT <= code <= COLLECTION:
        raise ValueError
    if code == COLLECTION:
        parts = [_of_json(part) for part in value["geometries"]]
        return Shape(code, any(part.z for part in parts), False, parts=parts)
    given = value["coordinates"]
    if code > POLYGON:
        parts = [_of_coordinates(code - POLYGON, part) for part in given]
        return Shape(code, any(part.z for part in parts), False, parts=parts)
    return _of_coordinates(code, given)


def _of_coordinates(code: int, given: Any) -> Shape:
    paths = given if code == POLYGON else [[given]] if code == POINT else [given]
    own = [_path(path) for path in paths if path and path != [[]]]
    # Values after the height have no meaning in GeoJSON; they are kept as M.
    width = max((path.shape[1] for path in own), default=2)
    own = [np.pad(path, ((0, 0), (0, width - path.shape[1])), constant_values=np.nan) for path in own]
    return Shape(code, width > 2, width > 3, own)


def _path(positions: Any) -> Floats:
    lengths = {len(position) for position in positions}
    if min(lengths) < 2 or max(lengths) > 4:
        raise ValueError
    if len(lengths) > 1:
        positions = [[*position, *[math.nan] * (max(lengths) - len(position))] for position in positions]
    return np.array(positions, np.float64)


def _coordinates(item: _Item, shape: Shape) -> list[tuple[int, int, str]]:
    """Return the edits that replace the coordinates of the geometry of an item."""
    members = item.members
    if "geometry" in members:
        members, _ = _object(item.text, members["geometry"][1])
    return _edits(item.text, members, shape)


def _edits(text: str, members: dict[str, tuple[Any, int, int]], shape: Shape) -> list[tuple[int, int, str]]:
    if shape.code != COLLECTION:
        _, start, end = members["coordinates"]
        return [(start, end, json.dumps(_lists(shape), allow_nan=False))]
    edits, at = list[tuple[int, int, str]](), members["geometries"][1] + 1
    for part in shape.parts:
        at = SPACE.match(text, at).end()  # type: ignore[union-attr]
        own, end = _object(text, at)
        edits += _edits(text, own, part)
        at = SPACE.match(text, end).end() + 1  # type: ignore[union-attr]
    return edits


def _lists(shape: Shape) -> Any:
    """Return the coordinates of a geometry as lists of GeoJSON."""
    if shape.parts or shape.code > POLYGON:
        return [_lists(part) for part in shape.parts]
    paths = [_positions(path) for path in shape.paths]
    if shape.code == POLYGON:
        return paths
    if shape.code == LINE:
        return paths[0] if paths else []
    return paths[0][0] if paths else []


def _positions(path: Floats) -> list[list[float]]:
    rounded = np.round(path, DIGITS)
    rounded[:, 2] = np.round(path[:, 2], 4)
    return [[value for value in position if not math.isnan(value)] for position in rounded.tolist()]


def _with_columns(item: _Item, row: Lifted) -> tuple[int, int, str]:
    """Return the edit that sets the columns on request in the properties."""
    values, start, end = item.members["properties"]
    new = dict(zip(COLUMNS, percent_columns(row), strict=True))
    if not isinstance(values, dict) or new.keys() & values.keys():
        whole = {**values, **new} if isinstance(values, dict) else new
        return start, end, json.dumps(whole, ensure_ascii=False)
    text = json.dumps(new)[1:-1]
    return end - 1, end - 1, f", {text}" if values else text


class _Reader:
    """The text of a file; only a part is in memory."""

    def __init__(self, file: TextIO) -> None:
        self.file, self.text, self.at, self.ended = file, "", 0, False
        self.crs: list[str | None] = []
        """The CRS in the members ``crs`` of the outermost object; None for a member that is null."""

    def more(self) -> bool:
        """Read more text; return whether there was more."""
        if self.ended:
            return False
        if len(self.text) - self.at > LARGEST:
            raise TaskError(f"has a feature of more than {LARGEST >> 20} MiB, or is not complete JSON")
        try:
            data = self.file.read(max(CHUNK, len(self.text) - self.at))
        except OSError as error:
            raise TaskError(f"cannot be read: {reason(error)}") from error
        self.text, self.at, self.ended = self.text[self.at :] + data, 0, not data
        return bool(data)

    def taken(self, parse: Any) -> Any:
        """Parse the text from here on with a function, reading more text until it succeeds."""
        while True:
            try:
                found, end = parse(self.text, self.at)
                if end < len(self.text) or not self.more():
                    return found, end
            except (ValueError, IndexError) as error:
                at = getattr(error, "pos", len(self.text))
                cut = at > len(self.text) - NEAR_END or "Unterminated" in str(error)
                if not (cut and self.more()):
                    raise TaskError(f"is not complete JSON: {error}; write it again") from error
            except RecursionError as error:
                raise TaskError("has too many lists within each other; write it again") from error

    def item(self) -> _Item:
        """Read an object."""
        members, end = self.taken(_object)
        start = self.at
        own = {name: (value, a - start, b - start) for name, (value, a, b) in members.items()}
        return _Item(self.until(end), own)

    def until(self, end: int) -> str:
        """Return the text up to a place, and continue from there."""
        text, self.at = self.text[self.at : end], end
        return text


def _sign(expected: str) -> Any:
    def parse(text: str, at: int) -> tuple[str, int]:
        at = SPACE.match(text, at).end()  # type: ignore[union-attr]
        if text[at] not in expected:
            raise json.JSONDecodeError(f"Expecting one of {' '.join(expected)}", text, at)
        return text[at], at + 1

    return parse


def _key(text: str, at: int) -> tuple[str, int]:
    """Read the name of a member and the colon after it, up to its value."""
    at = SPACE.match(text, at).end()  # type: ignore[union-attr]
    name, at = DECODER.raw_decode(text, at)
    if not isinstance(name, str):
        raise json.JSONDecodeError("Expecting a name", text, at)
    _, at = _sign(":")(text, at)
    return name, SPACE.match(text, at).end()  # type: ignore[union-attr]


def _object(text: str, at: int) -> tuple[dict[str, tuple[Any, int, int]], int]:
    """Read an object: its members with the start and end of their values."""
    sign, at = _sign("{")(text, at)
    members = dict[str, tuple[Any, int, int]]()
    end = SPACE.match(text, at).end()  # type: ignore[union-attr]
    if text[end] == "}":
        return members, end + 1
    while sign != "}":
        name, at = _key(text, at)
        value, end = DECODER.raw_decode(text, at)
        members[name] = value, at, end
        sign, at = _sign(",}")(text, end)
    return members, at


def _pieces(reader: _Reader) -> Iterator[_Item | str]:
    """Yield a file as features and the text between them; all joined give the file."""
    reader.more()
    if reader.text.startswith("\xef\xbb\xbf"):
        yield reader.until(3)
    if not _is_collection(reader):
        yield reader.until(SPACE.match(reader.text, reader.at).end())  # type: ignore[union-attr]
        yield reader.item()
    else:
        yield from _collection(reader)
    while reader.at < len(reader.text) or reader.more():
        yield reader.until(len(reader.text))


def _is_collection(reader: _Reader) -> bool:
    """Return whether the outermost object is a collection of features, by its members before the features."""
    found = re.compile(r'"(features|geometry|coordinates|geometries)"\s*:')
    while True:
        first = found.search(reader.text, reader.at)
        if first or not reader.more():
            return first is None or first[1] == "features"


def _collection(reader: _Reader) -> Iterator[_Item | str]:
    _, end = reader.taken(_sign("{"))
    yield reader.until(end)
    sign = ","
    while sign == ",":
        name, end = reader.taken(_key)
        if name == "features" and reader.text[end : end + 1] == "[":
            yield reader.until(end + 1)
            yield from _items(reader)
        else:
            before = reader.until(end)
            value, end = reader.taken(DECODER.raw_decode)
            if name == "crs":
                properties = value.get("properties") if isinstance(value, dict) else None
                named = properties.get("name") if isinstance(properties, dict) else None
                reader.crs.append(str(named) if named else None)
            yield before + reader.until(end)
        sign, end = reader.taken(_sign(",}"))
        yield reader.until(end)


def _items(reader: _Reader) -> Iterator[_Item | str]:
    """Yield the features of a collection, and the text between them."""
    sign, end = reader.taken(_first_of_list)
    yield reader.until(end)
    while sign != "]":
        yield reader.item()
        sign, end = reader.taken(_sign(",]"))
        space = SPACE.match(reader.text, end).end()  # type: ignore[union-attr]
        yield reader.until(space if sign == "," else end)


def _first_of_list(text: str, at: int) -> tuple[str, int]:
    """Read up to the first feature of a list, or past the end of an empty list."""
    at = SPACE.match(text, at).end()  # type: ignore[union-attr]
    return (text[at], at + 1) if text[at] == "]" else ("", at)
