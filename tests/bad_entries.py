"""Entries of catalogs that cannot be used: changes of a valid entry, each with a part of its message."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flexroad.catalog.geoparquet import row

DELETED = object()
CONTROL = "a\x1b[2Jb"


@dataclass(frozen=True)
class Change:
    """One value of an entry that is replaced."""

    name: str
    keys: tuple[str | int, ...]
    """Where the value is in the entry."""
    value: Any
    message: str
    """A part of the message, a regular expression."""
    parquet: bool = False
    """Whether a file in GeoParquet can hold it, too."""
    keeps_id: bool = True

    def apply(self, entry: Any) -> Any:
        """Return a copy of the entry with the change."""
        entry = json.loads(json.dumps(entry))
        if not self.keys:
            return self.value
        *path, last = self.keys
        parent = entry
        for key in path:
            parent = parent[key]
        if self.value is DELETED:
            del parent[last]
        else:
            parent[last] = self.value
        return entry


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def _id(name: str, value: Any, message: str, parquet: bool = True) -> Change:
    return Change(f"id {name}", ("id",), value, message, parquet, keeps_id=False)


def _shape(name: str, value: Any, message: str = "proj:shape", parquet: bool = False) -> Change:
    return Change(f"shape {name}", ("properties", "proj:shape"), value, message, parquet)


def _transform(name: str, value: Any, message: str = "proj:transform", parquet: bool = True) -> Change:
    return Change(f"transform {name}", ("properties", "proj:transform"), value, message, parquet)


def _property(name: str, value: Any, message: str = "", parquet: bool = False) -> Change:
    shown = "deleted" if value is DELETED else f"{value!r:.20}"
    return Change(f"{name} {shown}", ("properties", name), value, message or name, parquet)


def _dsm(name: str, key: str, value: Any, parquet: bool = True) -> Change:
    field = f"flexroad:{key}"
    return Change(f"{key} {name}", ("assets", "dsm", field), value, f"assets.dsm.{field}", parquet)


WEST, NORTH = 500000.0, 5600000.0
CHANGES = (
    _id("of the wrong type", 17, "id: 17 is not a text", parquet=False),
    _id("null", None, "id: None is not a text"),
    _id("a list", ["a"], "id: .* is not a text", parquet=False),
    _id("empty", "", "id: .* is empty"),
    _id("blank", "  ", "id: .* is empty"),
    _id("too long", "x" * 300, "id: .* 300 bytes, more than 100"),
    _id("too long in UTF-8", "ü" * 51, "id: .* 102 bytes, more than 100"),
    _id("with NUL", "a\0b", r"id: .*'a\\x00b' has characters that cannot be printed"),
    _id("with an escape sequence", CONTROL, r"id: .*\\x1b"),
    _id("with a line break", "a\nb", r"id: .*\\n"),
    _id("with a lone surrogate", "a\ud800", r"id: .*\\ud800", parquet=False),
    _id("with reversed text", "a\u202eb", r"id: .*\\u202e"),
    Change("id deleted", ("id",), DELETED, "id: missing", keeps_id=False),
    Change("entry a number", (), 17, "not an object", keeps_id=False),
    Change("entry null", (), None, "not an object", keeps_id=False),
    Change("entry a list", (), [], "not an object", keeps_id=False),
    Change("entry empty", (), {}, "missing", keeps_id=False),
    Change("properties deleted", ("properties",), DELETED, "properties: missing"),
    Change("properties null", ("properties",), None, "properties"),
    Change("properties a list", ("properties",), [], "properties"),
    _shape("zero", [0, 60], "at least one cell", parquet=True),
    _shape("negative", [60, -60], "at least one cell", parquet=True),
    _shape("fractional", [60.5, 60]),
    _shape("text", ["60", 60]),
    _shape("true", [True, 60]),
    _shape("null", None, parquet=True),
    _shape("of null", [None, 60], parquet=True),
    _shape("empty", [], parquet=True),
    _shape("of three", [60, 60, 60], parquet=True),
    _shape("huge", [10**9, 10**9], "more than", parquet=True),
    _shape("beyond 64 bits", [10**30, 60]),
    _shape("nested", _nested(80)),
    _transform("of zeros", [0.0] * 6, "cell"),
    _transform("negative", [-1.0, 0, WEST, 0, 1.0, NORTH], "cell"),
    _transform("rotated", [0.8, 0.6, WEST, 0.6, -0.8, NORTH], "rotated"),
    _transform("not square", [1.0, 0, WEST, 0, -2.0, NORTH], "square"),
    _transform("south up", [1.0, 0, WEST, 0, 1.0, NORTH], "square"),
    _transform("NaN", [1.0, 0, math.nan, 0, -1.0, NORTH]),
    _transform("infinite", [1.0, 0, WEST, 0, -1.0, math.inf]),
    _transform("far away", [1.0, 0, 1e300, 0, -1.0, NORTH], "beyond"),
    _transform("beyond floats", [1.0, 0, 10**400, 0, -1.0, NORTH], parquet=False),
    _transform("with huge cells", [1e200, 0, WEST, 0, -1e200, NORTH], "cell"),
    _transform("with tiny cells", [1e-200, 0, WEST, 0, -1e-200, NORTH], "cell"),
    _transform("text", "1 0 0 0 1 0", parquet=False),
    _transform("short", [1.0, 0.0], parquet=True),
    _transform("empty", []),
    _transform("deleted", DELETED),
    _property("proj:code", "EPSG:999999", "unknown CRS", parquet=True),
    _property("proj:code", "EPSG:4326", "not in metres", parquet=True),
    _property("proj:code", "EPSG:25832\0", "unknown CRS", parquet=True),
    _property("proj:code", "EPSG:\ud800", "proj:code"),
    _property("proj:code", 25832),
    _property("proj:code", DELETED, parquet=True),
    _property("datetime", "yesterday"),
    _property("datetime", "0001-01-01T00:00:00+23:00"),
    _property("datetime", "10000-01-01T00:00:00Z"),
    _property("datetime", None, parquet=True),
    _property("datetime", 10**30),
    _property("flexroad:stratum", ["urban"]),
    _property("flexroad:stratum", "\ud800", "flexroad:stratum"),
    _property("flexroad:dataset", "x" * 10**5, "flexroad:dataset", parquet=True),
    _property("flexroad:datetime_assumed", "no"),
    _property("flexroad:root", "a\0b", "flexroad:root", parquet=True),
    _property("flexroad:root", 17),
    Change("assets deleted", ("assets",), DELETED, "assets: missing"),
    Change("assets a list", ("assets",), [], "assets"),
    Change("asset a text", ("assets", "dsm"), "dsm/a.tif", "assets.dsm"),
    _dsm("deleted", "files", DELETED),
    _dsm("null", "files", None),
    _dsm("empty", "files", []),
    _dsm("a text", "files", "dsm.tif", parquet=False),
    _dsm("of null", "files", [None]),
    _dsm("of numbers", "files", [17], parquet=False),
    _dsm("of an empty text", "files", [""]),
    _dsm("with NUL", "files", ["a\0b.tif"]),
    _dsm("with a lone surrogate", "files", ["a\udcff.tif"], parquet=False),
    _dsm("nested", "files", _nested(80), parquet=False),
    _dsm("deleted", "values", DELETED),
    _dsm("fractional", "values", [1.5], parquet=False),
    _dsm("text", "values", ["road"], parquet=False),
    _dsm("huge", "values", [10**30], parquet=False),
    _dsm("unknown", "crs", "EPSG:999999"),
    _dsm("a number", "crs", 25832, parquet=False),
    _dsm("of another number of files", "extents", [0.0, 0.0, 1.0, 1.0] * 7),
    _dsm("incomplete", "extents", [0.0, 0.0, 1.0]),
    _dsm("NaN", "extents", [math.nan] * 4),
    _dsm("text", "extents", ["0"] * 4, parquet=False),
    _dsm("nested", "extents", [[0.0, 0.0, 1.0, 1.0]], parquet=False),
    _dsm("a number", "extents", 17, parquet=False),
)


def features(path: Path) -> list[Any]:
    """Return the entries of a catalog in JSON."""
    found: list[Any] = json.loads(path.read_text())["features"]
    return found


def write_json(path: Path, entries: list[Any]) -> None:
    """Write entries as they are."""
    path.write_text(json.dumps({"type": "FeatureCollection", "features": entries}))


def write_parquet(path: Path, entries: list[Any], schema: pa.Schema) -> None:
    """Write entries with the columns of a valid catalog."""
    rows = [_row(entry) for entry in entries]
    pq.write_table(pa.Table.from_pylist(rows, schema), path)


def _row(entry: Any) -> dict[str, Any]:
    date = entry["properties"].pop("datetime")
    made = row(entry | {"properties": entry["properties"] | {"datetime": "2020-01-01T00:00:00Z"}})
    return made | {"datetime": date and datetime.fromisoformat(date).astimezone(UTC)}


def cases() -> Iterator[tuple[str, Change]]:
    """Yield each change with the format of its file."""
    for change in CHANGES:
        yield "json", change
        if change.parquet:
            yield "parquet", change
