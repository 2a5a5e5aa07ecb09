"""The files of a source on disk: whether they may be opened, and whether any of them has changed."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from stat import S_ISREG

from flexroad.catalog.storage.paths import FileStat, Location, file_stat, stat

SHAPEFILE_PARTS = (".shx", ".dbf", ".prj", ".cpg", ".qix", ".sbn", ".sbx", ".idm", ".ind")
SQLITE_PARTS = ("-wal", "-journal")
"""Files with changes that are not yet in a GeoPackage; readers make ``-shm``, an index of ``-wal``."""
ALONE = (".geojson", ".json", ".fgb", ".osm", ".pbf")
"""Endings of vector formats that consist of one file."""
SETTLED_NS = 2 * 10**9
"""A folder whose time is older than this shows every later change of its names by another time."""
APPENDED = (".aux.xml", ".ovr", ".msk", ".aux")
REPLACED = (".aux.xml", ".aux", ".prj", ".tab", ".wld")
"""Endings of the side-car files of rasters, after a file's name or in place of its suffix."""
HEAD_BYTES = 65536
CHUNK_BYTES = 2**20
ARCHIVES = (b"PK\x03\x04", b"7z\xbc\xaf\x27\x1c", b"Rar!\x1a\x07", b"BZh", b"\xfd7zXZ\0")
"""First bytes of files of archives."""


class InputRejected(OSError):
    """A file that is not opened; the message continues a sentence that begins with its name."""


def head(path: Path) -> bytes:
    """Return the first bytes of a regular file; links are followed."""
    require_regular(path)
    # Opening a pipe would wait for a writer, if one has just taken the file's place.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0) as file:
        return file.read(HEAD_BYTES) or b""


def archive_note(data: bytes) -> str:
    """Return the remedy if a file is an archive, by its first bytes, to end a message; else empty."""
    is_archive = data.startswith(ARCHIVES) or data[257:262] == b"ustar"
    return "; it is an archive: unpack it first" if is_archive else ""


def read_through(path: Path) -> None:
    """Read all bytes of a regular file."""
    require_regular(path)
    with path.open("rb", buffering=0) as file:
        while file.read(CHUNK_BYTES):
            pass


def require_beside(side: Path, path: Path) -> None:
    """Raise an error if a file that a library opens with another one is not a regular file of its folder."""
    if side.is_symlink() and side.resolve().parent not in (path.resolve().parent, path.parent.resolve()):
        raise InputRejected("is a link to another folder; replace it by the file")
    head(side)


def require_regular(path: Path) -> None:
    """Raise an error if a path is not a regular file."""
    if not S_ISREG(path.stat().st_mode):
        raise InputRejected("is not a regular file; replace it by one")


def source_stat(where: Location) -> FileStat | None:
    """Return the size and version of a source; None if it does not exist.

    The version of a source of several files is a text that changes with any of them. In object storage only
    the file itself is read.
    """
    own = stat(where)
    if own is None or not isinstance(where, Path):
        return own
    path = str(where)
    parts = [part for part in _files(path) if part != path]
    if not parts:
        return own
    states = [(part.rpartition("/")[2], file_stat(part)) for part in parts]
    return FileStat(own.size, f"{own.version}+{hashlib.sha256(repr(states).encode()).hexdigest()[:16]}")


def files_of(path: Path) -> Iterator[Path]:
    """Yield the files of a source: itself, and the parts beside it."""
    return map(Path, _files(str(path)))


def _files(path: str) -> Iterator[str]:
    yield path
    # This uses texts, not paths, and few calls, for speed: a run looks up each source of each tile.
    folder, name = os.path.split(path)
    for beside in _beside(folder or ".", name):
        part = f"{folder}/{beside}" if folder else beside
        # Readers of a GeoPackage leave an empty -wal.
        if not part.endswith("-wal") or ((found := file_stat(part)) and found.size > 0):
            yield part


@lru_cache(maxsize=65536)
def _part_names(name: str) -> tuple[str, ...]:
    """Return the names that files beside a source of this name may have."""
    path, suffix = Path(name), Path(name).suffix.lower()
    if suffix == ".shp":
        return tuple(path.with_suffix(case).name for end in SHAPEFILE_PARTS for case in (end, end.upper()))
    sqlite = tuple(name + end for end in SQLITE_PARTS)
    if suffix in (*ALONE, ".gpkg"):
        return sqlite
    return (*sqlite, *dict.fromkeys(side_car_names(name)))


@lru_cache(maxsize=65536)
def side_car_names(name: str) -> tuple[str, ...]:
    """Return the names of side-car files that GDAL looks for beside a file of this name."""
    path = Path(name)
    end = path.suffix[1:]
    worlds = {f".{end}w", f".{end[:1]}{end[-1:]}w"} if end else set()
    appended = [name + case for text in APPENDED for case in (text, text.upper())]
    replaced = [
        path.with_suffix(case).name
        for text in sorted({*REPLACED, *worlds})
        for case in dict.fromkeys((text, text.lower(), text.upper()))
    ]
    return (*appended, *replaced)


def _beside(folder: str, name: str) -> tuple[str, ...]:
    """Return the names of the parts that a source has in its folder."""
    try:
        changed_ns = os.stat(folder).st_mtime_ns  # noqa: PTH116 (Path is slow)
        if time.time_ns() - changed_ns >= SETTLED_NS:
            alike = _settled_names(folder, changed_ns).get(name.partition(".")[0], ())
            return tuple(part for part in _part_names(name) if part in alike) if len(alike) > 1 else ()
    except OSError:
        # A folder that may not be listed can still permit access to single names.
        pass
    return tuple(part for part in _part_names(name) if os.path.lexists(f"{folder}/{part}"))


@lru_cache(maxsize=64)
def _settled_names(folder: str, mtime_ns: int) -> dict[str, frozenset[str]]:
    """Return the names in a folder by their start up to the first dot, which a source shares with its parts.

    Cached by the folder's time.
    """
    by_start: dict[str, set[str]] = {}
    for name in os.listdir(folder):  # noqa: PTH208 (iterdir gives no names)
        by_start.setdefault(name.partition(".")[0], set()).add(name)
    return {start: frozenset(names) for start, names in by_start.items()}
