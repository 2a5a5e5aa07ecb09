"""Interception of what this process writes below a folder, for tests of faults.

An observer is called before each operation. It may raise OSError, and the operation fails with this error, or
end the process. Seen are files that Python opens, functions of ``os``, and pyarrow's tables; the product's
GDAL writes only to memory. A longer write is two operations, so that a fault also leaves half-written data.
"""

import builtins
import contextlib
import errno
import io
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from unittest import mock

SPLIT = 16
"""Shortest write that is split in two (bytes)."""
Kind = Literal["create", "write", "truncate", "fsync", "rename", "link", "remove", "mkdir", "rmdir"]


@dataclass(frozen=True)
class Operation:
    kind: Kind
    path: Path
    target: Path | None = None
    """The new name of a renamed or linked file."""
    offset: int = 0
    """Where data are written, or the new size of a truncated file (bytes)."""
    data: bytes = b""


Observer = Callable[[Operation], None]


@dataclass
class Faulty:
    """An observer that counts operations and lets one fail, or all that need space from there on."""

    at: int
    act: Callable[[], None]
    lasting: bool = False
    met: list[Operation] = field(default_factory=list)
    failed: list[Operation] = field(default_factory=list)

    def __call__(self, operation: Operation) -> None:
        number = len(self.met)
        self.met.append(operation)
        needs_space = operation.kind in ("create", "write", "mkdir")
        if number == self.at or (self.lasting and number > self.at and needs_space):
            self.failed.append(operation)
            self.act()


def _raise(number: int) -> None:
    raise OSError(number, os.strerror(number))


FAULTS = {
    "no space": lambda at: Faulty(at, lambda: _raise(errno.ENOSPC)),
    "disk stays full": lambda at: Faulty(at, lambda: _raise(errno.ENOSPC), lasting=True),
    "input/output error": lambda at: Faulty(at, lambda: _raise(errno.EIO)),
    "killed": lambda at: Faulty(at, lambda: os.kill(os.getpid(), signal.SIGKILL)),
}


@contextlib.contextmanager
def intercepted(root: Path, observer: Observer) -> Iterator[None]:
    """Call ``observer`` before every operation of this process below a folder."""
    root = root.resolve()

    def announce(kind: Kind, path: Path, **fields) -> None:
        if path.is_relative_to(root):
            observer(Operation(kind, path, **fields))

    import pyarrow.parquet as pq

    patches = [mock.patch.object(os, name, make(announce)) for name, make in _FUNCTIONS.items()]
    opened = _opening(root, announce)
    patches += [mock.patch.object(module, "open", opened) for module in (builtins, io)]
    patches.append(mock.patch.object(pq, "ParquetWriter", _ThroughPython))
    with contextlib.ExitStack() as stack:
        for patch in patches:
            stack.enter_context(patch)
        yield


def _located(path: str | os.PathLike | int, folder: int | None = None) -> Path:
    """Return the absolute path of a name or a file descriptor."""
    if isinstance(path, int):
        return Path(f"/proc/self/fd/{path}").readlink()
    start = Path.cwd() if folder is None else _located(folder)
    return start / os.fsdecode(path)


class _RawFile(io.FileIO):
    """A file that announces its writes and splits them: the first half, then the rest."""

    def __init__(self, file, mode: str, closefd: bool, opener, announce) -> None:
        super().__init__(file, mode, closefd, opener)
        self._announce, self._split = announce, False

    def write(self, data) -> int:
        view = memoryview(data).cast("B")
        self._split = not self._split and len(view) >= SPLIT
        part = view[: len(view) // 2] if self._split else view
        offset = os.fstat(self.fileno()).st_size if "a" in self.mode else self.tell()
        self._announce("write", _located(self.fileno()), offset=offset, data=bytes(part))
        return super().write(part)

    def truncate(self, size=None) -> int:
        size = self.tell() if size is None else size
        self._announce("truncate", _located(self.fileno()), offset=size)
        return super().truncate(size)


def _opening(root: Path, announce):
    plain = io.open

    def opened(
        file, mode="r", buffering=-1, encoding=None, errors=None, newline=None, closefd=True, opener=None
    ):
        unnamed = opener is not None and Path(file).is_dir()
        if not set(mode) & set("wax+") or unnamed or not _located(file).is_relative_to(root):
            return plain(file, mode, buffering, encoding, errors, newline, closefd, opener)
        if not isinstance(file, int):
            _announce_opening(_located(file), "r" not in mode, "w" in mode, announce)
        raw = _RawFile(file, mode.replace("t", "").replace("b", ""), closefd, opener, announce)
        buffer = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffer
        return io.TextIOWrapper(buffer, encoding, errors, newline, line_buffering=buffering == 1)

    return opened


def _announce_opening(path: Path, creates: bool, empties: bool, announce) -> None:
    if not path.exists():
        if creates:
            announce("create", path)
    elif empties:
        announce("truncate", path)


def _low_level_open(announce):
    plain = os.open

    def opened(path, flags, mode=0o777, *, dir_fd=None):
        if flags & os.O_TMPFILE != os.O_TMPFILE:
            _announce_opening(
                _located(path, dir_fd), bool(flags & os.O_CREAT), bool(flags & os.O_TRUNC), announce
            )
        return plain(path, flags, mode, dir_fd=dir_fd)

    return opened


def _fsync(announce):
    def fsync(file):
        # No power failure will come: without the real flush the tests do not wait for the disk.
        announce("fsync", _located(file if isinstance(file, int) else file.fileno()))

    return fsync


def _one_path(name: str, kind: Kind, on_existing: bool):
    """Announce a function of one path, unless it will fail because the path exists or does not."""

    def make(announce):
        plain = getattr(os, name)

        def function(path, *arguments, dir_fd=None, **more):
            where = _located(path, dir_fd)
            if os.path.lexists(where) == on_existing and where.parent.is_dir():
                announce(kind, where)
            return plain(path, *arguments, dir_fd=dir_fd, **more)

        return function

    return make


def _two_paths(name: str, kind: Kind):
    def make(announce):
        plain = getattr(os, name)

        def function(source, target, **more):
            if os.path.lexists(source):
                announce(kind, _located(source), target=_located(target))
            return plain(source, target, **more)

        return function

    return make


_FUNCTIONS = {
    "open": _low_level_open,
    "fsync": _fsync,
    "unlink": _one_path("unlink", "remove", True),
    "remove": _one_path("remove", "remove", True),
    "rmdir": _one_path("rmdir", "rmdir", True),
    "mkdir": _one_path("mkdir", "mkdir", False),
    "replace": _two_paths("replace", "rename"),
    "rename": _two_paths("rename", "rename"),
    "link": _two_paths("link", "link"),
}


def _parquet_writer():
    import pyarrow as pa
    import pyarrow.parquet as pq

    class ThroughPython(pq.ParquetWriter):
        """Writes a table through a Python file, not in C++; one in memory as it is."""

        def __init__(self, where, schema, **options) -> None:
            in_memory = isinstance(where, pa.NativeFile)
            self._python_file = where if in_memory else Path(where).open("wb")  # noqa: SIM115 (closed with the table)
            super().__init__(self._python_file, schema, **options)

        def close(self) -> None:
            super().close()
            if not isinstance(self._python_file, pa.NativeFile):
                self._python_file.close()

    return ThroughPython


_ThroughPython = _parquet_writer()
