"""Lists of the files in buckets, and local copies of files that grow, change in place, or are large.

Millions of listed files are in a temporary database, not in memory. A bucket stores only complete files, so
files that grow are written locally and uploaded. On disk the staged file is the file itself.
"""

from __future__ import annotations

import contextlib
import errno
import sqlite3
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from flexroad.catalog.storage.outputs import atomic_path
from flexroad.catalog.storage.paths import FileStat, Location, entries_of, read, write
from flexroad.catalog.storage.scratch import ScratchFolder

if TYPE_CHECKING:
    from upath import UPath


class ListedFiles:
    """Sizes and versions of files; SQLite keeps a few megabytes of them in memory, the rest on disk.

    The database is a temporary file that ends with the object. A full disk raises OSError.
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
    """Sizes and versions of files in buckets, with one list request per folder.

    Create one per pass over a catalog: ``stat_of = StatCache(); stat_of(path)`` returns the same as
    ``stat(path)``. Later changes of a file are not noticed.
    """

    _listed: ListedFiles = field(default_factory=ListedFiles)
    _folders: set[str] = field(default_factory=set)
    """Folders of buckets that were listed."""

    def __call__(self, where: UPath) -> FileStat | None:
        """Return a file's size and version, or None if it does not exist."""
        # UPath's `parent` and `name` would double the time.
        folder, _, name = where.path.rpartition("/")
        if folder not in self._folders:
            self._listed.add((folder, name, file) for name, file in entries_of(where.parent))
            self._folders.add(folder)
        return self._listed.get(folder, name)


PUT_S = 60.0
"""Shortest time between two uploads (s)."""


class StagedFile:
    """A local copy of a file in a bucket that is uploaded from time to time.

    Its `path` is the local file to read and write. Unless it is ``writable``, changes are not uploaded.
    """

    def __init__(self, where: Location, writable: bool = True) -> None:
        self.where = where
        self.writable = writable
        self._folder: ScratchFolder | None = None
        if isinstance(where, Path):
            self.path = where
        else:
            self._folder = ScratchFolder()
            self.path = Path(self._folder.name) / where.name
        self._put = time.monotonic()
        self._pause = PUT_S

    def fetch(self) -> None:
        """Download the file; do nothing if it does not exist."""
        if self._folder:
            with contextlib.suppress(FileNotFoundError):
                self.path.write_bytes(read(self.where))

    def sync_if_due(self) -> None:
        """Upload the file if the last upload is long enough ago."""
        if self._folder and time.monotonic() - self._put > self._pause:
            self.put()

    def put(self) -> None:
        """Upload the file."""
        if self.writable and self._folder and self.path.exists():
            start = time.monotonic()
            write(self.where, self.path.read_bytes())
            self._put = time.monotonic()
            # A run database may be large: spend at most a twentieth of the time on uploads.
            self._pause = max(PUT_S, 20 * (self._put - start))

    def close(self) -> None:
        """Delete the local copy."""
        if self._folder:
            self._folder.cleanup()


@contextlib.contextmanager
def atomic_file(where: Location, flushed: bool = False) -> Iterator[Path]:
    """Yield a local file to write; at the end of the block, move or upload it to ``where``.

    With ``flushed`` the content is on the disk before the file has its name.
    """
    if not isinstance(where, Path):
        with ScratchFolder() as folder:
            local = Path(folder) / where.name
            yield local
            write(where, local.read_bytes())
        return
    with atomic_path(where, flushed) as temporary:
        yield temporary
