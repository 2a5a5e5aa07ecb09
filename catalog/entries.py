"""Entries of catalog files, and the tiles in them.

Each entry becomes a tile. If an entry cannot be used, its tile has a `Tile.fault`. The tile keeps its id, or
gets an id such as ``entry-17`` if the id cannot be used either.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Iterable
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import crs, ids
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.text import printable, shown
from flexroad.catalog.tile import LAYERS, RECENT, Layer, Tile, by_cover, faulty
from flexroad.catalog.to_metres import HEIGHT_UNITS
from flexroad.catalog.trust import AllowedFolders

MAX_CELLS = 10**8
"""Most cells of a tile: 0.8 GB for one raster, of which a tile needs several."""
MAX_COORDINATE_M = 1e8
"""Largest coordinate (m); the largest in use are 6e7, with the number of a zone in front."""
MIN_CELL_M, MAX_CELL_M = 0.001, 1e4
YEARS = range(1000, 10_000)
"""Years that are written with four digits."""
MAX_MESSAGE = 500
MAX_FAULTS = 10_000
"""Most entries of a catalog that cannot be used; a file with more is probably not a catalog."""

MAX_LABEL = 200
"""Longest stratum and name of a dataset."""
WORDS = {dict: "not an object", list: "not a list", bool: "neither true nor false"}
"""Words for a value of another type."""
PROPERTIES = "properties."
T = TypeVar("T", Layer, datetime)


class _Names(dict[str, str]):
    """The names of files of a catalog: neighbouring tiles list the same files, so each is checked once."""

    def __missing__(self, name: str) -> str:
        if type(name) is not str or not _is_unicode(name):
            raise CatalogError(f"{shown(name)} is not a text in Unicode")
        if not name or "\0" in name:
            raise CatalogError(f"{shown(name)} is not the name of a file")
        self[name] = name
        return name


class TileReader:
    """Makes the tiles of a catalog's entries.

    Values are checked by hand, which is several times as fast as pydantic.

    - `folder`: the catalog's folder, which file names are relative to.
    - `allowed`: where the files of tiles may lie.
    - `kind`, `file`: what an entry is called, and the name of the catalog's file, for messages.
    """

    def __init__(self, folder: str, allowed: AllowedFolders, kind: str, file: str) -> None:
        self._folder = folder
        self._allowed = allowed
        self._kind = kind
        self._file = file
        self._names = _Names()

    def tiles(self, entries: Iterable[Any]) -> tuple[Tile, ...]:
        """Return a tile for each entry; tiles of unusable entries have a fault."""
        tiles, faults = [], 0
        for number, entry in enumerate(entries, 1):
            tiles.append(self._tile(entry, number))
            faults += bool(tiles[-1].fault)
            if faults > MAX_FAULTS:
                raise CatalogError(
                    f"more than {MAX_FAULTS:,} entries cannot be used, the last one: {tiles[-1].fault}"
                )
        taken = {tile.id for tile in tiles}
        return tuple(self._with_id(tile, number, taken) for number, tile in enumerate(tiles, 1))

    def _with_id(self, tile: Tile, number: int, taken: set[str]) -> Tile:
        if tile.id:
            return tile
        new = f"entry-{number}"
        while new in taken:
            new += "x"
        taken.add(new)
        return faulty(new, tile.fault, self._folder)

    def _tile(self, entry: Any, number: int) -> Tile:
        tile_id = ""
        try:
            if not isinstance(entry, dict):
                raise CatalogError(f"{shown(entry)} is not an object")
            if reason := ids.problem(entry["id"]) if "id" in entry else "missing":
                raise CatalogError(f"id: {reason}")
            tile_id = entry["id"]
            properties = entry.get("properties")
            known = properties.get("flexroad:fault") if isinstance(properties, dict) else None
            if known and isinstance(known, str):
                # The entry was not usable in the catalog from which this catalog was copied.
                return faulty(tile_id, printable(known)[: 2 * MAX_MESSAGE], self._folder)
            return self._usable(tile_id, _field(entry, "properties", dict), _field(entry, "assets", dict))
        except CatalogError as error:
            reason = str(error)
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            # An unknown mistake in one entry must not make the other entries unusable.
            reason = repr(error)
        fault = f"{self._kind} {number} of {self._file}: {printable(reason)[:MAX_MESSAGE]}; "
        return faulty(tile_id, fault + "correct it, or make the catalog again", self._folder)

    def _usable(self, tile_id: str, properties: dict[str, Any], assets: dict[str, Any]) -> Tile:
        grid = _grid(properties)
        found = [self._layer(name, assets[name]) for name in LAYERS if assets.get(name) is not None]
        layers, nearby = by_cover(found, grid)
        root = properties.get("flexroad:root")
        return Tile(
            id=tile_id,
            grid=grid,
            layers=layers,
            root=self._named([root], "properties.flexroad:root")[0] if root else self._folder,
            datetime=_date(properties),
            datetime_assumed=bool(_optional(properties, "flexroad:datetime_assumed", bool, PROPERTIES)),
            stratum=_label(properties, "flexroad:stratum"),
            dataset=_label(properties, "flexroad:dataset"),
            nearby=nearby,
            allowed=self._allowed,
        )

    def _layer(self, name: str, asset: Any) -> Layer:
        _typed(asset, f"assets.{name}", dict)
        try:
            names = _field(asset, "flexroad:files", list)
            if not names:
                raise CatalogError("flexroad:files: it is empty")
            values = _field(asset, "flexroad:values", list)
            if not all(type(value) is int and -(2**31) <= value < 2**32 for value in values):
                raise CatalogError(f"flexroad:values: {shown(values)} are not values of a raster")
            system = _optional(asset, "flexroad:crs", str)
            if system is not None:
                _check_crs(system, "flexroad:crs")
            files = self._named(names, "flexroad:files")
            extents = _extents(asset, len(names))
            reproject = bool(_optional(asset, "flexroad:reproject", bool))
            sublayer = _optional(asset, "flexroad:sublayer", str)
            unit = _optional(asset, "flexroad:height_unit", str)
            if unit is not None and unit not in HEIGHT_UNITS:
                units = ", ".join(HEIGHT_UNITS)
                raise CatalogError(f"flexroad:height_unit: {shown(unit)} is not one of {units}")
            layer: Layer = _shared(
                Layer(name, files, tuple(values), system, extents, reproject, sublayer, unit)
            )
            return layer
        except CatalogError as error:
            raise CatalogError(f"assets.{name}.{error}") from error

    def _named(self, names: list[Any], field: str) -> tuple[str, ...]:
        """Return the names of files or folders in a field, checked."""
        try:
            return tuple(map(self._names.__getitem__, names))
        except CatalogError as error:
            raise CatalogError(f"{field}: {error}") from error
        except TypeError as error:
            # A list or an object.
            raise CatalogError(f"{field}: {shown(names)} is not a list of texts") from error


@lru_cache(RECENT)
def _shared(value: T) -> T:
    """Return the first of equal values: most tiles have the same layers and date as a neighbour."""
    return value


def _field(fields: dict[str, Any], name: str, kind: type, place: str = "") -> Any:
    """Return a field's value; raise an error that names it if it is missing or of another type."""
    value = fields.get(name)
    if type(value) is kind and kind is not str:
        return value
    if name not in fields:
        raise CatalogError(f"{place}{name}: missing")
    return _typed(value, place + name, kind)


