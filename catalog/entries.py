"""Entries of catalog files: their schema, and the tiles in them.

A tile is made of each entry. If an entry cannot be used, its tile has a `Tile.fault`: it keeps its id, or
gets one such as ``entry-17`` if that is at fault, too.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from datetime import UTC, datetime
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from flexroad.catalog import crs, ids
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.text import printable, shown
from flexroad.catalog.tile import LAYERS, Layer, Tile, by_cover, faulty
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
"""Most entries of a catalog that cannot be used; with more it is something else, and may have millions."""

MAX_LABEL = 200
"""Longest stratum and name of a dataset."""
Text = Annotated[str, Field(max_length=MAX_MESSAGE * 100)]
Label = Annotated[str, Field(max_length=MAX_LABEL)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Value = Annotated[int, Field(ge=-(2**31), lt=2**32)]
WORDS = {
    "model_type": "not an object",
    "string_type": "not a text",
    "string_unicode": "not a text in Unicode",
    "list_type": "not a list",
    "int_type": "not a whole number",
    "float_type": "not a number",
    "bool_type": "neither true nor false",
    "finite_number": "not a finite number",
}
"""What a value is, by pydantic's type of its error."""


class _Schema(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Asset(_Schema):
    files: list[Text] = Field(alias="flexroad:files", min_length=1)
    values: list[Value] = Field(alias="flexroad:values")
    crs: Text | None = Field(None, alias="flexroad:crs")
    extents: Any = Field(None, alias="flexroad:extents")
    reproject: bool | None = Field(None, alias="flexroad:reproject")
    height_unit: Text | None = Field(None, alias="flexroad:height_unit")
    sublayer: Text | None = Field(None, alias="flexroad:sublayer")


class _Assets(_Schema):
    dsm: _Asset | None = None
    dtm: _Asset | None = None
    road_height: _Asset | None = None
    dop: _Asset | None = None
    road_mask: _Asset | None = None
    reference: _Asset | None = None
    reference_road: _Asset | None = None
    bridges: _Asset | None = None
    roads: _Asset | None = None


class _Properties(_Schema):
    datetime: Any
    code: Text | None = Field(None, alias="proj:code")
    wkt2: Text | None = Field(None, alias="proj:wkt2")
    shape: list[int] = Field(alias="proj:shape", min_length=2, max_length=2)
    transform: list[Number] = Field(alias="proj:transform", min_length=6, max_length=9)
    # Older catalogs do not have all of these fields.
    root: Text | None = Field(None, alias="flexroad:root")
    datetime_assumed: bool | None = Field(None, alias="flexroad:datetime_assumed")
    stratum: Label | None = Field(None, alias="flexroad:stratum")
    dataset: Label | None = Field(None, alias="flexroad:dataset")


class _Entry(_Schema):
    assets: _Assets
    properties: _Properties


class _Names(dict[str, str]):
    """The names of files of a catalog: neighbouring tiles list the same files, so each is checked once."""

    def __missing__(self, name: str) -> str:
        if not _is_text(name):
            raise TypeError
        if not name or "\0" in name:
            raise CatalogError(f"{shown(name)} is not the name of a file")
        self[name] = name
        return name


class TileReader:
    """Makes the tiles of a catalog's entries.

    Types are checked by hand, which is several times as fast as pydantic; the schema then names the mistake.

    Parameters
    ----------
    folder : str
        The catalog's folder, which file names are relative to.
    allowed : AllowedFolders
        Where the files of tiles may lie.
    kind, file : str
        What an entry is called, and the name of the catalog's file, for messages.
    """

    def __init__(self, folder: str, allowed: AllowedFolders, kind: str, file: str) -> None:
        self._folder = folder
        self._allowed = allowed
        self._kind = kind
        self._file = file
        self._names = _Names()

    def tiles(self, entries: Iterable[Any]) -> tuple[Tile, ...]:
        """Return a tile for each entry; those of unusable entries have a fault.

        Raises
        ------
        CatalogError
            If more than `MAX_FAULTS` entries have one.
        """
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
        """Return the tile, one without an id with a new one."""
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
            if known := _known_fault(entry):
                return faulty(tile_id, known, self._folder)
            return self._usable(tile_id, entry["properties"], entry["assets"])
        except CatalogError as error:
            reason = str(error)
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            reason = _mistake(entry) or repr(error)
        fault = f"{self._kind} {number} of {self._file}: {printable(reason)[:MAX_MESSAGE]}; "
        return faulty(tile_id, fault + "correct it, or make the catalog again", self._folder)

    def _usable(self, tile_id: str, properties: dict[str, Any], assets: dict[str, Any]) -> Tile:
        grid = _grid(properties)
        found = [self._layer(name, assets[name]) for name in LAYERS if assets.get(name) is not None]
        layers, nearby = by_cover(found, grid)
        return Tile(
            id=tile_id,
            grid=grid,
            layers=layers,
            root=self._root(properties) or self._folder,
            datetime=_date(properties["datetime"]),
            datetime_assumed=_assumed(properties),
            stratum=_label(properties, "flexroad:stratum"),
            dataset=_label(properties, "flexroad:dataset"),
            nearby=nearby,
            allowed=self._allowed,
        )

    def _layer(self, name: str, asset: dict[str, Any]) -> Layer:
        names, values, system = asset["flexroad:files"], asset["flexroad:values"], asset.get("flexroad:crs")
        if type(names) is not list or not names or type(values) is not list:
            raise TypeError
        if values and not all(type(value) is int and -(2**31) <= value < 2**32 for value in values):
            raise TypeError
        try:
            if system is not None:
                _check_crs(system, "flexroad:crs")
            files = self._files(names)
            extents = _extents(asset, len(names))
            reproject, unit = _conversion(asset)
            return Layer(name, files, tuple(values), system, extents, reproject, _sublayer(asset), unit)
        except CatalogError as error:
            raise CatalogError(f"assets.{name}.{error}") from error

    def _files(self, names: list[str]) -> tuple[str, ...]:
        try:
            return tuple(map(self._names.__getitem__, names))
        except CatalogError as error:
            raise CatalogError(f"flexroad:files: {error}") from error

    def _root(self, properties: dict[str, Any]) -> str:
        root: str | None = properties.get("flexroad:root")
        try:
            return self._names[root] if root else ""
        except CatalogError as error:
            raise CatalogError(f"properties.flexroad:root: {error}") from error


def _known_fault(entry: dict[str, Any]) -> str:
    """Return the fault of an entry that was not usable in the catalog that this one was copied from."""
    properties = entry.get("properties")
    fault = properties.get("flexroad:fault") if isinstance(properties, dict) else None
    return printable(fault)[: 2 * MAX_MESSAGE] if isinstance(fault, str) else ""


def _grid(properties: dict[str, Any]) -> Grid:
    field = "proj:code" if properties.get("proj:code") else "proj:wkt2"
    system = properties.get(field)
    if not system:
        raise CatalogError("proj:code: missing, and proj:wkt2 as well")
    _check_metric(system, field)
    cell, west, north = _placed(properties["proj:transform"])
    shape = properties["proj:shape"]
    height, width = shape
    if type(height) is not int or type(width) is not int:
        raise TypeError
    if width < 1 or height < 1:
        raise CatalogError(f"proj:shape: {shown(shape)} is not at least one cell")
    if width * height > MAX_CELLS:
        raise CatalogError(f"proj:shape: {shown(shape)} is more than {MAX_CELLS} cells")
    grid = Grid(system, west, north, cell, width, height)
    if max(map(abs, grid.bounds)) > MAX_COORDINATE_M:
        raise CatalogError(f"proj:transform: {shown(grid.bounds)} lies beyond {MAX_COORDINATE_M:g} m")
    return grid


def _placed(transform: list[Any]) -> tuple[float, float, float]:
    """Return cell size, west and north of a transform (m)."""
    if type(transform) is not list or not 6 <= len(transform) <= 9:
        raise TypeError
    if not set(map(type, transform)) <= {float, int} or not all(map(math.isfinite, transform)):
        raise TypeError
    # JSON may hold whole numbers; fingerprints are of the text of numbers.
    cell, row_turn, west, column_turn, down, north = map(float, transform[:6])
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
    if not _is_text(text):
        raise TypeError
    if "\0" in text:
        # PROJ reads the text before it.
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


def _date(value: Any) -> datetime:
    try:
        date = value if isinstance(value, datetime) else datetime.fromisoformat(value)
        date = (date if date.tzinfo else date.replace(tzinfo=UTC)).astimezone(UTC)
    except (TypeError, ValueError, OverflowError) as error:
        raise CatalogError(f"datetime: {shown(value)} is not a date, as 2020-05-01T10:00:00Z") from error
    if date.year not in YEARS:
        raise CatalogError(f"datetime: the year {date.year} is not within {YEARS[0]} to {YEARS[-1]}")
    return date


def _assumed(properties: dict[str, Any]) -> bool:
    assumed = properties.get("flexroad:datetime_assumed")
    if assumed is not None and type(assumed) is not bool:
        raise TypeError
    return bool(assumed)


def _label(properties: dict[str, Any], name: str) -> str:
    # Older catalogs do not have all of these fields.
    text = properties.get(name)
    if text is None:
        return ""
    if not _is_text(text) or len(text) > MAX_LABEL:
        raise TypeError
    return str(text)


def _extents(asset: dict[str, Any], files: int) -> tuple[Bounds, ...]:
    # Older catalogs do not have this field.
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
    """Return the extents of a layer's files; cached, because a tile's layers often have the same ones."""
    if np.isnan(np.frombuffer(edges)).any():
        raise CatalogError("flexroad:extents: a number is NaN")
    return tuple(struct.iter_unpack("=4d", edges))


def _conversion(asset: dict[str, Any]) -> tuple[bool, str | None]:
    """Return whether files are reprojected, and the unit of their heights if they declare none."""
    # Older catalogs do not have these fields.
    reproject, unit = asset.get("flexroad:reproject"), asset.get("flexroad:height_unit")
    if reproject is not None and type(reproject) is not bool:
        raise TypeError
    if unit is not None and type(unit) is not str:
        raise TypeError
    if unit is not None and unit not in HEIGHT_UNITS:
        raise CatalogError(f"flexroad:height_unit: {shown(unit)} is not one of {', '.join(HEIGHT_UNITS)}")
    return bool(reproject), unit


def _sublayer(asset: dict[str, Any]) -> str | None:
    # Older catalogs do not have this field.
    name = asset.get("flexroad:sublayer")
    if name is not None and not _is_text(name):
        raise TypeError
    return name


def _is_text(value: Any) -> bool:
    """Return whether a value is a text without lone surrogates."""
    if type(value) is not str:
        return False
    try:
        return value.isascii() or bool(value.encode())
    except UnicodeEncodeError:
        return False


def _mistake(entry: Any) -> str:
    """Return field and reason of the first value that the schema does not accept, ``""`` if there is none."""
    try:
        _Entry.model_validate(entry)
    except ValidationError as errors:
        error = errors.errors(include_url=False)[0]
        field, kind = ".".join(map(str, error["loc"])), error["type"]
        if kind == "missing":
            return f"{field}: missing"
        reason = f" is {WORDS[kind]}" if kind in WORDS else f": {error['msg'][:1].lower()}{error['msg'][1:]}"
        return f"{field}: {shown(error['input'])}{reason}"
    return ""
