"""GeoPackage: a copy of the file in which the geometries have heights.

The file is copied, and the geometries are replaced in their rows. So all tables, styles, views, ids, types
and indices stay. The indices stay valid: they have no heights, and new vertices lie on existing segments.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexroad.catalog.guard.open_vector import vector_name
from flexroad.catalog.guard.vector_contents import quoted
from flexroad.tasks.errors import TaskError
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
from flexroad.tools.lift.shapes import Shape, of_wkb, to_wkb
from flexroad.tools.lift.types import Frame, Lifted, Options, RunSurface

SUFFIXES = (".gpkg",)
ENVELOPES = (0, 32, 48, 48, 64)
"""Size of the envelope of a geometry by its number in the flags."""
UNDEFINED = (0, -1, 99999)
"""Numbers of undefined coordinate systems."""


@dataclass(frozen=True)
class _Layer:
    table: str
    column: str
    key: str
    crs: str | None
    columns: tuple[str, ...]
    """All columns."""


def frame(source: Path) -> Frame:
    """Return the CRS of the first layer that has a CRS."""
    path = vector_name(source)
    with _opened(Path(path)) as file:
        return Frame(next((layer.crs for layer in _layers(file) if layer.crs), None))


def lift(source: Path, out: Path, run: RunSurface, options: Options) -> Iterator[Lifted]:
    """Copy a file with heights; yield the rows of the report."""
    path = vector_name(source)
    shutil.copyfile(path, out)
    with _opened(out) as file:
        try:
            # The copy is still a temporary file, so a crash does no harm.
            file.execute("PRAGMA journal_mode=OFF")
            file.execute("PRAGMA synchronous=OFF")
            layers = _layers(file)
            for layer in layers:
                yield from _lift_layer(file, layer, run, options, len(layers) > 1)
            # Views may show geometries with heights.
            file.execute(
                "UPDATE gpkg_geometry_columns SET z = 2 WHERE z = 0 AND lower(table_name) IN "
                "(SELECT lower(name) FROM sqlite_master WHERE type = 'view')"
            )
            file.commit()
        except sqlite3.Error as error:
            raise TaskError(f"cannot be changed as a GeoPackage: {error}; repair it with ogr2ogr") from error


def _opened(path: Path) -> closing[sqlite3.Connection]:
    file = sqlite3.connect(path)
    # Text that is not UTF-8 is read with replacements; it is not written.
    file.text_factory = lambda data: data.decode("utf-8", "replace")
    return closing(file)


def _layers(file: sqlite3.Connection) -> list[_Layer]:
    """Return the tables with geometries; views show the geometries of their tables."""
    try:
        found = file.execute(
            "SELECT g.table_name, g.column_name, g.srs_id FROM gpkg_geometry_columns g JOIN sqlite_master m "
            "ON lower(m.name) = lower(g.table_name) AND m.type = 'table' ORDER BY g.rowid"
        ).fetchall()
        layers = []
        for table, column, srs in found:
            info = file.execute(f"PRAGMA table_info({quoted(table)})").fetchall()
            keys = [row[1] for row in info if row[5] == 1 and row[2].upper() == "INTEGER"]
            names = tuple(row[1] for row in info)
            layers.append(
                _Layer(table, column, keys[0] if len(keys) == 1 else "rowid", _crs(file, srs), names)
            )
    except sqlite3.Error as error:
        raise TaskError(f"is a damaged GeoPackage: {error}; repair it with ogr2ogr NEW.gpkg FILE") from error
    if not layers:
        raise TaskError("has no layer with geometries")
    return layers


def _crs(file: sqlite3.Connection, number: int) -> str | None:
    """Return a coordinate system by its number; None if it is undefined."""
    query = (
        "SELECT organization, organization_coordsys_id, definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?"
    )
    found = file.execute(query, (number,)).fetchone()
    if found is None or number in UNDEFINED:
        return None
    organisation, code, definition = found
    return f"EPSG:{code}" if str(organisation).upper() == "EPSG" else str(definition)


def _lift_layer(
    file: sqlite3.Connection, layer: _Layer, run: RunSurface, options: Options, several: bool
) -> Iterator[Lifted]:
    run = run.in_crs(layer.crs, layer.table)
    table, key, geometry = quoted(layer.table), quoted(layer.key), quoted(layer.column)
    with _without_triggers(file, layer.table):
        added = _add_columns(file, layer) if options.columns else ""
        flat = False
        update = f"UPDATE {table} SET {geometry} = ?{added} WHERE {key} = ?"
        for rows, features in _batches(file, layer, several):
            edits = []
            for (number, blob, *_), feature, (shape, row) in zip(
                rows, features, lifted(features, run, options), strict=True
            ):
                if shape is not None and not shape.z:
                    flat = True
                new = blob if shape is None or shape is feature.shape else _blob(blob, shape)
                edits.append((new, *(percent_columns(row) if added else ()), number))
                yield row
            file.executemany(update, edits)
    file.execute(
        "UPDATE gpkg_geometry_columns SET z = ? WHERE lower(table_name) = lower(?)",
        (2 if flat else 1, layer.table),
    )


@contextmanager
def _without_triggers(file: sqlite3.Connection, table: str) -> Iterator[None]:
    """Context manager without the triggers of a table: they need functions of spatial libraries."""
    found = "SELECT name, sql FROM sqlite_master WHERE type = 'trigger' AND lower(tbl_name) = lower(?)"
    triggers = file.execute(found, (table,)).fetchall()
    for name, _ in triggers:
        file.execute(f"DROP TRIGGER {quoted(name)}")
    yield
    for _, statement in triggers:
        file.execute(statement)


def _add_columns(file: sqlite3.Connection, layer: _Layer) -> str:
    """Add the requested columns; return the part of an update that sets them."""
    known = {name.lower(): name for name in layer.columns}
    for name in COLUMNS:
        if name not in known:
            file.execute(f"ALTER TABLE {quoted(layer.table)} ADD COLUMN {name} REAL")
    return "".join(f", {quoted(known.get(name, name))} = ?" for name in COLUMNS)


def _batches(
    file: sqlite3.Connection, layer: _Layer, several: bool
) -> Iterator[tuple[list[tuple[Any, ...]], list[Feature]]]:
    """Yield rows in the order of their keys, with their features."""
    levels = level_columns(layer.columns)
    names = ", ".join(map(quoted, (layer.key, layer.column, *levels)))
    key, table = quoted(layer.key), quoted(layer.table)
    after = -(2**63)
    while True:
        rows, size = list[tuple[Any, ...]](), 0
        condition = ">=" if after == -(2**63) else ">"
        query = f"SELECT {names} FROM {table} WHERE {key} {condition} ? ORDER BY {key}"
        with closing(file.execute(query, (after,))) as found:
            for row in found:
                rows.append(row)
                size += len(row[1] or b"")
                if len(rows) == BATCH_FEATURES or size > BATCH_BYTES:
                    break
        if not rows:
            return
        after = rows[-1][0]
        wanted = wanted_levels(
            {name: [row[2 + i] for row in rows] for i, name in enumerate(levels)}, len(rows)
        )
        prefix = f"{layer.table}/" if several else ""
        yield (
            rows,
            [
                Feature(f"{prefix}{row[0]}", _shape(row, layer), level)
                for row, level in zip(rows, wanted, strict=True)
            ],
        )


def _shape(row: tuple[Any, ...], layer: _Layer) -> Shape | None:
    blob = row[1]
    if blob is None:
        return None
    try:
        if not isinstance(blob, bytes) or blob[:2] != b"GP":
            raise TaskError(
                "has a geometry in another format than a GeoPackage's; repair the file with ogr2ogr"
            )
        number = blob[3] >> 1 & 7 if len(blob) > 3 else len(ENVELOPES)
        if number >= len(ENVELOPES):
            raise TaskError("has a damaged geometry; repair the file with ogr2ogr")
        return of_wkb(blob[8 + ENVELOPES[number] :])
    except TaskError as error:
        raise TaskError(f"(feature {row[0]} of the layer {layer.table}) {error}") from error


def _blob(old: bytes, shape: Shape) -> bytes:
    """Return a geometry with the header of the geometry that it replaces, and its envelope in plan."""
    flags = old[3]
    has_envelope = flags >> 1 & 7 > 0
    header = old[:3] + struct.pack("B", flags & ~0b1110 | 0b10 * has_envelope) + old[4:8]
    return header + (old[8:40] if has_envelope else b"") + to_wkb(shape)
