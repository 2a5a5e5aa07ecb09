"""The records of all tiles of a run, in one SQLite file: ``RUN/database.sqlite``.

The database is a cache of the tiles' markers. If it is missing, damaged or of another version, it starts
empty. If a tile has no entry, or its marker differs from the one in the entry, the marker is read instead.
One run writes the database; other processes may read it at the same time. Tables are read in pages, which
keeps read locks short and memory use small. ::

    entry   one row per tile that was ever processed: `TileRecord`
    asked   the tiles of the catalog, in its order, each with its state, time, lack of roads, and the checksum
            of its entry
    total   the checksums of all rows of `asked`, combined by exclusive or

Every row has a checksum, and nothing is returned that does not agree with it. A damaged, lost or old entry is
noticed by its row in `asked`, a damaged, lost or old row of `asked` by the total (`RunDatabase.listed`).
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import reduce
from operator import xor
from typing import Any, TypeVar

from flexroad.catalog.storage.paths import Location
from flexroad.catalog.storage.staging import StagedFile
from flexroad.pipeline.store.records import Failure, MetricsRow, TileRecord, TileState
from flexroad.pipeline.store.sqlite_file import (
    Damage,
    create,
    is_damage,
    open_readonly,
    open_writable,
    os_error,
)

NAME = "database.sqlite"
VERSION = 4
Recover = Callable[[str], TileRecord | None]
"""Returns the record in a tile's marker, by the tile's id."""

PAGE = 500
"""Rows read at a time."""
FLUSH_S = 1.0
"""Interval between writes of recorded tiles (s)."""
CHECKSUM_BYTES = 16
SEPARATOR = "\n"
"""Between the variants in which a tile has flags."""
TABLES = (
    "CREATE TABLE entry (tile TEXT PRIMARY KEY, finished TEXT, record TEXT, checksum BLOB)",
    "CREATE TABLE asked (position INTEGER PRIMARY KEY, tile TEXT UNIQUE, standing TEXT, finished TEXT,"
    " roadless INTEGER, flagged TEXT, record BLOB, checksum BLOB)",
    "CREATE TABLE total (checksum BLOB)",
)
T = TypeVar("T")


@dataclass(frozen=True)
class Listed:
    """Counts over the tiles of the last run."""

    counts: Counter[TileState] = field(default_factory=Counter)
    finished: int = 0
    """Number of tiles finished (done or failed) since the time asked for."""
    without_roads: int = 0
    """Number of done tiles without roads."""
    flagged: tuple[str, ...] = ()
    """Ids of the done tiles that have flags in the variant asked for."""


class RunDatabase:
    """Records and states of a run's tiles; a context manager that writes all pending records on exit."""

    def __init__(self, connection: sqlite3.Connection, staged: StagedFile, recover: Recover) -> None:
        self._connection = connection
        self._staged = staged
        self._recover = recover
        self._pending: dict[str, TileRecord] = {}
        self._flushed = time.monotonic()
        self._lost = False
        """Whether the file is damaged and could not be made anew."""

    @classmethod
    def open(cls, path: Location, recover: Recover = lambda tile_id: None) -> RunDatabase:
        """Open a database for writing; it is created empty if it is missing or damaged.

        - `path`: the file.
        - `recover`: reads the marker of a tile whose entry is lost or damaged.
        """
        staged = StagedFile(path)
        staged.fetch()
        try:
            connection = open_writable(staged.path, TABLES, VERSION)
        except Damage as error:
            raise os_error(error, path) from error
        return cls(connection, staged, recover)

    @classmethod
    def open_readonly(cls, path: Location, recover: Recover = lambda tile_id: None) -> RunDatabase:
        """Open a database for reading, also while a run writes it; empty if it is missing or damaged."""
        staged = StagedFile(path, writable=False)
        staged.fetch()
        return cls(open_readonly(staged.path, TABLES, VERSION), staged, recover)

    def __enter__(self) -> RunDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write all pending records and close the file."""
        try:
            self.flush()
            self._connection.close()
            self._staged.put()
        finally:
            self._connection.close()
            self._staged.close()

    def set_states(self, tiles: Iterable[tuple[str, TileState]]) -> int:
        """Replace the list of tiles: the id and state of each, in the catalog's order.

        - result: number of tiles with a record that are not in the list; their records are deleted.
        """
        states = list(tiles)
        return self._write(lambda: self._set_states(states))

    def record(self, entry: TileRecord) -> None:
        """Add a tile's record; it is written within seconds, on a full disk as soon as there is space."""
        self._pending[entry.tile_id] = entry
        if time.monotonic() - self._flushed > FLUSH_S:
            # A full disk does not stop the run; the write is repeated later.
            with contextlib.suppress(OSError):
                self.flush()
                self._staged.sync_if_due()

    def flush(self) -> None:
        """Write all pending records."""
        self._flushed = time.monotonic()
        if self._pending:
            self._write(self._write_pending)
            self._pending.clear()

    def get(self, tile_id: str) -> TileRecord | None:
        """Return a tile's record, None if it has none or it is damaged."""
        if tile_id in self._pending:
            return self._pending[tile_id]
        row = self._row("SELECT finished, record, checksum FROM entry WHERE tile = ?", tile_id)
        return _record(tile_id, *row) if row else None

    def lookup(self, tile_id: str) -> TileRecord | None:
        """Return a tile's record, from its marker if the database has none."""
        return self.get(tile_id) or self._recover(tile_id)

    def listed(self, tiles: Iterable[str], since: str = "", variant: str = "") -> Listed | None:
        """Return the counts over the list of tiles; None if it is damaged or has other tiles.

        - `tiles`: the ids that the list should have, in its order.
        - `since`: count the tiles finished since this time (ISO 8601, UTC).
        - `variant`: list the tiles that have flags in this variant.
        """
        self.flush()
        counts, finished, without_roads, flagged = Counter[TileState](), 0, 0, list[str]()
        combined, total = 0, bytes(CHECKSUM_BYTES)
        # One query sees one state of the file, also while a run writes it.
        query = (
            "SELECT position, tile, standing, finished, roadless, flagged, record, checksum,"
            " (SELECT checksum FROM total)"
            " FROM asked ORDER BY position"
        )
        try:
            rows = self._connection.execute(query)
            for number, (tile, row) in enumerate(zip(tiles, rows, strict=True), 1):
                *fields, checksum, total = row
                if fields[:2] != [number, tile] or digest(*fields) != checksum:
                    return None
                counts[fields[2]] += 1
                finished += bool(fields[3]) and str(fields[3]) >= since
                if fields[2] in ("done", "cached"):
                    without_roads += fields[4]
                    flagged += [tile] if variant and variant in fields[5].split(SEPARATOR) else []
                combined ^= int.from_bytes(checksum)
        except (*Damage, ValueError):
            return None
        return Listed(counts, finished, without_roads, tuple(flagged)) if total == _bytes(combined) else None

    def states(self) -> Iterator[TileState]:
        """Yield the state of every tile as set by the last run, in the catalog's order."""
        for row in self._asked():
            yield row[2]

    def entries(self) -> Iterator[tuple[str, TileState, TileRecord | None]]:
        """Yield id, state and record (None if there is none) of every tile, in the catalog's order.

        A record that is lost or damaged is read from the tile's marker.
        """
        return self._entries("")

    def rows(self) -> Iterator[MetricsRow]:
        """Yield the metrics rows of all tiles that are not pending, in the catalog's order."""
        for _, _, record in self._entries("AND standing != 'pending'"):
            yield from record.rows if record else ()

    def failures(self) -> Iterator[Failure]:
        """Yield the failures of all failed tiles, in the catalog's order."""
        for _, _, record in self._entries("AND standing = 'failed'"):
            yield from record.failures if record else ()

    def _entries(self, condition: str) -> Iterator[tuple[str, TileState, TileRecord | None]]:
        for _, tile, state, _, _, _, link, _ in self._asked(condition):
            # No join: where an entry cannot be read, the rest of the page can.
            row = self._row("SELECT finished, record FROM entry WHERE tile = ?", tile) if link else None
            record = _record(tile, row[0], row[1], link) if row else None
            yield tile, state, self._recover(tile) if record is None and state != "pending" else record

    def _asked(self, condition: str = "") -> Iterator[Sequence[Any]]:
        """Yield rows of `asked`, read in pages."""
        self.flush()
        query = (
            "SELECT position, tile, standing, finished, roadless, flagged, record, checksum FROM asked"
            f" WHERE position > ? {condition} ORDER BY position LIMIT {PAGE}"
        )
        last = 0
        while page := self._page(query, last):
            for row in page:
                if digest(*row[:7]) != row[7] or row[0] <= last:
                    raise OSError(errno.EIO, "the list of tiles is damaged", str(self._staged.where))
                last = row[0]
                yield row

    def _page(self, query: str, last: int) -> list[Sequence[Any]]:
        try:
            return self._connection.execute(query, (last,)).fetchall()
        except Damage as error:
            raise os_error(error, self._staged.where) from error

    def _row(self, query: str, value: str) -> Sequence[Any] | None:
        """Return the first row of a query, None if there is none or the database is damaged."""
        with contextlib.suppress(*Damage):
            row: Sequence[Any] | None = self._connection.execute(query, (value,)).fetchone()
            return row
        return None

    def _set_states(self, tiles: Sequence[tuple[str, TileState]]) -> int:
        execute = self._connection.execute
        execute("DELETE FROM asked")
        combined = 0
        for position, (tile, state) in enumerate(tiles, 1):
            entry = execute("SELECT finished, record, checksum FROM entry WHERE tile = ?", (tile,)).fetchone()
            record = _record(tile, *entry) if entry else None
            about = (entry[0], *_marks(record), entry[2]) if record else ("", 0, "", b"")
            fields = (position, tile, state, *about)
            checksum = digest(*fields)
            execute("INSERT INTO asked VALUES (?, ?, ?, ?, ?, ?, ?, ?)", (*fields, checksum))
            combined ^= int.from_bytes(checksum)
        execute("DELETE FROM total")
        execute("INSERT INTO total VALUES (?)", (_bytes(combined),))
        others = "FROM entry WHERE tile NOT IN (SELECT tile FROM asked)"
        vanished = execute(f"SELECT tile, finished, record, checksum {others}")
        count = sum(digest(*fields) == checksum for *fields, checksum in vanished)
        execute(f"DELETE {others}")
        return int(count)

    def _write_pending(self) -> None:
        changes: list[int] = []
        for entry in self._pending.values():
            content = vars(entry) | {"failures": [asdict(failure) for failure in entry.failures]}
            row = (entry.tile_id, entry.finished, json.dumps(content))
            checksum = digest(*row)
            self._connection.execute("INSERT OR REPLACE INTO entry VALUES (?, ?, ?, ?)", (*row, checksum))
            change = self._update_asked(entry, checksum)
            if change is None:
                # Without a total the list counts as damaged.
                self._connection.execute("DELETE FROM total")
            else:
                changes.append(change)
        for (total,) in self._connection.execute("SELECT checksum FROM total").fetchall():
            if isinstance(total, bytes) and len(total) == CHECKSUM_BYTES:
                combined = _bytes(reduce(xor, changes, int.from_bytes(total)))
                self._connection.execute("UPDATE total SET checksum = ?", (combined,))

    def _update_asked(self, entry: TileRecord, link: bytes) -> int | None:
        """Set a tile's state and the checksum of its entry; return the change of the total.

        It is None if the tile has no row, or a damaged one, which stays as it is.
        """
        query = (
            "SELECT position, standing, finished, roadless, flagged, record, checksum FROM asked"
            " WHERE tile = ?"
        )
        row = self._connection.execute(query, (entry.tile_id,)).fetchone()
        if row is None or digest(row[0], entry.tile_id, *row[1:6]) != row[6]:
            return None
        fields = (row[0], entry.tile_id, entry.state, entry.finished, *_marks(entry), link)
        checksum = digest(*fields)
        self._connection.execute(
            "UPDATE asked SET standing = ?, finished = ?, roadless = ?, flagged = ?, record = ?, checksum = ?"
            " WHERE position = ?",
            (*fields[2:], checksum, row[0]),
        )
        return int.from_bytes(row[6]) ^ int.from_bytes(checksum)

    def _write(self, change: Callable[[], T]) -> T:
        """Write in one transaction, into a new and empty file if the old one turns out to be damaged."""
        try:
            try:
                if not self._lost:
                    with self._connection:
                        return change()
            except Damage as error:
                if not is_damage(error):
                    raise
            self._connection.close()
            # A full disk takes no new file: each later write tries again.
            self._lost = True
            self._connection = create(self._staged.path, TABLES, VERSION)
            self._lost = False
            with self._connection:
                return change()
        except Damage as error:
            raise os_error(error, self._staged.where) from error


def _marks(record: TileRecord) -> tuple[int, str]:
    """Return whether a tile has no roads, and the variants in which it has flags, as the list has them."""
    return int(record.without_roads), SEPARATOR.join(record.flagged)


def digest(*fields: Any) -> bytes:
    """Return a checksum over the fields of a row and their types."""
    return hashlib.blake2b(repr(fields).encode(), digest_size=CHECKSUM_BYTES).digest()


def _bytes(combined: int) -> bytes:
    return combined.to_bytes(CHECKSUM_BYTES)


def _record(tile_id: str, finished: Any, text: Any, checksum: Any) -> TileRecord | None:
    """Return the record in an entry's row, None if it does not have the checksum."""
    if digest(tile_id, finished, text) != checksum:
        return None
    content = json.loads(text)
    marker = content["marker"]
    return TileRecord(
        **content
        | {
            "rows": tuple(content["rows"]),
            "failures": tuple(Failure(**failure) for failure in content["failures"]),
            "marker": (marker[0], marker[1], marker[2]) if marker else None,
            "stale": tuple(content.get("stale", ())),
            "left_out": tuple(content.get("left_out", ())),
        }
    )
