"""Read the features of a vector file near a tile; a file is read and indexed once per process, not per tile.

Files with a complete spatial index (GeoPackage, FlatGeobuf) are read in large squares. A process keeps a few
squares, so that memory does not grow with the file. Other files are read completely, once. A file in a bucket
is copied once per process, because reading a GeoPackage in place takes hundreds of requests.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import finalize

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj.exceptions import ProjError

from flexroad.catalog.crs import short, transformer
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import FARTHEST, Bounds
from flexroad.catalog.guard.open_vector import ERRORS, encoding_note, in_its_encoding, layer_info, vector_name
from flexroad.catalog.guard.source_files import InputRejected, source_stat
from flexroad.catalog.guard.vector_contents import has_complete_index
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.vectors import bounds_of, listed
from flexroad.catalog.storage.paths import FileStat, Location, exists, fetch
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import count, reason
from flexroad.tasks import memory
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools

pandas = lazy("pandas")
pyogrio = lazy("pyogrio")

if TYPE_CHECKING:
    from upath import UPath

SQUARE_M = 4000.0
"""Side of the squares in which indexed files are read (m)."""
CACHE_SIZE = 8
"""Number of squares, or complete files, that a process keeps in memory."""
OSM = {"lines": "highway IS NOT NULL", "multipolygons": "other_tags LIKE '%highway%'"}
"""Layers of the OSM format with roads, and SQL conditions that select their candidate features."""
OTHER_TAGS = "other_tags"
"""Column in which GDAL's OSM driver packs tags without a column: ``"lanes"=>"2","width"=>"7"``."""
ENCODING = "encoding"
"""Attribute of a table with the encoding of its text, if the file declares another encoding."""
MOST_NAMED = 12
"""Number of columns that an error names."""
WHOLE = 8
"""Memory that all features of a file take, as a multiple of its size."""
TAG = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


@dataclass(frozen=True)
class Query:
    """A request for features of a file."""

    path: Location
    layer: str | None
    """Layer to read; None if the file has only one, or is in the OSM format."""
    where: str | None
    """SQL condition that features must meet, or None."""
    columns: tuple[str, ...]
    """Names of columns or OSM tags, in lower case; names that the file lacks are left out."""
    bare_crs: str | None
    """CRS for a file that declares none."""
    crs: str
    """CRS of the result (m)."""


@dataclass(frozen=True)
class _Layer:
    name: str
    crs: str
    indexed: bool
    fields: tuple[str, ...]
    """All columns."""
    columns: tuple[str, ...]
    """The columns that are read."""
    where: str | None
    tested: tuple[str, ...]
    """Further columns that ``where`` may name: most drivers filter only by columns that are read."""


def read_near(request: Query, bounds: Bounds) -> Any:
    """Return the features whose bounding boxes touch ``bounds`` (m, in ``request.crs``).

    - result: in ``request.crs``, with the requested columns that exist, named in lower case.
    """
    try:
        version = source_stat(request.path)
        is_other = version is None and exists(request.path)
    except OSError as error:
        raise _error(request, f"cannot be read: {error.strerror}; run again") from error
    if version is None:
        if is_other:
            raise _error(request, "is not a regular file; replace it by one")
        raise _error(request, "cannot be opened (no such file); put it back, or build the catalog again")
    tables, attributes = [], dict[str, str]()
    for layer in _layers(request, version):
        squares = list(_squares(bounds)) if layer.indexed else [None]
        parts = [_part(request, version, layer, square) for square in squares]
        for part in parts:
            attributes |= part.attrs
        whole = pandas.concat([_touching(part, bounds) for part in parts])
        # A feature in several squares has the same index in all of them.
        tables.append(whole[~whole.index.duplicated()])
    near = pandas.concat(tables, ignore_index=True)
    near.attrs = attributes
    return near


def encoding_notes(table: Any, path: Location) -> tuple[str, ...]:
    """Return a note if the text of a table of `read_near` is not in the encoding that its file declares."""
    encoding = table.attrs.get(ENCODING)
    if not encoding:
        return ()
    return (f"roads: {encoding_note(path.name, encoding)}",)


def _error(request: Query, message: str) -> TaskError:
    return TaskError(f"{request.path} {message}", str(request.path), "roads")


