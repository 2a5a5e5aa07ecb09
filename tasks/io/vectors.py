"""Features of a vector file near a tile: one spatial index per file and process, not one reading per tile.

Files with an index of their own (GeoPackage, FlatGeobuf) are read by large squares, of which a process keeps
a few: memory does not grow with the file. Others (GeoJSON, OSM) are read once, as a whole. A file in a
bucket is copied once per process: read where it is, a GeoPackage asks hundreds of times.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any
from weakref import finalize

import numpy as np
import shapely
from pyproj.exceptions import ProjError
from upath import UPath

from flexroad.catalog.crs import short, transformer
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.storage.paths import FileStat, Location, fetch, stat
from flexroad.tasks.errors import TaskError

SQUARE_M = 4000.0
"""Side of the squares that indexed files are read by (m)."""
KEPT = 8
"""Squares, or whole files, that a process keeps in memory."""
OSM = {"lines": "highway IS NOT NULL", "multipolygons": "other_tags LIKE '%highway%'"}
"""Layers of OSM's own format that hold roads, and which of their features may be some."""
OTHER_TAGS = "other_tags"
"""Column in which GDAL's OSM driver packs the tags it has no column for: ``"lanes"=>"2","width"=>"7"``."""
TAG = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


@dataclass(frozen=True)
class Query:
    """What is asked of a file."""

    path: Location
    layer: str | None
    """None where the file has only one, or is of OSM's own format."""
    where: str | None
    """Which features, in SQL."""
    columns: tuple[str, ...]
    """Names of columns or OSM tags, in lower case; those the file lacks are left out."""
    bare_crs: str | None
    """CRS if the file carries none."""
    crs: str
    """CRS to have the features in (m)."""


@dataclass(frozen=True)
class _Layer:
    name: str
    crs: str
    indexed: bool
    columns: tuple[str, ...]
    where: str | None


def read_near(asked: Query, bounds: Bounds) -> Any:
    """Return the features whose boxes touch ``bounds`` (m, in ``asked.crs``).

    Returns
    -------
    GeoDataFrame
        In ``asked.crs``, with those of the columns that exist, named in lower case.

    Raises
    ------
    TaskError
        If the file is missing or cannot be read, has no such layer or column, or carries no CRS.
    """
    import pandas

    try:
        version = stat(asked.path)
    except OSError as error:
        raise _fault(asked, f"cannot be read: {error.strerror}; run again") from error
    if version is None:
        raise _fault(asked, "cannot be opened (no such file); put it back, or build the catalog anew")
    found = []
    for layer in _layers(asked, version):
        squares = list(_squares(bounds)) if layer.indexed else [None]
        parts = [_touching(_part(asked, version, layer, square), bounds) for square in squares]
        whole = pandas.concat(parts)
        # A feature that reaches into several squares has one number in all of them.
        found.append(whole[~whole.index.duplicated()])
    return pandas.concat(found, ignore_index=True)


def _fault(asked: Query, what: str) -> TaskError:
    return TaskError(f"{asked.path} {what}", str(asked.path), "roads")


def _squares(bounds: Bounds) -> Iterator[Bounds]:
    west, south, east, north = (math.floor(edge / SQUARE_M) for edge in bounds)
    for row in range(south, north + 1):
        for col in range(west, east + 1):
            yield col * SQUARE_M, row * SQUARE_M, (col + 1) * SQUARE_M, (row + 1) * SQUARE_M


def _touching(part: Any, bounds: Bounds) -> Any:
    return part.iloc[np.sort(part.sindex.query(shapely.box(*bounds)))]


@lru_cache(maxsize=64)
def _layers(asked: Query, version: FileStat) -> tuple[_Layer, ...]:
    """Return the layers to read; ``version`` tells a changed file from the one that was seen before."""
    import pyogrio

    try:
        file = _file(asked, version)
        kinds = dict(pyogrio.list_layers(file))
        # Styles and other tables may lie beside the features.
        spatial = [name for name, kind in kinds.items() if kind is not None]
        names = [asked.layer] if asked.layer else list(OSM) if set(OSM) <= set(spatial) else spatial
        if asked.layer and asked.layer not in kinds:
            raise _fault(asked, f"has no layer {asked.layer!r}; there are {', '.join(kinds)}")
        if not names or (len(names) > 1 and names != list(OSM)):
            raise _fault(asked, f"has the layers {', '.join(kinds)}; name one with segment.layer")
        return tuple(_described(asked, name, pyogrio.read_info(file, layer=name)) for name in names)
    except (RuntimeError, ValueError) as error:
        raise _fault(asked, f"cannot be read as vectors: {error}") from error


