"""Checks of parts of a vector file that GDAL trusts: views, computed columns, numbers of features, indexes.

GDAL runs the queries of all views of an SQLite file when it lists the layers, without any limit. Here each is
run once by Python's SQLite, with limits. pyogrio reads as many features as the file states, and no more.

GDAL does not return a feature that is missing or misplaced in a spatial index. Such an index remains if a
program edits a GeoPackage without its triggers, or a Shapefile without updating its ``.qix``.
"""

from __future__ import annotations

import itertools
import json
import re
import shlex
import sqlite3
from collections.abc import Mapping
from contextlib import closing
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from flexroad.catalog.grid import Bounds, union
from flexroad.catalog.guard.source_files import InputRejected
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import FileStat
from flexroad.catalog.text import one_line

STEPS = 50_000_000
"""Steps of SQLite's machine that any query may take: about a second. A row of a join takes about 30."""
STEPS_PER_BYTE = 2
"""Further steps for each byte of the file: to read all rows takes fewer."""
STRIDE = 100_000
"""Number of steps after which the limit is checked again."""
MAX_VALUE_BYTES = 2**26
"""Largest text or geometry."""
FUNCTIONS = frozenset(
    "abs avg coalesce count dense_rank ifnull iif instr length lower ltrim max min nullif rank round "
    "row_number rtrim substr substring sum total trim typeof upper".split()
)
"""Functions that a query may call: their result is always the same, and not longer than their arguments."""
NO_ROWS = re.compile(r"no such (table|column)|circularly defined|no such function: XB_", re.IGNORECASE)
"""Errors of queries that GDAL cannot run either; the last is for views that SpatiaLite makes itself."""
COUNTS = (
    ("gpkg_ogr_contents", "table_name", "feature_count", "DELETE FROM gpkg_ogr_contents"),
    (
        "geometry_columns_statistics",
        "f_table_name",
        "row_count",
        "UPDATE geometry_columns_statistics SET row_count = NULL",
    ),
)
"""Tables with numbers of features, their columns, and a statement after which GDAL counts by itself."""
VIRTUAL_COLUMN = 2
"""Numbers in SQLite's table of columns for columns that are computed when they are read."""


def opened(path: Path) -> closing[sqlite3.Connection]:
    """Return a connection that only reads a file, for a ``with`` block."""
    return closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True))


def quoted(name: str) -> str:
    """Return a name as a statement has it."""
    return '"' + name.replace('"', '""') + '"'


def require_sound_contents(path: Path, state: FileStat) -> None:
    """Raise an error if an SQLite file may need endless time or memory, or hides features."""
    if fault := _fault(path, state):
        raise InputRejected(fault)


@lru_cache(maxsize=256)
def _fault(path: Path, state: FileStat) -> str:
    """Return the fault of a file, to follow its name; empty without a fault."""
    try:
        with opened(path) as file:
            names = file.execute(
                "SELECT type, name FROM sqlite_master WHERE type IN ('table', 'view')"
            ).fetchall()
            for kind, name in names:
                if kind == "table":
                    fault = _of_table(file, name, path)
                elif fault := _trial(file, name, STEPS + STEPS_PER_BYTE * state.size):
                    remedy = _command(path, f"DROP VIEW {_bracketed(name)}")
                    fault = f"{fault}; write its result to a table, or remove it: {remedy}"
                if fault:
                    return fault
            return _of_counts(file, {name.lower() for kind, name in names if kind == "table"}, path)
    except sqlite3.Error as error:
        if "malformed database schema" in str(error):
            return f"has a schema that SQLite {sqlite3.sqlite_version} cannot read: {one_line(error)}"
        # GDAL reports what is wrong.
    return ""


def _of_table(file: sqlite3.Connection, name: str, path: Path) -> str:
    try:
        columns = file.execute("SELECT name, hidden FROM pragma_table_xinfo(?)", (name,)).fetchall()
    except sqlite3.OperationalError:
        # A virtual table, of a module that Python's SQLite does not have.
        return ""
    computed = [column for column, hidden in columns if hidden == VIRTUAL_COLUMN]
    if not computed:
        return ""
    remedy = _command(path, f"ALTER TABLE {_bracketed(name)} DROP COLUMN {_bracketed(computed[0])}")
    return f"has the computed column {computed[0]!r}, whose values may have no end; remove it: {remedy}"


def _of_counts(file: sqlite3.Connection, tables: set[str], path: Path) -> str:
    for statistics, name, number, statement in COUNTS:
        if statistics not in tables:
            continue
        stated = file.execute(
            f"SELECT {name}, {number} FROM {statistics} WHERE {number} IS NOT NULL"
        ).fetchall()
        for table, features in stated:
            if str(table).lower() not in tables:
                continue
            ((rows,),) = file.execute(f"SELECT count(*) FROM {quoted(table)}").fetchall()
            if rows > features:
                remedy = f"have them counted again: {_command(path, statement)}"
                return f"states {features:,} features of {table!r}, which has {rows:,}; {remedy}"
    return ""


