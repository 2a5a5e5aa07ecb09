"""Interception of what SQLite writes: its file functions are replaced in the structures of its C interface.

Where Python's SQLite does not show these structures (a static library), SQLite's operations are not seen.
"""

import contextlib
import ctypes
import errno
import os
from collections.abc import Callable, Iterator
from ctypes import CFUNCTYPE, POINTER, Structure, c_int, c_int64, c_void_p, cast, string_at
from pathlib import Path

FULL, CANTOPEN = 13, 14
IOERR_WRITE, IOERR_FSYNC, IOERR_TRUNCATE, IOERR_DELETE = (10 | number << 8 for number in (3, 4, 6, 10))
OPEN_CREATE = 0x4
SPLIT = 16
"""Shortest write that is split in two (bytes)."""
_OPEN = CFUNCTYPE(c_int, c_void_p, c_void_p, c_void_p, c_int, c_void_p)
_DELETE = CFUNCTYPE(c_int, c_void_p, c_void_p, c_int)
_WRITE = CFUNCTYPE(c_int, c_void_p, c_void_p, c_int, c_int64)
_TRUNCATE = CFUNCTYPE(c_int, c_void_p, c_int64)
_SYNC = CFUNCTYPE(c_int, c_void_p, c_int)
Announce = Callable[..., None]


class _Vfs(Structure):
    """The start of sqlite3_vfs."""

    _fields_ = (
        ("iVersion", c_int),
        ("szOsFile", c_int),
        ("mxPathname", c_int),
        ("pNext", c_void_p),
        ("zName", c_void_p),
        ("pAppData", c_void_p),
        ("xOpen", c_void_p),
        ("xDelete", c_void_p),
    )


class _Methods(Structure):
    """sqlite3_io_methods."""

    _fields_ = (
        ("iVersion", c_int),
        *((name, c_void_p) for name in ("xClose", "xRead", "xWrite", "xTruncate", "xSync")),
        ("others", c_void_p * 13),
    )


class _Shim:
    """The replaced functions; they stay as long as the process, and without an observer only pass on."""

    def __init__(self, vfs: _Vfs) -> None:
        self.announce: Announce | None = None
        self._names: dict[int, Path] = {}
        self._new: set[Path] = set()
        self._methods: dict[int, _Methods] = {}
        self._plain_open, self._plain_delete = _OPEN(vfs.xOpen), _DELETE(vfs.xDelete)
        self._kept: list[object] = [_OPEN(self._open), _DELETE(self._delete)]
        vfs.xOpen, vfs.xDelete = (cast(function, c_void_p).value for function in self._kept)

    def _tell(self, code: int, kind: str, path: Path, **fields) -> int:
        """Announce an operation; return 0 or the code of the error that the observer has raised."""
        try:
            if self.announce:
                self.announce(kind, path, **fields)
        except OSError as error:
            return FULL if error.errno == errno.ENOSPC and code != CANTOPEN else code
        return 0

    def _open(self, vfs, name, file, flags, out) -> int:
        path = Path(os.fsdecode(string_at(name))) if name else None
        if self.announce and path and flags & OPEN_CREATE and not path.exists():
            if code := self._tell(CANTOPEN, "create", path):
                cast(file, POINTER(c_void_p))[0] = None
                return code
            self._new.add(path)
        code = self._plain_open(vfs, name, file, flags, out)
        methods = cast(file, POINTER(c_void_p))
        if self.announce and path and not code and methods[0]:
            self._names[file] = path
            methods[0] = ctypes.addressof(self._observed(methods[0]))
        return code

    def _delete(self, vfs, name, sync_folder) -> int:
        path = Path(os.fsdecode(string_at(name)))
        if path.exists() and (code := self._tell(IOERR_DELETE, "remove", path)):
            return code
        code = self._plain_delete(vfs, name, sync_folder)
        if sync_folder and not code:
            code = self._tell(IOERR_FSYNC, "fsync", path.parent)
        return code

    def _observed(self, plain: int) -> _Methods:
        """Return a copy of a table of functions in which those that write are replaced."""
        if plain in self._methods:
            return self._methods[plain]
        copy = _Methods.from_buffer_copy(string_at(plain, ctypes.sizeof(_Methods)))
        write, truncate, sync = _WRITE(copy.xWrite), _TRUNCATE(copy.xTruncate), _SYNC(copy.xSync)

        def observed_write(file, data, size, offset) -> int:
            content, half = string_at(data, size), size // 2
            for start, end in ((0, half), (half, size)) if size >= SPLIT else ((0, size),):
                told = self._tell(
                    IOERR_WRITE, "write", self._names[file], offset=offset + start, data=content[start:end]
                )
                if code := told or write(file, data + start, end - start, offset + start):
                    return code
            return 0

        def observed_truncate(file, size) -> int:
            told = self._tell(IOERR_TRUNCATE, "truncate", self._names[file], offset=size)
            return told or truncate(file, size)

        def observed_sync(file, flags) -> int:
            path = self._names[file]
            if not self.announce:
                return sync(file, flags)
            # As in `tests.faulty_files`, the disk itself is not waited for.
            if code := self._tell(IOERR_FSYNC, "fsync", path):
                return code
            if path in self._new and path.name.endswith("-journal"):
                # SQLite writes the name of a new journal to the disk, too.
                self._new.discard(path)
                return self._tell(IOERR_FSYNC, "fsync", path.parent)
            return 0

        functions = (_WRITE(observed_write), _TRUNCATE(observed_truncate), _SYNC(observed_sync))
        self._kept += functions
        copy.xWrite, copy.xTruncate, copy.xSync = (cast(function, c_void_p).value for function in functions)
        self._methods[plain] = copy
        return copy


def _installed() -> _Shim | None:
    """Return the shim, None if SQLite does not show its structures."""
    import _sqlite3

    try:
        library = ctypes.CDLL(getattr(_sqlite3, "__file__", None))
        library.sqlite3_vfs_find.restype = POINTER(_Vfs)
        return _Shim(library.sqlite3_vfs_find(None).contents)
    except (OSError, AttributeError, ValueError):
        return None


_shims: list[_Shim | None] = []


@contextlib.contextmanager
def observed(announce: Announce) -> Iterator[None]:
    """Announce what SQLite writes, by ``announce(kind, path, offset=..., data=...)``."""
    if not _shims:
        _shims.append(_installed())
    (shim,) = _shims
    if shim is None:
        yield
        return
    shim.announce = announce
    try:
        yield
    finally:
        shim.announce = None
