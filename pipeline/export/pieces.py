"""Files of an export that belong to one tile each, written by workers.

A file ``.pieces/ID.json`` names what a tile's files were made of, and is written last: an interrupted export
goes on where it stopped, and writes only tiles that have changed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, parse_location, read, stat, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.source import FinishedTile
from flexroad.tasks.errors import TaskError

Row = dict[str, Any]
"""What the files of the whole run need of a tile, as JSON values."""


@dataclass(frozen=True)
class Piece:
    """The files of one tile."""

    files: Mapping[str, bytes]
    """By name."""
    row: Row


Encode = Callable[[FinishedTile, Any], Piece]
"""Makes the files of a tile with the options of a format; runs in the worker processes."""


@dataclass(frozen=True)
class Job:
    """One tile of an export; sent to a worker."""

    tile: FinishedTile
    encode: Encode
    options: Any
    folder: str
    key: str
    """Fingerprint of the mesh, the format's version and its options."""


def write_pieces(
    tiles: Iterable[FinishedTile],
    folder: Location,
    version: int,
    encode: Encode,
    options: Any,
    executor: Executor,
) -> Iterator[Row]:
    """Write the files of each tile that does not have them, and yield the row of each, in any order.

    Raises
    ------
    ConfigError
        If a tile's results cannot be read, a file cannot be written, or a worker dies twice.
    """
    unchanged: list[Row] = []

    def jobs() -> Iterator[Job]:
        for tile in tiles:
            key = sha256(f"{tile.fingerprint} {version} {options}".encode()).hexdigest()
            row = _known(folder, tile.id, key)
            if row is None:
                yield Job(tile, encode, options, str(folder), key)
            else:
                unchanged.append(row)

    for row, failure in executor.map(_write, jobs(), _lost):
        if failure:
            raise ConfigError(failure)
        yield row
    yield from unchanged


def _write(job: Job) -> tuple[Row, str]:
    """Write the files of a tile; return its row, or the reason why it has none."""
    folder = parse_location(job.folder)
    try:
        piece = job.encode(job.tile, job.options)
        job.tile.check_unchanged()
        for name, data in piece.files.items():
            write(folder / name, data)
        sizes = {name: len(data) for name, data in piece.files.items()}
        marker = json.dumps({"key": job.key, "sizes": sizes, "row": piece.row})
        write(_marker(folder, job.tile.id), marker.encode())
    except (ConfigError, TaskError, CatalogError, OSError) as error:
        name, reason = f"tile {job.tile.id}: ", str(error)
        return {}, reason if reason.startswith(name) else name + reason
    return piece.row, ""


def _lost(job: Job, reason: str) -> tuple[Row, str]:
    return {}, f"tile {job.tile.id}: {reason}"


def _marker(folder: Location, tile_id: str) -> Location:
    return folder / ".pieces" / f"{safe_name(tile_id)}.json"


def _known(folder: Location, tile_id: str, key: str) -> Row | None:
    """Return the row of a tile whose files exist and are of the same mesh, version and options."""
    try:
        marker = json.loads(read(_marker(folder, tile_id)))
        whole = all(
            (file := stat(folder / name)) is not None and file.size == size
            for name, size in marker["sizes"].items()
        )
        row: Row = marker["row"]
        return row if whole and marker["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