def _squares(bounds: Bounds) -> Iterator[Bounds]:
    west, south, east, north = (math.floor(edge / SQUARE_M) for edge in bounds)
    for row in range(south, north + 1):
        for col in range(west, east + 1):
            yield col * SQUARE_M, row * SQUARE_M, (col + 1) * SQUARE_M, (row + 1) * SQUARE_M


def _touching(part: Any, bounds: Bounds) -> Any:
    return part.iloc[np.sort(part.sindex.query(shapely.box(*bounds)))]


@lru_cache(maxsize=64)
def _layers(request: Query, version: FileStat) -> tuple[_Layer, ...]:
    """Return the layers to read; ``version`` is in the cache key, so that a changed file is read again."""
    try:
        file = _file(request, version)
        kinds = dict(pyogrio.list_layers(file))
        # The file may also have styles and other tables without geometries.
        spatial = [name for name, kind in kinds.items() if kind is not None]
        names = [request.layer] if request.layer else list(OSM) if set(OSM) <= set(spatial) else spatial
        if request.layer and request.layer not in kinds:
            raise _error(request, f"has no layer {request.layer!r}; it has {_listed(file, kinds)}")
        if not names or (len(names) > 1 and names != list(OSM)):
            raise _error(
                request,
                f"has {count(len(kinds), 'layer')}: {_listed(file, kinds)}; make the catalog with "
                "--roads 'FILE|layername=NAME', or name one with segment.layer",
            )
        # Bounds are read only if the file's CRS may be replaced: for a GeoJSON, GDAL reads the complete file.
        bounds = bool(request.bare_crs) and set(names) != set(OSM)
        infos = (layer_info(file, name, force_total_bounds=bounds) for name in names)
        return tuple(
            _described(request, name, info, _indexed(request, version, file, info))
            for name, info in zip(names, infos, strict=True)
        )
    except ERRORS as error:
        raise _error(request, f"cannot be read as vectors: {reason(error)}") from error


def _listed(file: str, kinds: Mapping[str, str | None]) -> str:
    """Return the layers of an opened file for a message, with type and number of features."""
    numbers = {name: layer_info(file, name)["features"] for name in kinds}
    return listed(
        {name: f"{kinds[name] or 'no geometry'}, {count(n, 'feature')}" for name, n in numbers.items()}
    )


def _file(request: Query, version: FileStat) -> str:
    """Return GDAL's name of the file, or of a local copy if it is in a bucket."""
    try:
        local = request.path if isinstance(request.path, Path) else _copied(request.path, version).path
        return vector_name(local)
    except InputRejected as error:
        raise _error(request, str(error)) from error
    except OSError as error:
        raise _error(request, f"cannot be read: {error.strerror}; run again") from error


class _Copy:
    """A local copy of a file in a bucket, deleted when this object is garbage-collected."""

    def __init__(self, path: UPath) -> None:
        folder = ScratchFolder()
        finalize(self, folder.cleanup)
        self.path = fetch(path, Path(folder.name))


@lru_cache(maxsize=CACHE_SIZE)
def _copied(path: UPath, version: FileStat) -> _Copy:
    """Return a local copy; ``version`` is part of the cache key."""
    return _Copy(path)


def _indexed(request: Query, version: FileStat, file: str, info: Any) -> bool:
    """Return whether the features of a square can be read alone; other files are read completely."""
    if has_complete_index(file, info):
        return True
    if info["capabilities"]["fast_spatial_filter"]:
        memory.check(
            WHOLE * version.size,
            f"{request.path}, read as a whole because its spatial index may lack features,",
            f"write layer {info['layer_name']!r} to a new GeoPackage with ogr2ogr",
            str(request.path),
        )
    return False


def _described(request: Query, name: str, info: Any, indexed: bool) -> _Layer:
    crs = crs_of(info["crs"], request.bare_crs, bounds_of(info))
    if crs is None:
        remedy = f"give it one, e.g. ogr2ogr -a_srs {short(request.crs)} NEW {request.path.name}"
        raise _error(request, f"carries no CRS; {remedy}")
    columns = {*request.columns, OTHER_TAGS}
    where = request.where
    if info["driver"] == "OSM" and name in OSM:
        where = f"({where}) AND {OSM[name]}" if where else OSM[name]
    read = tuple(field for field in info["fields"] if field.lower() in columns)
    named = (where or "").lower()
    return _Layer(
        name=name,
        crs=crs,
        indexed=indexed,
        fields=tuple(info["fields"]),
        columns=read,
        where=where,
        tested=tuple(field for field in info["fields"] if field not in read and field.lower() in named),
    )


