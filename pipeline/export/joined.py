"""Formats with one file for the complete run: workers encode the part of each tile, and the parts are joined.

Parts are files ``.parts/ID``, so that an interrupted export goes on where it stopped. Together they are about
as large as the file itself. So they are removed when it is written, and a file ``.FORMAT.json`` beside the
format's folder says what it was made of: if nothing has changed, a later export does nothing.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, listing, read, remove, stat, write
from flexroad.catalog.storage.staging import atomic_file
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.pieces import MARKERS, Piece, figures, write_pieces
from flexroad.pipeline.export.source import Source
from flexroad.pipeline.run.finished import FinishedTile

PARTS = ".parts"

Join = Callable[[Path, Iterator[bytes]], None]
"""Writes a file from the parts of all tiles, in the order of the catalog; each part is in memory alone."""


def part_name(tile_id: str) -> str:
    """Return the name of the part of a tile."""
    return f"{PARTS}/{safe_name(tile_id)}"


def write_joined(
    source: Source,
    tiles: Iterable[FinishedTile],
    file: Location,
    version: int,
    encode: Callable[[FinishedTile, Any], Piece],
    options: Any,
    executor: Executor,
    join: Join,
) -> dict[str, Any]:
    """Write one file of all tiles, unless it exists and is of the same meshes, version and options.

    The figures of all tiles are returned.

    Parameters
    ----------
    tiles : iterable of FinishedTile
        All tiles of the source.
    encode : callable
        Makes the piece of a tile, whose only file has the name of `part_name`; runs in the workers.
    options : object
        Given to ``encode``; with the name of the file, also all that ``join`` depends on.

    Raises
    ------
    ConfigError
        If a tile's results cannot be read, a file cannot be written, or a worker dies twice.
    TaskError
        If the parts do not fit together.
    """
    folder = file.parent
    record = _record(folder)
    key = _key(source, file.name, version, options)
    if record.get("key") == key and _size(file) == record.get("size"):
        for _ in tiles:
            pass  # each is checked to be still finished
    else:
        rows = figures(write_pieces(tiles, folder, version, encode, options, executor))
        parts = (read(folder / part_name(tile.id)) for tile in source.tiles)
        with atomic_file(file) as local:
            join(local, parts)
        if record.get("name") != file.name:
            _remove_former(folder, record)
        record = {"key": key, "name": file.name, "size": _size(file), "figures": rows}
        write(_record_file(folder), json.dumps(record).encode())
    _remove_parts(folder)
    kept: dict[str, Any] = record["figures"]
    return kept


def _key(source: Source, name: str, version: int, options: Any) -> str:
    """Return what a file is made of, in one word."""
    made_of = sha256(f"{name} {version} {options}".encode())
    for tile, snapshot in zip(source.tiles, source.snapshots, strict=True):
        made_of.update(f" {tile.id} {snapshot.nodes['sample']}".encode())
    return made_of.hexdigest()


def _size(file: Location) -> int | None:
    found = stat(file)
    return found.size if found else None


def _record_file(folder: Location) -> Location:
    return folder.parent / f".{folder.name}.json"


def _record(folder: Location) -> dict[str, Any]:
    """Return what the folder's file was made of, empty if there is none."""
    try:
        content = json.loads(read(_record_file(folder)))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) and isinstance(content.get("figures"), dict) else {}


def _remove_former(folder: Location, record: dict[str, Any]) -> None:
    """Remove the file of an earlier export that had another name, if it is as that export has left it."""
    name = record.get("name")
    if isinstance(name, str) and "/" not in name and _size(folder / name) == record.get("size"):
        remove(folder / name)


def _remove_parts(folder: Location) -> None:
    for part in (folder / PARTS, folder / MARKERS):
        for name in listing(part):
            remove(part / name)
        if isinstance(part, Path):
            with contextlib.suppress(OSError):
                part.rmdir()
