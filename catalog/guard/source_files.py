"""All files that a source on disk consists of, and its state: what shows that any of them has changed."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from flexroad.catalog.guard.open_raster import MAX_DEPTH, side_car_names, vrt_sources
from flexroad.catalog.storage.paths import FileStat, Location, file_stat, stat

SHAPEFILE_PARTS = (".shx", ".dbf", ".prj", ".cpg", ".qix", ".sbn", ".sbx", ".idm", ".ind")
SQLITE_PARTS = ("-wal", "-journal")
"""Files with changes that are not yet in a GeoPackage; ``-shm`` is an index of the first, made by readers."""
ALONE = (".geojson", ".json", ".fgb", ".osm", ".pbf")
"""Endings of vector formats of one file."""
SETTLED_NS = 2 * 10**9
"""Age at which the time of a folder shows every later change of its names."""
KEPT_S = 1.0
"""Time for which `RecentStates` keeps the state of a VRT (s)."""


def source_stat(where: Location) -> FileStat | None:
    """Return the state of a source: of one file, its size and version; None if it does not exist.

    The version of a source of several files is a text that changes with any of them. In object storage only
    the file itself counts.
    """
    own = stat(where)
    if own is None or not isinstance(where, Path):
        return own
    path = str(where)
    parts = [part for part in _files(path) if part != path]
    if not parts:
        return own
    states = [(_relative(part, path), file_stat(part)) for part in parts]
    return FileStat(own.size, f"{own.version}+{hashlib.sha256(repr(states).encode()).hexdigest()[:16]}")


def _relative(part: str, path: str) -> str:
    """Return the name of a part relative to the folder of its source, where most parts are."""
    folder, _, _ = path.rpartition("/")
    beside, _, name = part.rpartition("/")
    return name if beside == folder else os.path.relpath(part, folder or ".")


class RecentStates:
    """States of sources in one pass over tiles; that of a VRT, which may name many files, is kept for 1 s.

    A change in that second is one just after the source was looked up: the next pass notices it.
    """

    def __init__(self) -> None:
        self._kept: dict[Path, tuple[float, FileStat | None]] = {}

    def __call__(self, where: Location) -> FileStat | None:
        """Return `source_stat`."""
        if not isinstance(where, Path) or not _is_vrt(where.name):
            return source_stat(where)
        now = time.monotonic()
        then, state = self._kept.get(where, (-KEPT_S, None))
        if now - then >= KEPT_S:
            state = source_stat(where)
            self._kept[where] = now, state
        return state


def files_of(path: Path) -> Iterator[Path]:
    """Yield the files of a source: itself, the parts beside it, and those of the files that a VRT names.

    A VRT is one by its ending, so that the first bytes of other files are not read. Files that it names may
    be missing.
    """
    return map(Path, _files(str(path)))


def _files(path: str, depth: int = MAX_DEPTH) -> Iterator[str]:
    yield path
    # Texts in place of paths, and no function for a step: a run looks up each source of each tile.
    folder, name = os.path.split(path)
    for beside in _beside(folder or ".", name):
        part = f"{folder}/{beside}" if folder else beside
        # Readers of a GeoPackage leave an empty -wal.
        if not part.endswith("-wal") or _has_bytes(part):
            yield part
    if depth and _is_vrt(name):
        try:
            named = vrt_sources(Path(path))
        except OSError:
            # It is reported when it is opened.
            return
        for file in named:
            yield from _files(file, depth - 1)


def _is_vrt(name: str) -> bool:
    return name.lower().endswith(".vrt")


def _has_bytes(path: str) -> bool:
    found = file_stat(path)
    return found is not None and found.size > 0


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


def _beside(folder: str, name: str) -> tuple[str, ...]:
    """Return the names of the parts that a source has in its folder."""
    try:
        changed_ns = os.stat(folder).st_mtime_ns  # noqa: PTH116 (Path is slow)
        if time.time_ns() - changed_ns >= SETTLED_NS:
            alike = _settled_names(folder, changed_ns).get(name.partition(".")[0], ())
            return tuple(part for part in _part_names(name) if part in alike) if len(alike) > 1 else ()
    except OSError:
        # Names may be looked up in a folder that may not be listed.
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
