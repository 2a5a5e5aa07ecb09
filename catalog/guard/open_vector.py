"""Check of source vector files before GDAL opens them: regular files of known formats that lead nowhere else.

pyogrio cannot be told which drivers to use, and GDAL chooses by content, whatever a file's name: an OGR VRT
named ``roads.geojson`` would make it read other files or the web. So the format is found here by the first
bytes. Only formats pass that GDAL cannot take for another format.
"""

from __future__ import annotations

import contextlib
import errno
import json
import mmap
import os
import re
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterable
from contextlib import closing
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeVar
from weakref import finalize
from xml.parsers import expat

from flexroad.catalog.gdal_options import settle_vectors
from flexroad.catalog.guard.source_files import (
    SHAPEFILE_PARTS,
    SQLITE_PARTS,
    InputRejected,
    archive_note,
    head,
    require_beside,
    source_stat,
)
from flexroad.catalog.guard.vector_contents import opened, require_sound_contents
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import FileStat
from flexroad.catalog.storage.scratch import ScratchFolder

pyogrio = lazy("pyogrio")

UNKNOWN = (
    "is not a vector file: it is no GeoPackage, SpatiaLite, FlatGeobuf, Shapefile, GeoJSON or OSM file; "
    "convert it with ogr2ogr, e.g. ogr2ogr NEW.gpkg FILE"
)
SHAPEFILE = b"\0\0\x27\x0a"
SHAPEFILE_HEADER_BYTES = 100
DBF_HEADER_BYTES = 32
SQLITE = b"SQLite format 3\0"
GEOPACKAGES = (b"GPKG", b"GP10", b"GP11")
WAL_MODE = b"\2\2"
"""Bytes 18 and 19 of a SQLite file whose changes are first written to a ``-wal`` file."""
MOST_COPIES = 8
"""Largest number of copies of GeoPackages that a process keeps."""
CRS = re.compile(rb"""["'](?:c|\\u00[46]3)(?:r|\\u00[57]2)(?:s|\\u00[57]3)["']\s*""", re.IGNORECASE)
OTHER_THAN_OSM = re.compile(
    rb"\0|<(?!/?(?:osm|bounds?|node|way|relation|tag|nd|member|note|meta)[\s/>]|\?xml\s)"
)
VIRTUAL = re.compile(r"create(\s|/\*.*?\*/|--.*?\n)+virtual\b", re.IGNORECASE | re.DOTALL)
INDEX = re.compile(
    r"""CREATE VIRTUAL TABLE\s+("[^"]*"|'[^']*'|\w+)\s+USING\s+"""
    r"(rtree|fts[345]|VirtualSpatialIndex|VirtualElementary|VirtualKNN2?)\s*(\(|$)",
    re.IGNORECASE,
)
"""Virtual tables that are made of the file's own tables."""
MAX_CRS_BYTES = 65536
"""Longest text of a CRS in GeoJSON."""
ERRORS = (RuntimeError, ValueError, OSError, UnboundLocalError)
"""Errors of pyogrio for damaged files; the last is for a name in the CRS that is not UTF-8."""
LINKS = ("link", "url")
T = TypeVar("T")


def vector_name(path: Path) -> str:
    """Return the name by which GDAL opens a vector file, and no other file."""
    settle_vectors()
    path = path.absolute()
    data = head(path)
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()
    if "!" in str(path) or "?" in str(path):
        raise InputRejected("has a ! or ? in its path, which GDAL would not take for a part of it; rename it")
    if text.startswith(b"{"):
        _require_no_linked_crs(path)
        # The prefix selects the driver, so that a mark of another format in the text has no effect.
        return f"GeoJSON:{path}"
    if data.startswith(SHAPEFILE):
        parts = [path.with_suffix(end) for s in SHAPEFILE_PARTS for end in (s, s.upper())]
        _require_own_parts(path, parts)
        for part in (path, *parts):
            _require_complete(part)
    elif data.startswith(SQLITE):
        return _sqlite_name(_complete(path, data), data[68:72] in GEOPACKAGES)
    elif not (
        data.startswith(b"fgb\x03") or (data[:1] == b"\0" and data[4:15] == b"\n\tOSMHeader") or _is_osm(text)
    ):
        raise InputRejected(UNKNOWN + archive_note(data))
    return str(path)


def _require_complete(part: Path) -> None:
    """Raise an error if a part of a Shapefile is cut off or zeroed: GDAL would read it without values.

    The headers are described in ESRI's white paper of 1998 (``.shp``, ``.shx``) and by dBASE (``.dbf``).
    """
    kind = part.suffix.lower()
    if kind not in (".shp", ".shx", ".dbf") or not part.exists():
        return
    data, size = head(part), part.stat().st_size
    if kind == ".dbf":
        records, start, length = struct.unpack("<IHH", data[4:12].ljust(8, b"\0"))
        whole = data[:1] != b"\0" and start > DBF_HEADER_BYTES and start + records * length <= size
    else:
        stated = 2 * int.from_bytes(data[24:28], "big")
        whole = data.startswith(SHAPEFILE) and SHAPEFILE_HEADER_BYTES <= stated <= size
    if not whole:
        raise InputRejected(
            f"is a damaged Shapefile: {part.name} is shorter than its header says; restore it"
        )


def _objects(path: Path, condition: str) -> list[tuple[str, str]]:
    """Return names and statements of tables and views of an SQLite file; empty if it is damaged."""
    try:
        with opened(path) as file:
            return file.execute(f"SELECT name, sql FROM sqlite_master WHERE {condition}").fetchall()
    except sqlite3.Error:
        # GDAL reports what is wrong.
        return []


