"""The records of all tiles of a run, in one SQLite file: ``RUN/database.sqlite``.

The database is a cache of the tiles' markers. If it is missing, damaged or of another version, it starts
empty. If a tile has no entry, or its marker differs from the one in the entry, the marker is read instead.
One run writes the database; other processes may read it at the same time. Tables are read in pages, which
keeps read locks short and memory use small. ::

    entry   one row per tile that was ever processed: `TileRecord`
    asked   the tiles of the catalog, in its order, each with its state
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import sqlite3
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from flexroad.catalog.storage.paths import Location
from flexroad.catalog.storage.staging import StagedFile
from flexroad.pipeline.store.records import Failure, MetricsRow, TileRecord

NAME = "database.sqlite"
VERSION = 1
TileState = Literal["cached", "done", "failed", "pending"]
"""cached: already done when the last run started; pending: no result for the current files and options."""

PAGE = 500
"""Rows read at a time."""
WAIT_S = 60.0
"""Longest wait for another process to release its lock on the file (s)."""
FLUSH_S = 1.0
"""Interval between writes of recorded tiles (s)."""
FIELDS = "tile, state, fingerprint, rows, failures, sources, sizes, finished, seconds, marker"
SCHEMA = f"""
CREATE TABLE entry (tile TEXT PRIMARY KEY, state TEXT, fingerprint TEXT, rows TEXT, failures TEXT,
                    sources TEXT, sizes TEXT, finished TEXT, seconds REAL, marker TEXT);
CREATE TABLE asked (position INTEGER PRIMARY KEY, tile TEXT UNIQUE, standing TEXT);
PRAGMA user_version = {VERSION};
"""


class RunDatabase:
    """Records and states of a run's tiles; a context manager that writes all pending records on exit."""

    def __init__(self, connection: sqlite3.Connection, staged: StagedFile) -> None:
        self._connection = connection
        self._staged = staged
        self._pending: dict[str, TileRecord] = {}
        self._flushed = time.monotonic()

    @classmethod
    def open(cls, path: Location) -> RunDatabase:
        """Open a database for writing; it is created empty if it is missing or damaged.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        staged = StagedFile(path)
        staged.fetch()
        try:
            connection = _open_valid(staged.path, "rwc")
            if connection is None:
                staged.path.unlink(missing_ok=True)
                connection = _connect(staged.path, "rwc")
                connection.executescript(SCHEMA)
        except sqlite3.Error as error:
            raise _os_error(error, path) from error
        return cls(connection, staged)

    @classmethod
    def open_readonly(cls, path: Location) -> RunDatabase:
        """Open a database for reading, also while a run writes it; empty if it is missing or damaged."""
        staged = StagedFile(path, writable=False)
        staged.fetch()
        connection = None
        with contextlib.suppress(sqlite3.Error):
            connection = _open_valid(staged.path, "ro", check=False)
        if connection is None:
            connection = sqlite3.connect(":memory:")
            connection.executescript(SCHEMA)
        return cls(connection, staged)

    def __enter__(self) -> RunDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write all pending records and close the file.

        Raises
        ------
        OSError
            If the disk is full or the storage cannot be reached.
        """
        try:
            self.flush()
            self._connection.close()
            self._staged.put()
        finally:
            self._connection.close()
            self._staged.close()

    def set_states(self, tiles: Iterable[tuple[str, TileState]]) -> int:
        """Replace the list of tiles: the id and state of each, in the catalog's order.

        Returns
        -------
        int
            Number of tiles with a record that are not in the list; their records are deleted.

        Raises
        ------
        OSError
            If the disk is full.
        """
        with self._writing():
            self._connection.execute("DELETE FROM asked")
            self._connection.executemany(
                "INSERT INTO asked (tile, standing) VALUES (?, ?)",
                tiles,
            )
            deleted = self._connection.execute("DELETE FROM entry WHERE tile NOT IN (SELECT tile FROM asked)")
        return deleted.rowcount

    def record(self, entry: TileRecord) -> None:
        """Add a tile's record; it is written within seconds, on a full disk as soon as there is space."""
        self._pending[entry.tile_id] = entry
        if time.monotonic() - self._flushed > FLUSH_S:
            # A full disk does not stop the run; the write is repeated later.
            with contextlib.suppress(OSError):
                self.flush()
                self._staged.sync_if_due()

    def flush(self) -> None:
        """Write all pending records.

        Raises
        ------
        OSError
            If the disk is full.
        """
        self._flushed = time.monotonic()
        if not self._pending:
            return
        entries = list(self._pending.values())
        with self._writing():
            self._connection.executemany(
                f"INSERT OR REPLACE INTO entry ({FIELDS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                map(_to_row, entries),
            )
            self._connection.executemany(
                "UPDATE asked SET standing = ? WHERE tile = ?",
                [(entry.state, entry.tile_id) for entry in entries],
            )
        self._pending.clear()

    def get(self, tile_id: str) -> TileRecord | None:
        """Return a tile's record, None if it has none."""
        if tile_id in self._pending:
            return self._pending[tile_id]
        row = self._row(f"SELECT {FIELDS} FROM entry WHERE tile = ?", tile_id)
        return _from_row(row) if row else None

    def counts(self) -> Counter[TileState]:
        """Return the number of tiles in each state, as set by the last run."""
        self.flush()
        return Counter(
            dict(self._connection.execute("SELECT standing, count(*) FROM asked GROUP BY standing"))
        )

    def finished_since(self, start: str) -> int:
        """Return the number of tiles finished (done or failed) since a time (ISO 8601, UTC)."""
        self.flush()
        row = self._row("SELECT count(*) FROM entry WHERE finished >= ?", start)
        return int(row[0]) if row else 0

    def state(self, tile_id: str) -> TileState | None:
        """Return a tile's state as set by the last run, None if the tile was not part of it."""
        row = self._row("SELECT standing FROM asked WHERE tile = ?", tile_id)
        return row[0] if row else None

    def entries(self) -> Iterator[tuple[str, TileState, TileRecord | None]]:
        """Yield id, state and record (None if there is none) of every tile, in the catalog's order."""
        fields = ", ".join(f"entry.{name.strip()}" for name in FIELDS.split(","))
        for _, tile, state, *row in self._pages(
            f"SELECT position, asked.tile, standing, {fields} FROM asked LEFT JOIN entry USING (tile)"
            " WHERE position > ?"
        ):
            yield tile, state, _from_row(row) if row[0] else None

    def rows(self) -> Iterator[MetricsRow]:
        """Yield the metrics rows of all tiles that are not pending, in the catalog's order."""
        for _, rows in self._pages(
            "SELECT position, rows FROM asked JOIN entry USING (tile)"
            " WHERE position > ? AND standing != 'pending'"
        ):
            yield from json.loads(rows)

    def failures(self) -> Iterator[Failure]:
        """Yield the failures of all failed tiles, in the catalog's order."""
        for _, failures in self._pages(
            "SELECT position, failures FROM asked JOIN entry USING (tile)"
            " WHERE position > ? AND standing = 'failed'"
        ):
            yield from (Failure(**failure) for failure in json.loads(failures))

    def _row(self, query: str, value: str) -> Sequence[Any] | None:
        """Return the first row of a query, None if there is none or the database is damaged."""
        with contextlib.suppress(sqlite3.DatabaseError):
            row: Sequence[Any] | None = self._connection.execute(query, (value,)).fetchone()
            return row
        return None

    def _pages(self, query: str) -> Iterator[Sequence[Any]]:
        """Yield a query's rows in pages; column 0 is ``position``, the parameter the last position read."""
        self.flush()
        last = 0
        while rows := self._connection.execute(f"{query} ORDER BY position LIMIT {PAGE}", (last,)).fetchall():
            yield from rows
            last = rows[-1][0]

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            with self._connection:
                yield
        except sqlite3.Error as error:
            raise _os_error(error, self._staged.where) from error


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=WAIT_S)


