"""Temporary folders that are removed also if their process was killed.

A process removes its folders when it ends. One that is killed cannot: a later process removes them. Whether
the process lives is known from a lock (`flock`) on a file in the folder, which the system releases when
the process ends, however that happens. Unlike a process id it cannot mean another process, also not in a
container that shares the folder of temporary files.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from weakref import finalize

PREFIX = "flexroad-"
LOCK = ".flexroad.lock"


class ScratchFolder(tempfile.TemporaryDirectory[str]):
    """A temporary folder; a context manager that gives its path, and removes it at the end.

    Without `with` it is removed by `cleanup`, or when the process ends.
    """

    def __init__(self) -> None:
        super().__init__(prefix=PREFIX, ignore_cleanup_errors=True)
        opened = _held(Path(self.name))
        self._unlock = finalize(self, os.close, opened) if opened is not None else lambda: None

    def cleanup(self) -> None:
        """Remove the folder."""
        super().cleanup()
        self._unlock()


def abandoned() -> Iterator[Path]:
    """Yield the folders of this user whose process has ended."""
    for folder in _folders():
        with contextlib.suppress(OSError), _locked(folder):
            yield folder


def remove_abandoned() -> int:
    """Remove the folders of this user whose process has ended; return their number.

    Folders without a lock file are not touched: other programs or users may have made them.
    """
    removed = 0
    for folder in _folders():
        # In use, or another process removes it.
        with contextlib.suppress(OSError), _locked(folder):
            # It does not follow links.
            shutil.rmtree(folder)
            removed += 1
    return removed


def _folders() -> Iterator[Path]:
    """Yield the folders of this user with a lock file; links to folders are left out."""
    with contextlib.suppress(OSError):
        for folder in sorted(Path(tempfile.gettempdir()).glob(f"{PREFIX}*")):
            with contextlib.suppress(OSError):
                for path, is_kind in ((folder, stat.S_ISDIR), (folder / LOCK, stat.S_ISREG)):
                    status = path.lstat()
                    if status.st_uid != os.getuid() or not is_kind(status.st_mode):
                        break
                else:
                    yield folder


def _held(folder: Path) -> int | None:
    """Return the descriptor of the locked file of a new folder, None if there can be none."""
    # The file gets its name when the lock is held: before, the folder could be taken for abandoned.
    new = folder / f"{LOCK}.new"
    try:
        opened = os.open(new, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
    except OSError:
        return None
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        new.rename(folder / LOCK)
    except OSError:
        # Not every disk has locks.
        os.close(opened)
        return None
    return opened


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder whose process has ended; raise OSError if a process holds it."""
    opened = os.open(folder / LOCK, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(opened)
