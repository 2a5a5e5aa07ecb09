"""Files that grow or change in place, and large ones: a bucket takes only whole files, so they wait on disk.

On disk a mirror is the file itself, and costs nothing.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from flexroad.catalog.storage.paths import Location, atomic_path, read, write

PUT_S = 60.0
"""How often a mirror is put back."""


class StagedFile:
    """A local file that stands for one in a bucket, and is put back now and then.

    Parameters
    ----------
    where : Place
        The file.
    writable : bool
        Whether to put it back, or only to read it.

    Attributes
    ----------
    path : Path
        What to read and write.
    """

    def __init__(self, where: Location, writable: bool = True) -> None:
        self.where = where
        self.writable = writable
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        if isinstance(where, Path):
            self.path = where
        else:
            self._folder = tempfile.TemporaryDirectory(prefix="flexroad-")
            self.path = Path(self._folder.name) / where.name
        self._put = time.monotonic()
        self._pause = PUT_S

    def fetch(self) -> None:
        """Begin with what is there.

        Raises
        ------
        OSError
            If the storage does not answer.
        """
        if self._folder:
            with contextlib.suppress(FileNotFoundError):
                self.path.write_bytes(read(self.where))

    def sync_if_due(self) -> None:
        """Put the file back if that is due.

        Raises
        ------
        OSError
            If the storage does not answer.
        """
        if self._folder and time.monotonic() - self._put > self._pause:
            self.put()

    def put(self) -> None:
        """Put the file back.

        Raises
        ------
        OSError
            If the storage does not answer.
        """
        if self.writable and self._folder and self.path.exists():
            start = time.monotonic()
            write(self.where, self.path.read_bytes())
            self._put = time.monotonic()
            # The database of a state is large: no more than a twentieth of the time is spent on it.
            self._pause = max(PUT_S, 20 * (self._put - start))

    def close(self) -> None:
        """Forget the local file."""
        if self._folder:
            self._folder.cleanup()


@contextlib.contextmanager
def atomic_file(where: Location) -> Iterator[Path]:
    """Give a local file to write; it takes its place when all of it is there.

    Raises
    ------
    OSError
        If it cannot be written; it names the place, and nothing is left behind.
    """
    if not isinstance(where, Path):
        with tempfile.TemporaryDirectory(prefix="flexroad-") as folder:
            local = Path(folder) / where.name
            yield local
            write(where, local.read_bytes())
        return
    with atomic_path(where) as temporary:
        yield temporary
