"""Local copies of files in a bucket that grow or change in place, or are large.

A bucket stores only complete files, so such files are written locally and uploaded. On disk the
staged file is the file itself; nothing is copied.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

from flexroad.catalog.storage.outputs import atomic_path
from flexroad.catalog.storage.paths import Location, read, write
from flexroad.catalog.storage.scratch import ScratchFolder

PUT_S = 60.0
"""Shortest time between two uploads (s)."""


class StagedFile:
    """A local copy of a file in a bucket that is uploaded from time to time.

    Parameters
    ----------
    where : Location
        The file.
    writable : bool
        Whether changes are uploaded; False for reading only.

    Attributes
    ----------
    path : Path
        The local file to read and write.
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