def _trial(file: sqlite3.Connection, view: str, most_steps: int) -> str:
    """Run the query of a view; return why the view is not read, empty if the query ends."""
    others: list[str] = []

    def authorize(action: int, _: str | None, function: str | None, *__: str | None) -> int:
        if action != sqlite3.SQLITE_FUNCTION or str(function).lower() in FUNCTIONS:
            return sqlite3.SQLITE_OK
        others.append(str(function))
        return sqlite3.SQLITE_DENY

    looks = itertools.count(1)
    file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
    file.set_authorizer(authorize)
    file.set_progress_handler(lambda: next(looks) * STRIDE > most_steps, STRIDE)
    try:
        for _ in file.execute(f"SELECT * FROM {quoted(view)}"):
            pass
    except sqlite3.Error as error:
        if others:
            return f"has the view {view!r}, which calls the function {others[0]}"
        if NO_ROWS.search(str(error)):
            return ""
        endless = "interrupted" in str(error)
        why = "does not end" if endless else f"cannot be checked ({one_line(error)})"
        return f"has the view {view!r}, which {why}"
    finally:
        file.set_authorizer(None)
        file.set_progress_handler(None, 0)
    return ""


def _bracketed(name: str) -> str:
    return quoted(name) if "]" in name else f"[{name}]"


def _command(path: Path, statement: str) -> str:
    """Return a shell command that changes an SQLite file; it needs nothing but Python."""
    connection = f"sqlite3.connect({json.dumps(str(path))}, isolation_level=None)"
    return f"python -c {shlex.quote(f'import sqlite3; {connection}.execute({json.dumps(statement)})')}"


pyogrio = lazy("pyogrio")

SQLITE = ("GPKG", "SQLite")
"""GDAL's drivers of formats in SQLite."""
EDITED = (*SQLITE, "ESRI Shapefile")
"""GDAL's drivers of formats that are edited in place, so that index and bounds may be out of date."""
BOXES = np.dtype(
    [("feature", np.int64), *((edge, np.float32) for edge in ("west", "east", "south", "north"))]
)
"""Rows of an R-tree of SQLite, which rounds boxes outwards."""


def has_complete_index(file: str, info: Mapping[str, Any]) -> bool:
    """Return whether each feature of a layer is in its index, within its box there.

    - result: also False for a view, which has the index of its table, and for a Shapefile, whose index is not
      read here.
    """
    if not info["capabilities"]["fast_spatial_filter"] or info["driver"] not in SQLITE:
        return bool(info["capabilities"]["fast_spatial_filter"]) and info["driver"] not in EDITED
    index = _boxes(Path(file.removeprefix("SQLITE:")), f"{info['layer_name']}_{info['geometry_name']}")
    features, boxes = pyogrio.read_bounds(file, layer=info["layer_name"])
    placed = np.isfinite(boxes).all(axis=0)
    features, (west, south, east, north) = features[placed], boxes[:, placed]
    order = np.argsort(index["feature"])
    index = index[order]
    at = np.searchsorted(index["feature"], features)
    if at.size and at.max() >= index.size:
        return False
    found = index[at]
    inside = (found["west"] <= west) & (found["south"] <= south)
    inside &= (found["east"] >= east) & (found["north"] >= north)
    return bool(((found["feature"] == features) & inside).all())


def _boxes(path: Path, layer: str) -> np.ndarray[Any, Any]:
    """Return the boxes of the R-tree of a table and column; empty if it does not exist."""
    names = f"rtree_{layer}".lower(), f"idx_{layer}".lower()
    with opened(path) as data:
        try:
            tables = data.execute(
                "SELECT name FROM sqlite_master WHERE lower(name) IN (?, ?)", names
            ).fetchall()
            return np.fromiter(data.execute(f"SELECT * FROM {quoted(tables[0][0])}"), BOXES)
        except (sqlite3.Error, IndexError, ValueError):
            return np.empty(0, BOXES)


def real_bounds(file: str, info: Mapping[str, Any]) -> Bounds | None:
    """Return the bounds of all features of a layer, None if it has none; see `has_complete_index`."""
    stated: Bounds | None = info["total_bounds"]
    if info["driver"] not in EDITED:
        return stated
    _, boxes = pyogrio.read_bounds(file, layer=info["layer_name"])
    boxes = boxes[:, np.isfinite(boxes).all(axis=0)]
    if not boxes.size:
        return stated
    west, south = map(float, boxes[:2].min(axis=1))
    east, north = map(float, boxes[2:].max(axis=1))
    real = west, south, east, north
    return union([real, stated]) if stated else real
