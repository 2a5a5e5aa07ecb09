"""Files of an export, with marks: a mark names the input of files, and is written when they are complete.

Workers write the files of one tile, area or road, and its mark ``.pieces/ID.json`` last. So an interrupted
export continues where it stopped, and only changed tiles are written. Files of an earlier export whose tiles
are not exported again are removed: a folder has one export, and the manifest counts its files.

A file over all tiles has a mark ``.FORMAT.json`` next to the format's folder: if nothing has changed, a later
export does nothing. Some of these files are joined from parts of the tiles, the files ``.parts/ID``. Together
the parts are about as large as the file, so they are removed when it is written.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from operator import attrgetter
from pathlib import Path
from typing import Any, Protocol

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.buckets import atomic_file
from flexroad.catalog.storage.paths import Location, listing, parse_location, read, remove, stat, write
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.errors import TaskError
from flexroad.tools.export.source import Source

MARKERS = ".pieces"
"""Folder of the marks of tiles, areas or roads."""
PARTS = ".parts"
"""Folder of the parts of a joined file."""
LARGEST = ("height_error_m", "steps_max_m")
"""Entries of tiles' rows whose maximum is in the manifest."""
SMOOTH = "the surface without kerbs and walls"
STEPS_SHOWN_M = 0.01
"""The user is told if steps of at least this height are left out (m)."""
ManifestRow = dict[str, Any]
"""Values of a tile that files of the complete run need, as JSON."""


def steps_left_out(steps_m: float) -> str:
    """Return the end of a line for the user about the largest step (m); empty if it is too small."""
    if steps_m < STEPS_SHOWN_M:
        return ""
    return f"; with kerbs and walls it differs by up to {steps_m:.2f} m, where the run has no road"


@dataclass(frozen=True)
class TileOutput:
    """The files of one tile."""

    files: Mapping[str, bytes]
    """By name."""
    row: ManifestRow


class Item(Protocol):
    """Input of files: a finished tile, an area, or a road."""

    @property
    def id(self) -> str:
        """Id of the tile, area or road; unique within an export."""

    @property
    def fingerprint(self) -> str:
        """Hash of the input."""

    @property
    def label(self) -> str:
        """Its name in messages."""


Encode = Callable[[Any, Any], TileOutput]
"""Makes the files of an `Item` with the options of a format; runs in the worker processes."""
Join = Callable[[Path, Iterator[bytes]], None]
"""Writes a file from the parts of all tiles, in the order of the catalog; one part at a time is in memory."""


