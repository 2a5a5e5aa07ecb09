"""Temporary folders that are removed even if their process was killed.

A process removes its folders when it ends. If it is killed, a later process removes them. A lock (`flock`) on
a file in the folder shows whether the process lives: the system always releases it when the process ends.
A process id could belong to another process, also of a container that shares the folder of temporary files.
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
HIDDEN = f".{PREFIX}"
"""Prefix beside outputs."""
LOCK = ".flexroad.lock"


class ScratchFolder(tempfile.TemporaryDirectory[str]):
    """A temporary folder; a context manager that gives its path, and removes it at the end.

    Without `with` it is removed by `cleanup`, or when the process ends. A parent folder is for outputs that
    are renamed or need much space. There the folder is hidden, and folders of ended processes are removed.
    """

    def __init__(self, parent: Path | None = None) -> None:
        if parent is not None:
            remove_abandoned(parent)
        while True:
            super().__init__(prefix=HIDDEN if parent else PREFIX, dir=parent, ignore_cleanup_errors=True)
            try:
                opened = _held(Path(self.name))
                break
            except (FileNotFoundError, BlockingIOError):
                # Another process has removed it as abandoned.
                super().cleanup()
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


def remove_abandoned(parent: Path | None = None) -> int:
    """Remove the folders of this user whose process has ended, in a parent folder; return their number.

    By default the parent is the system's temporary folder. Folders without a lock file stay, because other
    programs or users may have made them. Only empty hidden folders go: their process ended before the lock.
    """
    removed = 0
    for folder in _folders(parent):
        # The folder is in use, or another process removes it.
        with contextlib.suppress(OSError), _locked(folder):
            # `rmtree` does not follow links.
            shutil.rmtree(folder)
            removed += 1
    for folder in parent.glob(f"{HIDDEN}*") if parent else ():
        with contextlib.suppress(OSError):
            folder.rmdir()
    return removed


def _folders(parent: Path | None = None) -> Iterator[Path]:
    """Yield the folders of this user with a lock file; links to folders are left out."""
    with contextlib.suppress(OSError):
        where = parent or Path(tempfile.gettempdir())
        for folder in sorted(where.glob(f"{HIDDEN if parent else PREFIX}*")):
            with contextlib.suppress(OSError):
                for path, is_kind in ((folder, stat.S_ISDIR), (folder / LOCK, stat.S_ISREG)):
                    status = path.lstat()
                    if status.st_uid != os.getuid() or not is_kind(status.st_mode):
                        break
                else:
                    yield folder


def _held(folder: Path) -> int | None:
    """Return the descriptor of the locked file of a new folder, None if it cannot be locked."""
    try:
        opened = os.open(folder / LOCK, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
    except FileNotFoundError:
        raise
    except OSError:
        return None
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(opened)
        if isinstance(error, BlockingIOError):
            raise
        # Not every disk supports locks.
        return None
    if not os.fstat(opened).st_nlink:
        os.close(opened)
        raise FileNotFoundError(folder / LOCK)
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