def _file(asked: Query, version: FileStat) -> Path:
    """Return the file, or a copy of one in a bucket."""
    if isinstance(asked.path, Path):
        return asked.path
    try:
        return _copied(asked.path, version).path
    except OSError as error:
        raise _fault(asked, f"cannot be read: {error.strerror}; run again") from error


class _Copy:
    """A copy of a file in a bucket, which goes when it is forgotten."""

    def __init__(self, path: UPath) -> None:
        folder = Path(mkdtemp(prefix="flexroad-"))
        finalize(self, rmtree, folder, ignore_errors=True)
        self.path = fetch(path, folder)


@lru_cache(maxsize=KEPT)
def _copied(path: UPath, version: FileStat) -> _Copy:
    """Return a copy of that version."""
    return _Copy(path)


def _described(asked: Query, name: str, info: Any) -> _Layer:
    crs = info["crs"] or asked.bare_crs
    if crs is None:
        remedy = f"give it one, e.g. ogr2ogr -a_srs {short(asked.crs)} NEW {asked.path.name}"
        raise _fault(asked, f"carries no CRS; {remedy}")
    wanted = {*asked.columns, OTHER_TAGS}
    where = asked.where
    if info["driver"] == "OSM" and name in OSM:
        where = f"({where}) AND {OSM[name]}" if where else OSM[name]
    return _Layer(
        name=name,
        crs=crs,
        indexed=info["capabilities"]["fast_spatial_filter"],
        columns=tuple(field for field in info["fields"] if field.lower() in wanted),
        where=where,
    )


@lru_cache(maxsize=KEPT)
def _part(asked: Query, version: FileStat, layer: _Layer, square: Bounds | None) -> Any:
    """Return a layer's features, or those that touch a square of the tiles' plane, with their index."""
    try:
        bbox = square and transformer(asked.crs, layer.crs).transform_bounds(*square, densify_pts=21)
        found = _read(asked, _file(asked, version), layer, bbox)
        if found.crs is None:
            found = found.set_crs(layer.crs)
        found = found.to_crs(asked.crs)
    except (RuntimeError, ValueError, ProjError, CatalogError) as error:
        # A transformation is a RuntimeError, too.
        hint = "; check segment.where" if asked.where else ""
        raise _fault(asked, f"cannot be read as roads: {error}{hint}") from error
    found = found.rename(columns={name: name.lower() for name in layer.columns})
    # Places that the tiles' CRS does not reach become infinite.
    there = ~(found.geometry.isna() | found.geometry.is_empty) & np.isfinite(found.bounds).all(axis=1)
    return _unpacked(found[there], asked.columns)


def _read(asked: Query, file: Path, layer: _Layer, bbox: Bounds | None) -> Any:
    import pyogrio

    def read(**more: str) -> Any:
        return pyogrio.read_dataframe(
            file,
            layer=layer.name,
            columns=list(layer.columns),
            where=layer.where,
            bbox=bbox,
            force_2d=True,
            fid_as_index=True,
            **more,
        )

    try:
        return read()
    except pyogrio.errors.FeatureError as error:
        if "OSM_USE_CUSTOM_INDEXING" not in str(error):
            raise
        # Editors write nodes in any order, which GDAL's fast way does not take.
        return read(USE_CUSTOM_INDEXING="NO")


def _unpacked(table: Any, columns: tuple[str, ...]) -> Any:
    """Return the table with columns for the tags that OSM's driver packs into one."""
    if OTHER_TAGS not in table:
        return table
    packed = [dict(TAG.findall(text)) if isinstance(text, str) else {} for text in table[OTHER_TAGS]]
    tags = {name: [_plain(tags.get(name)) for tags in packed] for name in columns if name not in table}
    return table.drop(columns=OTHER_TAGS).assign(**tags)


def _plain(value: str | None) -> str | None:
    return value and re.sub(r"\\(.)", r"\1", value)