@lru_cache(maxsize=CACHE_SIZE)
def _part(request: Query, version: FileStat, layer: _Layer, square: Bounds | None) -> Any:
    """Return a layer's features, or its features that touch a square (m), in ``request.crs``."""
    try:
        table = _read_square(request, version, layer, square)
        attributes = table.attrs
        table = table.drop(columns=list(layer.tested))
        table = table.set_crs(layer.crs, allow_override=True).to_crs(request.crs)
    except (RuntimeError, ValueError, ProjError, CatalogError) as error:
        # A failed transformation also raises RuntimeError.
        hint = f"; check segment.where: its columns are {_names(layer)}" if request.where else ""
        # GDAL's complete query comes before SQLite's error, and contains the square.
        why = reason(error).rpartition(f"({layer.where}): ")[2]
        raise _error(request, f"cannot be read as roads: {why}{hint}") from error
    table = table.rename(columns={name: name.lower() for name in layer.columns})
    # Coordinates that cannot be transformed to the tiles' CRS become infinite.
    table = table[~(table.geometry.isna() | table.geometry.is_empty)]
    table = table[has_place(table.geometry.to_numpy())]
    table = _unpacked(table if square is None else _touching(table, square), request.columns)
    table.attrs = attributes
    return table


def _names(layer: _Layer) -> str:
    """Return the names of a layer's columns for a message."""
    more = len(layer.fields) - MOST_NAMED
    return ", ".join(layer.fields[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def has_place(features: NDArray[np.object_]) -> Bools:
    """Return which geometries have only finite coordinates, ``(n,)``."""
    coordinates, owner = shapely.get_coordinates(features, return_index=True)
    placed = np.ones(len(features), bool)
    placed[owner[~(np.abs(coordinates) <= FARTHEST).all(axis=1)]] = False
    return placed


def _read_square(request: Query, version: FileStat, layer: _Layer, square: Bounds | None) -> Any:
    """Return a layer's features, or its features that touch a square, in the layer's CRS."""
    file = _file(request, version)
    bbox = square and transformer(request.crs, layer.crs).transform_bounds(*square, densify_pts=21)
    try:
        return _read(request, file, layer, bbox)
    except (RuntimeError, pyogrio.errors.FeatureError) as error:
        if bbox is None or "NaN/Inf" not in str(error):
            raise
        # GEOS cannot decide whether a feature with a coordinate that is not a number touches the square. GDAL
        # then returns no feature.
        remedy = "remove features with infinite coordinates, or convert the file with ogr2ogr -skipfailures"
        memory.check(WHOLE * version.size, f"{request.path}, read as a whole,", remedy, str(request.path))
        return _read(request, file, layer, None)


def _read(request: Query, file: str, layer: _Layer, bbox: Bounds | None) -> Any:
    def read(**more: str) -> Any:
        return pyogrio.read_dataframe(
            file,
            layer=layer.name,
            columns=[*layer.columns, *layer.tested],
            where=layer.where,
            bbox=bbox,
            force_2d=True,
            fid_as_index=True,
            **more,
        )

    try:
        table, encoding = in_its_encoding(read)
    except pyogrio.errors.FeatureError as error:
        if "OSM_USE_CUSTOM_INDEXING" not in str(error):
            raise
        # GDAL's fast reader needs sorted nodes, but editors write them in any order.
        return read(USE_CUSTOM_INDEXING="NO")
    if encoding:
        table.attrs[ENCODING] = encoding
    return table


def _unpacked(table: Any, columns: tuple[str, ...]) -> Any:
    """Return the table with one column per tag that GDAL's OSM driver packs into `OTHER_TAGS`."""
    if OTHER_TAGS not in table:
        return table
    packed = [dict(TAG.findall(text)) if isinstance(text, str) else {} for text in table[OTHER_TAGS]]
    tags = {
        name: [re.sub(r"\\(.)", r"\1", tags[name]) if name in tags else None for tags in packed]
        for name in columns
        if name not in table
    }
    return table.drop(columns=OTHER_TAGS).assign(**tags)


@contextlib.contextmanager
def vector_date(date: datetime) -> Iterator[None]:
    """Make GDAL write a given date (UTC) into GeoPackages, not the current date; a context manager."""
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": f"{date:%Y-%m-%dT%H:%M:%SZ}"})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})
