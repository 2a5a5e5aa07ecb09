"""Source rasters that a thread keeps open: a tile, its corners and its edges read the same files.

Only files on disk without side-car files are kept. A file that has changed, or
whose folder has, since it was opened is opened and checked again.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexroad.catalog.guard.open_raster import open_alone, open_raster
from flexroad.catalog.storage.paths import Location

MOST = 64
"""Largest number of files that a thread keeps open: nine tiles with seven layers."""


@contextmanager
def kept_raster(path: Location) -> Iterator[Any]:
    """Open a source raster as `open_raster` does, and keep it open for the next time if nothing fails."""
    if not isinstance(path, Path):
        with open_raster(path) as dataset:
            yield dataset
        return
    path = path.absolute()
    # Before it is opened: a later change is noticed the next time.
    state = _State.of(path)
    dataset = _idle.take(path, state) or open_alone(path)
    if dataset is None:
        with open_raster(path) as dataset:
            yield dataset
        return
    try:
        yield dataset
    except BaseException:
        dataset.close()
        raise
    _idle.keep(path, state, dataset)


@dataclass(frozen=True)
class _State:
    """What shows that a file has changed, or that its folder has other files."""

    inode: int
    size: int
    mtime_ns: int
    folder_mtime_ns: int
    process: int
    """A forked process would share the position in the file with its parent."""

    @classmethod
    def of(cls, path: Path) -> _State:
        file = path.stat()
        return cls(file.st_ino, file.st_size, file.st_mtime_ns, path.parent.stat().st_mtime_ns, os.getpid())


class _Idle(threading.local):
    """The open files of a thread that it does not use at the moment."""

    def __init__(self) -> None:
        self.files = OrderedDict[Path, tuple[_State, Any]]()

    def take(self, path: Path, state: _State) -> Any | None:
        """Return the open file, None if there is none in this state."""
        before, dataset = self.files.pop(path, (None, None))
        if before == state:
            _clear_error(dataset)
            return dataset
        self._close(before, dataset)
        return None

    def keep(self, path: Path, state: _State, dataset: Any) -> None:
        """Keep an open file, and close the one that has not been used for longest if there are too many."""
        self._close(*self.files.pop(path, (None, None)))
        self.files[path] = state, dataset
        if len(self.files) > MOST:
            _, longest = self.files.popitem(last=False)
            self._close(*longest)

    @staticmethod
    def _close(state: _State | None, dataset: Any) -> None:
        if state and state.process == os.getpid():
            dataset.close()


def _clear_error(dataset: Any) -> None:
    """Clear the last error of this thread in GDAL, which may be of another file.

    Opening a file clears it. For one that is open already, rasterio would raise it from a harmless call.
    """
    # This call raises the last error, whatever its file, and so clears it.
    with contextlib.suppress(Exception):
        _ = dataset.colorinterp


_idle = _Idle()
