"""What is known of all tiles of a run, in one file that answers at once: ``RUN/database.sqlite``.

A cache of the tiles' markers, which stay the truth: a database that is missing, damaged or of another version
begins empty, and a tile without an entry, or whose marker is not the one the entry was read from, is looked
up in its folder. One run writes; others may read meanwhile. Everything is read in pages, so that nobody holds
the file for long, nor much of it in memory. ::

    entry   one line per tile that was ever tried: `TileRecord`
    asked   the tiles of the catalog, in its order, and how each stands
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
"""Cached: found done by the last run. Pending: no result of the files and options as they are."""

PAGE = 500
WAIT_S = 60.0
"""How long one side waits for the other to let go of the file."""
FLUSH_S = 1.0
FIELDS = "tile, state, fingerprint, rows, failures, sources, sizes, finished, seconds, marker"
SCHEMA = f"""
CREATE TABLE entry (tile TEXT PRIMARY KEY, state TEXT, fingerprint TEXT, rows TEXT, failures TEXT,
                    sources TEXT, sizes TEXT, finished TEXT, seconds REAL, marker TEXT);
CREATE TABLE asked (position INTEGER PRIMARY KEY, tile TEXT UNIQUE, standing TEXT);
PRAGMA user_version = {VERSION};
"""


class RunDatabase:
    """Entries by tile; use it as a context, so that what waits is written at the end."""

    def __init__(self, connection: sqlite3.Connection, mirror: StagedFile) -> None:
        self._connection = connection
        self._staged = mirror
        self._waiting: dict[str, TileRecord] = {}
        self._flushed = time.monotonic()

    @classmethod
    def open(cls, where: Location) -> RunDatabase:
        """Open a database to write, empty if there is no sound one.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        mirror = StagedFile(where)
        mirror.fetch()
        try:
            connection = _sound(mirror.path, "rwc")
            if connection is None:
                mirror.path.unlink(missing_ok=True)
                connection = _connect(mirror.path, "rwc")
                connection.executescript(SCHEMA)
        except sqlite3.Error as error:
            raise _os_error(error, where) from error
        return cls(connection, mirror)

    @classmethod
    def peek(cls, where: Location) -> RunDatabase:
        """Open a database to read only, also while a run writes it; an empty one if there is no sound one."""
        mirror = StagedFile(where, writable=False)
        mirror.fetch()
        connection = None
        with contextlib.suppress(sqlite3.Error):
            connection = _sound(mirror.path, "ro", thorough=False)
        if connection is None:
            connection = sqlite3.connect(":memory:")
            connection.executescript(SCHEMA)
        return cls(connection, mirror)

    def __enter__(self) -> RunDatabase:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write what waits, and let go of the file.

        Raises
        ------
        OSError
            If the disk is full, or the storage does not answer.
        """
        try:
            self.flush()
            self._connection.close()
            self._staged.put()
        finally:
            self._connection.close()
            self._staged.close()

    def ask(self, tiles: Iterable[tuple[str, TileState]]) -> int:
        """Set which tiles there are, in the catalog's order, and how each stands.

        Returns
        -------
        int
            How many tiles with an entry are not among them; they are forgotten.

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
            gone = self._connection.execute("DELETE FROM entry WHERE tile NOT IN (SELECT tile FROM asked)")
        return gone.rowcount

    def record(self, entry: TileRecord) -> None:
        """Keep how a tile went; written within seconds, or as soon as there is room on the disk."""
        self._waiting[entry.tile_id] = entry
        if time.monotonic() - self._flushed > FLUSH_S:
            # On a full disk the tiles go on; what waits is tried again.
            with contextlib.suppress(OSError):
                self.flush()
                self._staged.sync_if_due()

    def flush(self) -> None:
        """Write what waits.

        Raises
        ------
        OSError
            If the disk is full.
        """
        self._flushed = time.monotonic()
        if not self._waiting:
            return
        entries = list(self._waiting.values())
        with self._writing():
            self._connection.executemany(
                f"INSERT OR REPLACE INTO entry ({FIELDS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                map(_to_line, entries),
            )
            self._connection.executemany(
                "UPDATE asked SET standing = ? WHERE tile = ?",
                [(entry.state, entry.tile_id) for entry in entries],
            )
        self._waiting.clear()

    def get(self, tile_id: str) -> TileRecord | None:
        """Return what is known of a tile."""
        if tile_id in self._waiting:
            return self._waiting[tile_id]
        line = self._line(f"SELECT {FIELDS} FROM entry WHERE tile = ?", tile_id)
        return _from_line(line) if line else None

    def counts(self) -> Counter[TileState]:
        """Return how many tiles of the catalog stand how, as the last run knows."""
        self.flush()
        return Counter(
            dict(self._connection.execute("SELECT standing, count(*) FROM asked GROUP BY standing"))
        )

    def tried_since(self, when: str) -> int:
        """Return how many tiles were finished, done or failed, since a time (ISO 8601, UTC)."""
        self.flush()
        line = self._line("SELECT count(*) FROM entry WHERE finished >= ?", when)
        return int(line[0]) if line else 0

    def standing(self, tile_id: str) -> TileState | None:
        """Return how a tile stood when the last run looked at it, None if it was not asked for."""
        line = self._line("SELECT standing FROM asked WHERE tile = ?", tile_id)
        return line[0] if line else None

    def entries(self) -> Iterator[tuple[str, TileState, TileRecord | None]]:
        """Yield every tile of the catalog in its order: id, how it stands, and what is known of it."""
        fields = ", ".join(f"entry.{name.strip()}" for name in FIELDS.split(","))
        for _, tile, standing, *line in self._pages(
            f"SELECT position, asked.tile, standing, {fields} FROM asked LEFT JOIN entry USING (tile)"
            " WHERE position > ?"
        ):
            yield tile, standing, _from_line(line) if line[0] else None

    def rows(self) -> Iterator[MetricsRow]:
        """Yield the rows of all tiles that were tried as they are now, in the catalog's order."""
        for _, rows in self._pages(
            "SELECT position, rows FROM asked JOIN entry USING (tile)"
            " WHERE position > ? AND standing != 'pending'"
        ):
            yield from json.loads(rows)

    def failures(self) -> Iterator[Failure]:
        """Yield the failures of all tiles that failed as they are now, in the catalog's order."""
        for _, failures in self._pages(
            "SELECT position, failures FROM asked JOIN entry USING (tile)"
            " WHERE position > ? AND standing = 'failed'"
        ):
            yield from (Failure(**failure) for failure in json.loads(failures))

    def _line(self, query: str, value: str) -> Sequence[Any] | None:
        # What cannot be read is not known: the marker tells.
        with contextlib.suppress(sqlite3.DatabaseError):
            found: Sequence[Any] | None = self._connection.execute(query, (value,)).fetchone()
            return found
        return None

    def _pages(self, query: str) -> Iterator[Sequence[Any]]:
        """Yield the lines of a query whose first column is a position and whose first parameter the last."""
        self.flush()
        last = 0
        while lines := self._connection.execute(
            f"{query} ORDER BY position LIMIT {PAGE}", (last,)
        ).fetchall():
            yield from lines
            last = lines[-1][0]

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            with self._connection:
                yield
        except sqlite3.Error as error:
            raise _os_error(error, self._staged.where) from error


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=WAIT_S)


def _sound(path: Path, mode: str, thorough: bool = True) -> sqlite3.Connection | None:
    """Return a connection to a database that is there, of this version and, on a thorough look, whole."""
    if not path.exists():
        return None
    connection = _connect(path, mode)
    try:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if version == VERSION and not (thorough and _damaged(connection)):
            return connection
    except sqlite3.OperationalError:
        # Locked or not to be written: no fault of the file.
        connection.close()
        raise
    except sqlite3.DatabaseError:
        pass
    connection.close()
    return None


def _damaged(connection: sqlite3.Connection) -> bool:
    (check,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    return bool(check != "ok")


def _os_error(error: sqlite3.Error, where: Location) -> OSError:
    full = getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
    number, why = (errno.ENOSPC, os.strerror(errno.ENOSPC)) if full else (errno.EIO, str(error))
    return OSError(number, why, str(where))


def _to_line(entry: TileRecord) -> tuple[Any, ...]:
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


def _from_line(line: Sequence[Any]) -> TileRecord:
    tile, state, fingerprint, rows, failures, sources, sizes, finished, seconds, marker = line
    found = json.loads(marker)
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
        (found[0], found[1], found[2]) if found else None,
    )
