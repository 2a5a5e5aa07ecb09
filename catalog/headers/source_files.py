"""All files that a source on disk consists of, and its state: what shows that any of them has changed."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from flexroad.catalog.headers.open_raster import MAX_DEPTH, candidates, vrt_sources
from flexroad.catalog.storage.paths import FileStat, Location, stat

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
    parts = [part for part in files_of(where) if part != where]
    if not parts:
        return own
    states = [(os.path.relpath(part, where.parent), stat(part)) for part in parts]
    return FileStat(own.size, f"{own.version}+{hashlib.sha256(repr(states).encode()).hexdigest()[:16]}")


def files_of(path: Path, depth: int = MAX_DEPTH) -> Iterator[Path]:
    """Yield the files of a source: itself, the parts beside it, and those of the files that a VRT names.

    A VRT is one by its ending, so that the first bytes of other files are not read. Files that it names may
    be missing.
    """
    yield path
    beside = _beside(path)
    if len(beside) > 1:
        parts = (path.with_name(name) for name in _part_names(path.name) if name in beside)
        # Readers of a GeoPackage leave an empty -wal.
        yield from (part for part in parts if not part.name.endswith("-wal") or _has_bytes(part))
    if depth and path.suffix.lower() == ".vrt":
        try:
            named = vrt_sources(path)
        except OSError:
            # It is reported when it is opened.
            return
        for name in named:
            yield from files_of(Path(name), depth - 1)


def _has_bytes(path: Path) -> bool:
    found = stat(path)
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
    return (*sqlite, *dict.fromkeys(side.name for side in candidates(path)))


def _beside(path: Path) -> frozenset[str]:
    """Return the names in a folder that begin as that of a file up to its first dot, as its parts do."""
    folder, start = path.parent, path.name.partition(".")[0]
    try:
        changed_ns = folder.stat().st_mtime_ns
        if time.time_ns() - changed_ns < SETTLED_NS:
            return _names(folder).get(start, frozenset())
        return _settled_names(folder, changed_ns).get(start, frozenset())
    except OSError:
        return frozenset()


@lru_cache(maxsize=64)
def _settled_names(folder: Path, mtime_ns: int) -> dict[str, frozenset[str]]:
    """Return the names in a folder by their start; cached by the folder's time."""
    return _names(folder)


def _names(folder: Path) -> dict[str, frozenset[str]]:
    by_start: dict[str, set[str]] = {}
    for name in os.listdir(folder):  # noqa: PTH208 (iterdir gives no names)
        by_start.setdefault(name.partition(".")[0], set()).add(name)
    return {start: frozenset(names) for start, names in by_start.items()}
