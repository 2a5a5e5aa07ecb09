"""All files that a source on disk consists of, and its state: what shows that any of them has changed."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from flexroad.catalog.guard.open_raster import side_car_names
from flexroad.catalog.storage.paths import FileStat, Location, file_stat, stat

SHAPEFILE_PARTS = (".shx", ".dbf", ".prj", ".cpg", ".qix", ".sbn", ".sbx", ".idm", ".ind")
SQLITE_PARTS = ("-wal", "-journal")
"""Files with changes that are not yet in a GeoPackage; ``-shm`` is an index of the first, made by readers."""
ALONE = (".geojson", ".json", ".fgb", ".osm", ".pbf")
"""Endings of vector formats of one file."""
SETTLED_NS = 2 * 10**9
"""Age at which the time of a folder shows every later change of its names."""


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
    states = [(part.rpartition("/")[2], file_stat(part)) for part in parts]
    return FileStat(own.size, f"{own.version}+{hashlib.sha256(repr(states).encode()).hexdigest()[:16]}")


def files_of(path: Path) -> Iterator[Path]:
    """Yield the files of a source: itself, and the parts beside it."""
    return map(Path, _files(str(path)))


def _files(path: str) -> Iterator[str]:
    yield path
    # Texts in place of paths, and no function for a step: a run looks up each source of each tile.
    folder, name = os.path.split(path)
    for beside in _beside(folder or ".", name):
        part = f"{folder}/{beside}" if folder else beside
        # Readers of a GeoPackage leave an empty -wal.
        if not part.endswith("-wal") or _has_bytes(part):
            yield part


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