@dataclass(frozen=True)
class _Mark:
    """The input of files, as JSON; written when the files are complete."""

    key: str
    """Fingerprint of their input, the format's version and its options."""
    sizes: Mapping[str, int]
    """Names and sizes of the files."""
    row: ManifestRow
    """Other values that are needed later."""

    @classmethod
    def read(cls, where: Location) -> _Mark | None:
        """Return a mark, None if it does not exist or is damaged."""
        try:
            content = json.loads(read(where))
            mark = cls(content["key"], dict(content["sizes"]), content["row"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        inside = all(".." not in name.split("/") and not name.startswith("/") for name in mark.sizes)
        return mark if inside and isinstance(mark.row, dict) else None

    def write(self, where: Location) -> None:
        write(where, json.dumps({"key": self.key, "sizes": self.sizes, "row": self.row}).encode())

    def holds(self, folder: Location, key: str) -> bool:
        """Return whether its files have a key, and exist in their full size."""
        return self.key == key and all(_size(folder / name) == size for name, size in self.sizes.items())

    def remove_files(self, folder: Location, kept: Collection[str] = ()) -> None:
        """Remove its files that have the size that the export wrote; the user may have changed the others."""
        for name, size in self.sizes.items():
            if name not in kept and _size(folder / name) == size:
                remove(folder / name)


@dataclass(frozen=True)
class _Job:
    """One item of an export; sent to a worker."""

    tile: Item
    encode: Encode
    options: Any
    folder: str
    key: str
    """See `_Mark`."""
    group: str
    former: _Mark | None
    """The mark of an earlier export."""


def write_outputs(
    tiles: Iterable[Item],
    folder: Location,
    version: int,
    encode: Encode,
    options: Any,
    executor: Executor,
    group: str = "",
    made_of: Callable[[Any], str] = attrgetter("fingerprint"),
) -> Iterator[ManifestRow]:
    """Write the missing files of each tile, and yield the row of each tile, in any order.

    Files of an earlier export whose tiles are not among the given tiles are removed at the end.

    - `group`: name of the kind of items, if a format has several kinds.
    - `made_of`: returns the hash of an item's input, if it is more than the fingerprint.
    """
    unchanged: list[ManifestRow] = []
    kept: set[str] = set()

    def jobs() -> Iterator[_Job]:
        for tile in tiles:
            marker = _marker(folder, group, tile.id)
            kept.add(marker.name)
            former = _Mark.read(marker)
            key = sha256(f"{made_of(tile)} {version} {options}".encode()).hexdigest()
            if former and former.holds(folder, key):
                unchanged.append(former.row)
            else:
                yield _Job(tile, encode, options, str(folder), key, group, former)

    for row, failure in executor.map(_write, jobs(), _lost):
        if failure:
            raise ConfigError(failure)
        yield row
    yield from unchanged
    markers = _markers(folder, group)
    for name in listing(markers):
        if name not in kept and (other := _Mark.read(markers / name)):
            other.remove_files(folder)
            remove(markers / name)


def figures(rows: Iterable[ManifestRow]) -> dict[str, Any]:
    """Return the manifest's figures of all tiles: the largest error and step, and the number of each note."""
    largest, notes = dict[str, Any](), Counter[str]()
    for row in rows:
        for name in (name for name in LARGEST if name in row):
            largest[name] = max(row[name], largest.get(name, row[name]))
        notes.update([row["note"]] if row.get("note") else [])
    left_out = steps_left_out(largest.get("steps_max_m", 0.0))
    summary = {"summary": f"of {SMOOTH}{left_out}"} if left_out else {}
    said = [f"{count(number, 'tile')}: {note}" for note, number in sorted(notes.items())]
    return largest | summary | {"notes": said}


def write_whole(file: Location, key: str, row: ManifestRow, fill: Callable[[Path], None]) -> None:
    """Write the only file of a folder, unless it exists and was made with the same key.

    The former file is removed if it had another name.

    - `key`: fingerprint of its content and name.
    """
    folder = file.parent
    former = _Mark.read(_whole_marker(folder))
    if former and file.name in former.sizes and former.holds(folder, key):
        return
    with atomic_file(file) as local:
        fill(local)
        size = local.stat().st_size
    if former:
        former.remove_files(folder, {file.name})
    _Mark(key, {file.name: size}, row).write(_whole_marker(folder))


def part_name(tile_id: str) -> str:
    """Return the name of the part of a tile."""
    return f"{PARTS}/{safe_name(tile_id)}"


def write_joined(
    source: Source,
    tiles: Iterable[FinishedTile],
    file: Location,
    version: int,
    encode: Callable[[FinishedTile, Any], TileOutput],
    options: Any,
    executor: Executor,
    join: Join,
) -> dict[str, Any]:
    """Write one file of all tiles, unless it exists with the same meshes, version and options.

    The figures of all tiles are returned.

    - `encode`: makes the output of a tile, with a single file named by `part_name`; runs in the workers.
    - `options`: given to ``encode``; ``join`` depends only on them and the name of the file.
    """
    folder = file.parent
    made_of = sha256(f"{file.name} {version} {options}".encode())
    for tile, snapshot in zip(source.tiles, source.snapshots, strict=True):
        made_of.update(f" {tile.id} {snapshot.nodes['sample']}".encode())
    key, mark = made_of.hexdigest(), _Mark.read(_whole_marker(folder))
    if mark and mark.holds(folder, key):
        for _ in tiles:
            pass  # each tile is checked to be still finished
        rows = mark.row
    else:
        rows = figures(write_outputs(tiles, folder, version, encode, options, executor))
        parts = (read(folder / part_name(tile.id)) for tile in source.tiles)
        write_whole(file, key, rows, lambda local: join(local, parts))
    _remove_parts(folder)
    return rows


def _write(job: _Job) -> tuple[ManifestRow, str]:
    """Write the files of a tile; return its row, or the reason why it has no row."""
    folder = parse_location(job.folder)
    try:
        output = job.encode(job.tile, job.options)
        # First, while the mark still names them.
        if job.former:
            job.former.remove_files(folder, output.files)
        for name, data in output.files.items():
            write(folder / name, data)
        sizes = {name: len(data) for name, data in output.files.items()}
        _Mark(job.key, sizes, output.row).write(_marker(folder, job.group, job.tile.id))
    except OSError as error:
        return {}, f"{job.tile.label}: {error}; correct that, and the same command goes on"
    except (ConfigError, TaskError, CatalogError) as error:
        name, reason = f"{job.tile.label}: ", str(error)
        return {}, reason if reason.startswith(name) else name + reason
    return output.row, ""


def _lost(job: _Job, reason: str) -> tuple[ManifestRow, str]:
    return {}, f"{job.tile.label}: {reason}"


def _markers(folder: Location, group: str) -> Location:
    return folder / (f"{MARKERS}-{group}" if group else MARKERS)


def _marker(folder: Location, group: str, tile_id: str) -> Location:
    return _markers(folder, group) / f"{safe_name(tile_id)}.json"


def _whole_marker(folder: Location) -> Location:
    return folder.parent / f".{folder.name}.json"


def _size(file: Location) -> int | None:
    found = stat(file)
    return found.size if found else None


def _remove_parts(folder: Location) -> None:
    for part in (folder / PARTS, folder / MARKERS):
        for name in listing(part):
            remove(part / name)
        if isinstance(part, Path):
            with contextlib.suppress(OSError):
                part.rmdir()