def _optional(fields: dict[str, Any], name: str, kind: type, place: str = "") -> Any:
    """Return a field's value, None if it has none: catalogs of other programs do not have all fields."""
    return None if fields.get(name) is None else _field(fields, name, kind, place)


def _typed(value: Any, name: str, kind: type) -> Any:
    """Return the value; raise an error that names the field if the value is of another type."""
    if kind is str:
        if type(value) is not str:
            raise CatalogError(f"{name}: {shown(value)} is not a text")
        if not _is_unicode(value):
            raise CatalogError(f"{name}: {shown(value)} is not a text in Unicode")
    elif type(value) is not kind:
        raise CatalogError(f"{name}: {shown(value)} is {WORDS[kind]}")
    return value


def _is_unicode(text: str) -> bool:
    """Return whether a text has no lone surrogates."""
    try:
        return text.isascii() or bool(text.encode())
    except UnicodeEncodeError:
        return False


def _grid(properties: dict[str, Any]) -> Grid:
    field = "proj:code" if properties.get("proj:code") else "proj:wkt2"
    system = _optional(properties, field, str, PROPERTIES)
    if not system:
        raise CatalogError("proj:code: missing, and proj:wkt2 as well")
    _check_metric(system, field)
    cell, west, north = _placed(_field(properties, "proj:transform", list, PROPERTIES))
    shape = _field(properties, "proj:shape", list, PROPERTIES)
    if len(shape) != 2:
        raise CatalogError(f"properties.proj:shape: {shown(shape)} are not two numbers")
    height, width = shape
    if type(height) is not int or type(width) is not int:
        raise CatalogError(f"properties.proj:shape: {shown(shape)} are not whole numbers")
    if width < 1 or height < 1:
        raise CatalogError(f"proj:shape: {shown(shape)} is not at least one cell")
    if width * height > MAX_CELLS:
        raise CatalogError(f"proj:shape: {shown(shape)} is more than {MAX_CELLS} cells")
    grid = Grid(sys.intern(system), west, north, cell, width, height)
    if max(map(abs, grid.bounds)) > MAX_COORDINATE_M:
        raise CatalogError(f"proj:transform: {shown(grid.bounds)} lies beyond {MAX_COORDINATE_M:g} m")
    return grid


