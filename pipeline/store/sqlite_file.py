"""A SQLite file that may be damaged: opening, making it anew, and telling damage from other errors."""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from pathlib import Path

from flexroad.catalog.storage.paths import Location

WAIT_S = 60.0
"""Longest wait for another process to release its lock on the file (s)."""
OTHER_CAUSES = frozenset(
    {
        sqlite3.SQLITE_BUSY,
        sqlite3.SQLITE_LOCKED,
        sqlite3.SQLITE_FULL,
        sqlite3.SQLITE_IOERR,
        sqlite3.SQLITE_CANTOPEN,
        sqlite3.SQLITE_PERM,
        sqlite3.SQLITE_READONLY,
        sqlite3.SQLITE_AUTH,
        sqlite3.SQLITE_INTERRUPT,
        sqlite3.SQLITE_PROTOCOL,
        sqlite3.SQLITE_NOLFS,
    }
)
"""Codes of errors that do not come from the content of the file."""
UNREADABLE = frozenset({sqlite3.SQLITE_IOERR_READ, sqlite3.SQLITE_IOERR_SHORT_READ})
Damage = (sqlite3.Error, MemoryError, UnicodeError)
"""Errors of a damaged file; `is_damage` tells them from others.

A damaged length may exceed the memory, and a message about damaged text may not be text.
"""


def is_damage(error: BaseException, readonly: bool = False) -> bool:
    """Return whether an error comes from the content of the file, not from its disk or other processes.

    ``readonly`` is whether that includes a file that calls itself read-only: one byte of it can.
    """
    if isinstance(error, sqlite3.ProgrammingError | sqlite3.InterfaceError):
        return False
    code = getattr(error, "sqlite_errorcode", None)
    if code is None or code in UNREADABLE:
        return True
    return code & 0xFF not in OTHER_CAUSES or (readonly and code & 0xFF == sqlite3.SQLITE_READONLY)


def os_error(error: BaseException, path: Location) -> OSError:
    """Return an error of SQLite as an error of the file."""
    if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL:
        return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    # The connection is closed after a new file could not be made.
    closed = isinstance(error, sqlite3.ProgrammingError)
    reason = "it is damaged and could not be made anew" if closed else str(error)
    return OSError(errno.EIO, reason, str(path))


def open_writable(path: Path, tables: tuple[str, ...], version: int) -> sqlite3.Connection:
    """Open a file for writing; it is made anew if it is missing, damaged or of another version.

    - `path`: the file.
    - `tables`: the statements that create its tables.
    - `version`: version of the tables.
    """
    if path.exists():
        connection = _connect(path, "rwc")
        try:
            if _is_valid(connection, tables, version) and _is_sound(connection):
                return connection
        except Damage as error:
            if not is_damage(error, readonly=True):
                connection.close()
                raise
        connection.close()
    return create(path, tables, version)


def open_readonly(path: Path, tables: tuple[str, ...], version: int) -> sqlite3.Connection:
    """Open a file for reading; an empty one in memory if it is missing, damaged or of another version."""
    if path.exists():
        with contextlib.suppress(*Damage):
            connection = _connect(path, "ro")
            with contextlib.suppress(*Damage):
                if _is_valid(connection, tables, version):
                    return connection
            connection.close()
    return _with_tables(_decoding(sqlite3.connect(":memory:")), tables, version)


def create(path: Path, tables: tuple[str, ...], version: int) -> sqlite3.Connection:
    """Make an empty file in place of what is there, which may still be open elsewhere."""
    # A journal that is left behind would be applied to the new file.
    for end in ("", "-journal", "-wal", "-shm"):
        path.with_name(path.name + end).unlink(missing_ok=True)
    # SQLite would leave others without the rights that the umask gives them.
    path.touch()
    return _with_tables(_connect(path, "rwc"), tables, version)


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    return _decoding(
        sqlite3.connect(f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=WAIT_S),
    )


def _decoding(connection: sqlite3.Connection) -> sqlite3.Connection:
    # Damaged text is to fail its checksum, not the query.
    connection.text_factory = lambda data: data.decode("utf-8", "surrogateescape")
    return connection


def _with_tables(connection: sqlite3.Connection, tables: tuple[str, ...], version: int) -> sqlite3.Connection:
    statements = ["BEGIN", *tables, f"PRAGMA user_version = {version}", "COMMIT;"]
    connection.executescript(";\n".join(statements))
    return connection


def _is_valid(connection: sqlite3.Connection, tables: tuple[str, ...], version: int) -> bool:
    """Return whether the file has exactly these tables."""
    (found,) = connection.execute("PRAGMA user_version").fetchone()
    if found != version:
        return False
    made = connection.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY rowid")
    return [text for (text,) in made] == list(tables)


def _is_sound(connection: sqlite3.Connection) -> bool:
    """Return whether the pages of the file are in order; leaves it writable and without other journals."""
    (result,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    (journal,) = connection.execute("PRAGMA journal_mode = DELETE").fetchone()
    # One damaged byte makes a file read-only, which only a write tells.
    connection.execute("BEGIN")
    connection.execute("PRAGMA user_version = 0")
    connection.rollback()
    return bool(result == "ok" and journal == "delete")
