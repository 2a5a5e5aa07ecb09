"""The states and records of all tiles of a run, in one file: ``RUN/database.txt``.

The file is a cache of the tiles' markers. If it is missing, damaged or of another version, it is taken as
empty, and the markers are read instead. One run writes it; other processes may read it at the same time. ::

    flexroad database 5 CHECKSUM            of the checksums of all lines
    CHECKSUM    "tile"    state    record   a line per tile in the catalog's order, then a line per result

The last line of a tile is valid. Lines are only appended, and then the first line is changed. So a killed run
leaves a valid file.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from hashlib import blake2b
from typing import Any, BinaryIO

from flexroad.catalog.storage.buckets import StagedFile
from flexroad.catalog.storage.outputs import atomic_path, flush_path
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.store.records import Failure, TileRecord, TileState

NAME = "database.txt"
TITLE = b"flexroad database 5 "
CHECKSUM_BYTES = 16
DIGITS = 2 * CHECKSUM_BYTES
"""Length of a checksum in the file (bytes)."""
FLUSH_S = 1.0
"""Interval between writes of recorded tiles (s)."""
Line = tuple[str, TileState, TileRecord | None]
"""Id and state of a tile, and the record of its last result or None."""


class RunDatabase:
    """States and records of a run's tiles; a context manager that writes all pending records on exit.

    - `writable`: whether this process writes the file; a missing or damaged file is then made empty.
    """

    def __init__(self, path: Location, writable: bool = False) -> None:
        self._staged = StagedFile(path, writable)
        self._staged.fetch()
        self._pending: dict[str, TileRecord] = {}
        self._flushed = time.monotonic()
        self._file: BinaryIO | None = None
        if not self.load() and writable:
            self.set_states(())

    def load(self) -> bool:
        """Read the file again, and return whether it is valid; an invalid file is taken as empty."""
        if self._file:
            self._file.close()
        self._offsets: dict[str, int] = {}
        self._checksums = blake2b(digest_size=CHECKSUM_BYTES)
        self._file, self._end = None, 0
        # Opening a pipe would wait for a writer.
        if not self._staged.path.is_file():
            return False
        offsets, checksums = {}, self._checksums.copy()
        with contextlib.suppress(OSError):
            self._file = self._staged.path.open("rb")
            header = self._file.read(len(_header(checksums)))
            # Lines that are appended from now on are not read.
            size, end = os.fstat(self._file.fileno()).st_size, len(header)
            while end < size:
                line = self._file.readline()
                content = _content(line)
                if content is None:
                    return False
                offsets[json.loads(content.split(b"\t", 2)[1])] = end
                checksums.update(line[:DIGITS])
                end += len(line)
            if header == _header(checksums):
                self._offsets, self._checksums, self._end = offsets, checksums, end
                return True
        return False

    def __enter__(self) -> RunDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write all pending records and close the file."""
        try:
            self.flush()
            if self._staged.writable:
                with contextlib.suppress(OSError):
                    flush_path(self._staged.path)
            self._staged.put()
        finally:
            if self._file:
                self._file.close()
            self._staged.close()

    def set_states(self, tiles: Iterable[tuple[str, TileState]]) -> int:
        """Replace the list of tiles: the id and state of each, in the catalog's order.

        - result: number of tiles with a record that are not in the list; their records are deleted.
        """
        self.flush()
        vanished, checksums = self._offsets.copy(), blake2b(digest_size=CHECKSUM_BYTES)
        with atomic_path(self._staged.path) as path, path.open("wb") as file:
            file.write(_header(checksums))
            for tile, state in tiles:
                line = _line(tile, state, self.get(tile))
                file.write(line)
                checksums.update(line[:DIGITS])
                vanished.pop(tile, None)
            file.seek(0)
            file.write(_header(checksums))
        count = sum(self.get(tile) is not None for tile in vanished)
        self.load()
        return count

    def record(self, record: TileRecord) -> None:
        """Add a tile's record; it is written within seconds, on a full disk as soon as there is space."""
        self._pending[record.tile_id] = record
        if time.monotonic() - self._flushed > FLUSH_S:
            # A full disk does not stop the run; the write is repeated later.
            with contextlib.suppress(OSError):
                self.flush()
                self._staged.sync_if_due()

    def flush(self) -> None:
        """Write all pending records."""
        self._flushed = time.monotonic()
        if not self._pending or not self._end:
            return
        lines, offsets, end, checksums = list[bytes](), {}, self._end, self._checksums.copy()
        for tile, record in self._pending.items():
            lines.append(_line(tile, record.state, record))
            checksums.update(lines[-1][:DIGITS])
            offsets[tile] = end
            end += len(lines[-1])
        try:
            with self._staged.path.open("r+b") as file:
                file.seek(self._end)
                file.write(b"".join(lines))
                file.flush()
                file.seek(0)
                file.write(_header(checksums))
        except FileNotFoundError:
            # The file was deleted. The markers are read at the end of the run.
            pass
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._staged.where)) from error
        self._offsets |= offsets
        self._end, self._checksums = end, checksums
        self._pending.clear()

    def get(self, tile_id: str) -> TileRecord | None:
        """Return a tile's record, None if it is missing or damaged."""
        if tile_id in self._pending:
            return self._pending[tile_id]
        line = self._read(tile_id) if tile_id in self._offsets else None
        return line[2] if line else None

    def lists(self, tiles: Iterable[str]) -> bool:
        """Return whether the file has exactly these tiles, in this order."""
        self.flush()
        return list(self._offsets) == list(tiles)

    def entries(self) -> Iterator[Line]:
        """Yield id, state and record of every tile, in the catalog's order."""
        self.flush()
        for tile in list(self._offsets):
            line = self._read(tile)
            if line is None:
                raise OSError(errno.EIO, "the list of tiles is damaged", str(self._staged.where))
            yield line

    def _read(self, tile_id: str) -> Line | None:
        """Return the last line of a tile, None if it is damaged."""
        content = None
        if self._file:
            with contextlib.suppress(OSError):
                self._file.seek(self._offsets[tile_id])
                content = _content(self._file.readline())
        if content is None:
            return None
        _, tile, state, record = content.split(b"\t")
        return json.loads(tile), json.loads(state), _record(json.loads(record))


def _header(checksums: blake2b) -> bytes:
    return TITLE + checksums.hexdigest().encode() + b"\n"


def _line(tile: str, state: TileState, record: TileRecord | None) -> bytes:
    fields = record and vars(record) | {"failures": [asdict(failure) for failure in record.failures]}
    content = "".join(f"\t{json.dumps(value)}" for value in (tile, state, fields)).encode() + b"\n"
    return _checksum(content) + content


def _content(line: bytes) -> bytes | None:
    """Return a line without its checksum, None if the checksum is wrong."""
    content = line[DIGITS:]
    return content if line[:DIGITS] == _checksum(content) else None


def _checksum(content: bytes) -> bytes:
    return blake2b(content, digest_size=CHECKSUM_BYTES).hexdigest().encode()


def _record(fields: dict[str, Any] | None) -> TileRecord | None:
    if fields is None:
        return None
    return TileRecord(
        **fields
        | {
            "rows": tuple(fields["rows"]),
            "failures": tuple(Failure(**failure) for failure in fields["failures"]),
            "marker": fields["marker"] and tuple(fields["marker"]),
            "stale": tuple(fields["stale"]),
            "left_out": tuple(fields["left_out"]),
        }
    )