def _placed(transform: list[Any]) -> tuple[float, float, float]:
    """Return cell size, west and north of a transform (m)."""
    if not 6 <= len(transform) <= 9 or not set(map(type, transform)) <= {float, int}:
        raise CatalogError(f"properties.proj:transform: {shown(transform)} are not six numbers")
    try:
        # JSON may have whole numbers, but fingerprints are made of the text of a float.
        numbers = list(map(float, transform))
    except OverflowError:
        numbers = [math.inf]
    if not all(map(math.isfinite, numbers)):
        raise CatalogError(f"properties.proj:transform: {shown(transform)} are not finite numbers")
    cell, row_turn, west, column_turn, down, north = numbers[:6]
    if row_turn or column_turn:
        raise CatalogError(f"proj:transform: {shown(transform)} is rotated")
    if not MIN_CELL_M <= cell <= MAX_CELL_M:
        limits = f"{MIN_CELL_M:g} to {MAX_CELL_M:g} m"
        raise CatalogError(f"proj:transform: a cell of {cell:g} m is not within {limits}")
    if not math.isclose(down, -cell, rel_tol=1e-9):
        raise CatalogError(f"proj:transform: cells of {cell:g} by {down:g} m are not square and north up")
    return cell, west, north


@lru_cache(maxsize=256)
def _check_crs(text: str, field: str) -> None:
    if "\0" in text:
        # PROJ reads only the text before the zero byte.
        raise CatalogError(f"{field}: unknown CRS {shown(text)}")
    try:
        crs.in_plan(text)
    except CatalogError as error:
        raise CatalogError(f"{field}: {error}") from error


@lru_cache(maxsize=256)
def _check_metric(text: str, field: str) -> None:
    _check_crs(text, field)
    unit, size_m = crs.plan_unit(text)
    if crs.is_geographic(text) or size_m != 1:
        raise CatalogError(f"{field}: {crs.short(text)} is in {unit}, not in metres")


def _date(properties: dict[str, Any]) -> datetime:
    if "datetime" not in properties:
        raise CatalogError("properties.datetime: missing")
    value = properties["datetime"]
    try:
        date = value if isinstance(value, datetime) else datetime.fromisoformat(value)
        date = (date if date.tzinfo else date.replace(tzinfo=UTC)).astimezone(UTC)
    except (TypeError, ValueError, OverflowError) as error:
        raise CatalogError(f"datetime: {shown(value)} is not a date, as 2020-05-01T10:00:00Z") from error
    if date.year not in YEARS:
        raise CatalogError(f"datetime: the year {date.year} is not within {YEARS[0]} to {YEARS[-1]}")
    shared: datetime = _shared(date)
    return shared


def _label(properties: dict[str, Any], name: str) -> str:
    text: str = _optional(properties, name, str, PROPERTIES) or ""
    if len(text) > MAX_LABEL:
        raise CatalogError(f"properties.{name}: {shown(text)} has more than {MAX_LABEL} characters")
    return text


def _extents(asset: dict[str, Any], files: int) -> tuple[Bounds, ...]:
    # Catalogs of other programs do not have this field.
    values = asset.get("flexroad:extents")
    if values is None:
        return ()
    try:
        edges: NDArray[Any] = np.asarray(values)
    except ValueError:
        # Lists of different lengths.
        edges = np.empty(0, object)
    if edges.shape not in ((0,), (4 * files,)) or edges.dtype.kind not in "if":
        text = shown(edges.tolist() or values)
        raise CatalogError(f"flexroad:extents: {text} are not four numbers for each of {files} files")
    return _unpacked(edges.astype(np.float64, copy=False).tobytes())


@lru_cache(maxsize=16)
def _unpacked(edges: bytes) -> tuple[Bounds, ...]:
    """Return the extents of a layer's files; cached, because the layers of a tile often share them."""
    if np.isnan(np.frombuffer(edges)).any():
        raise CatalogError("flexroad:extents: a number is NaN")
    return tuple(struct.iter_unpack("=4d", edges))
