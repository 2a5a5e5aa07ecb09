"""Files of buckets by folder and name, as listed: millions of them in a temporary database, not in memory."""

from __future__ import annotations

import errno
import sqlite3
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from flexroad.catalog.storage.paths import FileStat, Location, entries_of, stat


class ListedFiles:
    """Sizes and versions of files; SQLite keeps a few megabytes of them in memory, the rest on disk.

    The database has no name and ends with the object. A full disk for temporary files raises OSError.
    """

    def __init__(self) -> None:
        self._connection = sqlite3.connect("", check_same_thread=False)
        self._connection.execute("PRAGMA journal_mode = OFF")
        columns = "folder TEXT, name TEXT, size INTEGER, version TEXT, PRIMARY KEY (folder, name)"
        self._connection.execute(f"CREATE TABLE file ({columns}) WITHOUT ROWID")

    def add(self, files: Iterable[tuple[str, str, FileStat]]) -> None:
        """Add files, each with its folder and its name there; they are taken one by one."""
        rows = ((folder, name, file.size, str(file.version)) for folder, name, file in files)
        try:
            self._connection.executemany("INSERT OR REPLACE INTO file VALUES (?, ?, ?, ?)", rows)
        except sqlite3.Error as error:
            raise OSError(
                errno.EIO, f"cannot keep a list of files: {error}", tempfile.gettempdir()
            ) from error

    def files(self, folder: str) -> dict[str, FileStat]:
        """Return the files of a folder by name."""
        query = "SELECT name, size, version FROM file WHERE folder = ?"
        return {name: FileStat(*rest) for name, *rest in self._connection.execute(query, (folder,))}

    def get(self, folder: str, name: str) -> FileStat | None:
        """Return one file, None if it was not listed."""
        query = "SELECT size, version FROM file WHERE folder = ? AND name = ?"
        row = self._connection.execute(query, (folder, name)).fetchone()
        return FileStat(*row) if row else None


@dataclass(frozen=True)
class StatCache:
    """Sizes and versions of files, read once each; in a bucket, with one list request per folder.

    Create one per pass over a catalog: ``stat_of = StatCache(); stat_of(path)`` returns the same as
    ``stat(path)``. Later changes of a file are not noticed.
    """

    _files: dict[Location, FileStat | None] = field(default_factory=dict)
    _listed: ListedFiles = field(default_factory=ListedFiles)
    _folders: set[str] = field(default_factory=set)
    """Folders of buckets that were listed."""

    def __call__(self, where: Location) -> FileStat | None:
        """Return a file's size and version, or None if it does not exist."""
        if not isinstance(where, Path):
            # UPath's `parent` and `name` would take as long as all the rest.
            folder, _, name = where.path.rpartition("/")
            if folder not in self._folders:
                self._listed.add((folder, name, file) for name, file in entries_of(where.parent))
                self._folders.add(folder)
            return self._listed.get(folder, name)
        if where not in self._files:
            self._files[where] = stat(where)
        return self._files[where]