def _sqlite_name(path: Path, is_geopackage: bool) -> str:
    tables = "name IN ('geometry_columns', 'spatial_ref_sys')"
    is_spatialite = not is_geopackage and len(_objects(path, tables)) == 2
    if not (is_geopackage or (is_spatialite and "SQLite" in pyogrio.list_drivers())):
        raise InputRejected(UNKNOWN)
    for name, statement in _objects(path, "sql LIKE '%virtual%'"):
        if VIRTUAL.match(statement) and not INDEX.match(statement):
            raise InputRejected(
                f"has the virtual table {name!r}, which may be made of another file; convert it with ogr2ogr"
            )
    require_sound_contents(path, _state(path))
    # The prefix selects the driver, whatever the file's name ends in.
    return str(path) if is_geopackage else f"SQLITE:{path}"


def _complete(path: Path, data: bytes) -> Path:
    """Return an SQLite file that has all changes: itself, or a copy if some are not yet written into it."""
    parts = [path.with_name(path.name + end) for end in SQLITE_PARTS]
    _require_own_parts(path, [*parts, path.with_name(path.name + "-shm")])
    if data[18:20] != WAL_MODE and not any(part.exists() for part in parts):
        return path
    return _copied(path, _state(path)).path


def _state(path: Path) -> FileStat:
    state = source_stat(path)
    if state is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path))
    return state


def in_its_encoding(read: Callable[..., T]) -> tuple[T, str]:
    """Return the result of a reading function, and the encoding of the text; empty if it is as declared.

    Text that is not in the declared encoding, mostly UTF-8, is taken for cp1252, else for latin1, which has
    all bytes.

    - `read`: takes the option ``encoding`` of pyogrio.
    """
    try:
        return read(), ""
    except UnicodeDecodeError:
        pass
    try:
        return read(encoding="cp1252"), "cp1252"
    except UnicodeDecodeError:
        return read(encoding="latin1"), "latin1"


def layer_info(file: str, layer: str, **more: Any) -> dict[str, Any]:
    """Return pyogrio's description of a layer; names of columns may be in another encoding than declared."""
    info: dict[str, Any] = in_its_encoding(partial(pyogrio.read_info, file, layer=layer, **more))[0]
    return info


def encoding_note(name: str, encoding: str) -> str:
    """Return a line about a file whose text `in_its_encoding` has read in another encoding than declared."""
    return (
        f"the text of {name} is not in the encoding that it declares, and was read as {encoding}; "
        "write it as UTF-8, or name its encoding in the .cpg of a Shapefile"
    )


class _Copy:
    """A copy of an SQLite file with its unwritten changes, deleted when this object is garbage-collected."""

    def __init__(self, path: Path) -> None:
        folder = ScratchFolder()
        finalize(self, folder.cleanup)
        self.path = Path(folder.name, path.name)
        for end in (*SQLITE_PARTS, ""):
            with contextlib.suppress(FileNotFoundError) if end else contextlib.nullcontext():
                shutil.copyfile(path.with_name(path.name + end), self.path.with_name(path.name + end))
        # GDAL reports what is wrong. It cannot undo an interrupted change, as it opens files for reading.
        with contextlib.suppress(sqlite3.Error), closing(sqlite3.connect(self.path)) as file:
            file.execute("PRAGMA journal_mode=DELETE")


@lru_cache(maxsize=MOST_COPIES)
def _copied(path: Path, state: FileStat) -> _Copy:
    """Return a copy, as SQLite would write the changes into the file that it reads; cached by its state."""
    return _Copy(path)


def _is_osm(text: bytes) -> bool:
    """Return whether a text begins as OSM's XML, without the mark of another format."""
    if OTHER_THAN_OSM.search(text):
        return False
    names: list[str] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda name, _: names.append(name)
    try:
        parser.Parse(text, False)
    except expat.ExpatError:
        return False
    return names[:1] == ["osm"]


def _require_own_parts(path: Path, parts: Iterable[Path]) -> None:
    """Raise an error if a part of a file is not a regular file of its folder."""
    for part in parts:
        try:
            require_beside(part, path)
        except FileNotFoundError:
            continue
        except InputRejected as error:
            raise InputRejected(f"has the part {part.name}, which {error}") from error


def _require_no_linked_crs(path: Path) -> None:
    """Raise an error if a GeoJSON file gives its CRS as a web address: GDAL would open it."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for found in CRS.finditer(data):
            rest = bytes(data[found.end() : found.end() + MAX_CRS_BYTES])
            if rest[:1] in (b",", b"}", b"]"):
                # ``"crs"`` is a value, not a key.
                continue
            if not rest.startswith(b":") or _is_link(rest[1:]):
                raise InputRejected(
                    "has its CRS by a link; give it one, e.g. ogr2ogr -a_srs EPSG:25832 NEW FILE"
                )


def _is_link(rest: bytes) -> bool:
    """Return whether the text after ``"crs":`` links to a CRS or cannot be read as an object."""
    pairs: list[tuple[str, Any]] = []
    decoder = json.JSONDecoder(object_pairs_hook=pairs.extend)
    try:
        decoder.raw_decode(rest.decode(errors="replace").lstrip())
    except ValueError:
        return True
    return any(key.lower() == "type" and str(value).lower() in LINKS for key, value in pairs)