def _open_valid(path: Path, mode: str, check: bool = True) -> sqlite3.Connection | None:
    """Return a connection, None if the file is missing, of another version or (with ``check``) damaged."""
    if not path.exists():
        return None
    connection = _connect(path, mode)
    try:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if version == VERSION and not (check and _damaged(connection)):
            return connection
    except sqlite3.OperationalError:
        # The file is locked or read-only, not damaged.
        connection.close()
        raise
    except sqlite3.DatabaseError:
        pass
    connection.close()
    return None


def _damaged(connection: sqlite3.Connection) -> bool:
    (result,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    return bool(result != "ok")


def _os_error(error: sqlite3.Error, path: Location) -> OSError:
    full = getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
    number, reason = (errno.ENOSPC, os.strerror(errno.ENOSPC)) if full else (errno.EIO, str(error))
    return OSError(number, reason, str(path))


def _to_row(entry: TileRecord) -> tuple[Any, ...]:
    return (
        entry.tile_id,
        entry.state,
        entry.fingerprint,
        json.dumps(entry.rows),
        json.dumps([asdict(failure) for failure in entry.failures]),
        json.dumps(entry.sources),
        json.dumps(entry.sizes),
        entry.finished,
        entry.seconds,
        json.dumps(entry.marker),
    )


def _from_row(row: Sequence[Any]) -> TileRecord:
    tile, state, fingerprint, rows, failures, sources, sizes, finished, seconds, marker = row
    file = json.loads(marker)
    return TileRecord(
        tile,
        state,
        fingerprint,
        tuple(json.loads(rows)),
        tuple(Failure(**failure) for failure in json.loads(failures)),
        json.loads(sources),
        json.loads(sizes),
        finished,
        seconds,
        (file[0], file[1], file[2]) if file else None,
    )
