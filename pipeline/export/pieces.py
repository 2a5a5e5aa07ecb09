"""Files of an export that belong to one tile, area or road each, written by workers.

A file ``.pieces/ID.json`` names what the files of a tile were made of, and is written last: an interrupted
export goes on where it stopped, and writes only tiles that have changed. Files of tiles that an earlier
export had and this one does not have are removed: a folder has one export, and its manifest counts what is
there.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location, listing, parse_location, read, remove, stat, write
from flexroad.catalog.storage.staging import atomic_file
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.tasks.errors import TaskError

MARKERS = ".pieces"
"""Folder of the markers."""
Row = dict[str, Any]
"""What the files of the complete run need of a tile, as JSON values."""


@dataclass(frozen=True)
class Piece:
    """The files of one tile."""

    files: Mapping[str, bytes]
    """By name."""
    row: Row


class Item(Protocol):
    """What files are made of: a finished tile, an area, or a road."""

    @property
    def id(self) -> str:
        """Id of the tile, area or road; unique within an export."""
        ...

    @property
    def fingerprint(self) -> str:
        """Name of the content by what it is made of."""
        ...

    @property
    def label(self) -> str:
        """Its name in messages."""
        ...


Encode = Callable[[Any, Any], Piece]
"""Makes the files of an `Item` with the options of a format; runs in the worker processes."""


@dataclass(frozen=True)
class Job:
    """One item of an export; sent to a worker."""

    tile: Item
    encode: Encode
    options: Any
    folder: str
    key: str
    """Fingerprint of the content, the format's version and its options."""
    group: str
    former: Mapping[str, int]
    """Names and sizes of the item's files of an earlier export."""


def write_pieces(
    tiles: Iterable[Item],
    folder: Location,
    version: int,
    encode: Encode,
    options: Any,
    executor: Executor,
    group: str = "",
) -> Iterator[Row]:
    """Write the files of each tile that does not have them, and yield the row of each, in any order.

    Files of tiles of an earlier export that are not among the given ones are removed at the end.

    Parameters
    ----------
    group : str
        Name of what the items have in common, if a format has several kinds of them.

    Raises
    ------
    ConfigError
        If a tile's results cannot be read, a file cannot be written, or a worker dies twice.
    """
    unchanged: list[Row] = []
    kept: set[str] = set()

    def jobs() -> Iterator[Job]:
        for tile in tiles:
            marker = _marker(folder, group, tile.id)
            kept.add(marker.name)
            written = _written(marker)
            key = sha256(f"{tile.fingerprint} {version} {options}".encode()).hexdigest()
            if written and written.key == key and written.whole(folder):
                unchanged.append(written.row)
            else:
                yield Job(tile, encode, options, str(folder), key, group, written.sizes if written else {})

    for row, failure in executor.map(_write, jobs(), _lost):
        if failure:
            raise ConfigError(failure)
        yield row
    yield from unchanged
    markers = _markers(folder, group)
    for name in listing(markers):
        if name not in kept and (other := _written(markers / name)):
            _remove(folder, other.sizes)
            remove(markers / name)


def figures(rows: Iterable[Row]) -> dict[str, Any]:
    """Return what the manifest says of all tiles: the largest error, and the number of each note."""
    errors, notes = list[float](), Counter[str]()
    for row in rows:
        errors += [row["height_error_m"]] if "height_error_m" in row else []
        notes.update([row["note"]] if row.get("note") else [])
    said = [f"{count(number, 'tile')}: {note}" for note, number in sorted(notes.items())]
    return ({"height_error_m": max(errors)} if errors else {}) | {"notes": said}


def write_whole(folder: Location, name: str, key: str, fill: Callable[[Path], None]) -> None:
    """Write one file over all pieces, unless it exists and was made with the same key.

    Parameters
    ----------
    key : str
        Fingerprint of its content.
    fill : callable
        Writes the file to a local path.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    marker, file = folder / MARKERS / f"{name}.whole", stat(folder / name)
    try:
        if file is not None and json.loads(read(marker)) == {"key": key, "size": file.size}:
            return
    except (OSError, ValueError):
        pass
    with atomic_file(folder / name) as local:
        fill(local)
        size = local.stat().st_size
    write(marker, json.dumps({"key": key, "size": size}).encode())


def _write(job: Job) -> tuple[Row, str]:
    """Write the files of a tile; return its row, or the reason why it has none."""
    folder = parse_location(job.folder)
    try:
        piece = job.encode(job.tile, job.options)
        # First, while the marker still names them.
        _remove(folder, {name: size for name, size in job.former.items() if name not in piece.files})
        for name, data in piece.files.items():
            write(folder / name, data)
        sizes = {name: len(data) for name, data in piece.files.items()}
        marker = json.dumps({"key": job.key, "sizes": sizes, "row": piece.row})
        write(_marker(folder, job.group, job.tile.id), marker.encode())
    except OSError as error:
        return {}, f"{job.tile.label}: {error}; correct that, and the same command goes on"
    except (ConfigError, TaskError, CatalogError) as error:
        name, reason = f"{job.tile.label}: ", str(error)
        return {}, reason if reason.startswith(name) else name + reason
    return piece.row, ""


def _lost(job: Job, reason: str) -> tuple[Row, str]:
    return {}, f"{job.tile.label}: {reason}"


def _markers(folder: Location, group: str) -> Location:
    return folder / (f"{MARKERS}-{group}" if group else MARKERS)


def _marker(folder: Location, group: str, tile_id: str) -> Location:
    return _markers(folder, group) / f"{safe_name(tile_id)}.json"


@dataclass(frozen=True)
class _Written:
    """The files of a tile that an export has written, by its marker."""

    key: str
    sizes: Mapping[str, int]
    row: Row

    def whole(self, folder: Location) -> bool:
        """Return whether all files exist in their full size."""
        return all((file := stat(folder / name)) and file.size == size for name, size in self.sizes.items())


def _written(marker: Location) -> _Written | None:
    """Return what a marker says, None if it does not exist or is damaged."""
    try:
        content = json.loads(read(marker))
        written = _Written(content["key"], dict(content["sizes"]), content["row"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    inside = all(".." not in name.split("/") and not name.startswith("/") for name in written.sizes)
    return written if inside and isinstance(written.row, dict) else None


def _remove(folder: Location, sizes: Mapping[str, int]) -> None:
    """Remove files that are as an earlier export has left them; others may be of the user."""
    for name, size in sizes.items():
        file = stat(folder / name)
        if file and file.size == size:
            remove(folder / name)
