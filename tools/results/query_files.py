"""Points and lines that a user gives: CSV in several dialects, vector files, and their CRS."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from flexroad.catalog.crs import in_plan, is_geographic, same, short
from flexroad.catalog.guard.open_vector import ERRORS, encoding_note, in_its_encoding, vector_name
from flexroad.catalog.guard.source_files import InputRejected
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.vectors import file_and_layer, one_layer
from flexroad.catalog.text import reason, shown
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.sampler import to_crs
from flexroad.tasks import memory
from flexroad.tasks.io.vectors import WHOLE
from flexroad.tasks.types import Floats

if TYPE_CHECKING:
    import pandas as pd
    import pyogrio
else:
    pd, pyogrio = lazy("pandas"), lazy("pyogrio")

LONLAT = "EPSG:4326"
VECTOR_SUFFIXES = (".gpkg", ".geojson", ".json", ".fgb", ".shp")
"""Names of files that are read as vectors; any other is read as CSV."""
METRES = (("easting", "northing"), ("x", "y"))
DEGREES = (("longitude", "latitude"), ("lon", "lat"))
"""Names of coordinate columns, in any case: first east, then north."""
_COORDINATES = re.compile(r"[-+.\deE\s,]+")
"""A line given by its vertices."""


@dataclass(frozen=True, eq=False)
class Points:
    """n points with their attributes."""

    table: pd.DataFrame
    """The columns of the file. The values of a CSV are its unchanged text."""
    x: Floats
    """``(n,)``, eastings in metres or longitudes in degrees; NaN where unknown."""
    y: Floats
    """``(n,)``, northings in metres or latitudes in degrees."""
    crs: str | None
    """CRS of the coordinates. None if neither the user nor the file gives one: the run's CRS is used."""
    separator: str = ","
    """Separator of the columns of a CSV."""
    decimal: str = "."
    """Decimal sign of the coordinates of a CSV."""
    vector: bool = False
    """Whether the points are of a vector file; the table then has no coordinates."""
    notes: tuple[str, ...] = ()


def read_points(named: Path | str, given: str | None = None) -> Points:
    """Read the points of a CSV or vector file.

    - `named`: a vector file if its name ends like one (`VECTOR_SUFFIXES`), with a layer as in
      `file_and_layer`; else a CSV (`parse_csv`).
    """
    path, layer = file_and_layer(named)
    if path.suffix.lower() in VECTOR_SUFFIXES:
        return _points(*read_features(path, given, layer), path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: not readable as a table of points: {error.strerror}") from error
    return parse_csv(data, str(path), given)


def parse_csv(data: bytes, name: str, given: str | None = None) -> Points:
    """Return the points of a CSV.

    The header decides: with a semicolon in it, columns are separated by semicolons, and numbers may have
    decimal commas; else with a tab by tabs; else by commas. The coordinates are the columns ``easting`` and
    ``northing`` or ``x`` and ``y``. Without these, or with a CRS in degrees, they are ``longitude`` and
    ``latitude`` or ``lon`` and ``lat``, in WGS 84 if no CRS is given.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{name}: is not UTF-8 text; save it as CSV in UTF-8") from error
    first = text.lstrip("\r\n").partition("\n")[0]
    separator = next((sign for sign in ";\t" if sign in first), ",")
    header, rows, lines = _rows(text, separator, name)
    columns, crs = _coordinate_columns(header, given, name)
    chosen = [[row[column] for row in rows] for column in columns]
    comma = separator != "," and any("," in value for values in chosen for value in values)
    names = [header[column] for column in columns]
    x, y = (
        _numbers(values, lines, f"{name}, line {{}}: {column}", comma)
        for values, column in zip(chosen, names, strict=True)
    )
    notes = (f"{names[0]}, {names[1]} are read as {LONLAT}",) if crs and not given else ()
    table = pd.DataFrame(rows, columns=header, dtype=str)
    return Points(table, x, y, crs, separator, "," if comma else ".", notes=notes)


def _rows(text: str, separator: str, name: str) -> tuple[list[str], list[list[str]], list[int]]:
    """Return the header, the rows, filled up to its length, and the number of the line of each row."""
    rows, lines = list[list[str]](), list[int]()
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator)
    try:
        header = [cell.strip() for cell in next((row for row in reader if row), [])]
        for row in reader:
            if len(row) > len(header):
                raise ConfigError(
                    f"{name}, line {reader.line_num}: {len(row)} values, but the header has {len(header)}"
                )
            if row:
                rows.append(row + [""] * (len(header) - len(row)))
                lines.append(reader.line_num)
    except csv.Error as error:
        raise ConfigError(f"{name}, line {reader.line_num}: not readable as CSV: {error}") from error
    return header, rows, lines


def _coordinate_columns(header: Sequence[str], given: str | None, name: str) -> tuple[list[int], str | None]:
    """Return the indices of the two coordinate columns and the CRS of the coordinates."""
    known = [cell.lower() for cell in header]
    pairs: tuple[tuple[str, str], ...] = (*METRES, *DEGREES)
    if given is not None:
        pairs = (*DEGREES, ("x", "y")) if is_geographic(given) else METRES
    for pair in pairs:
        if set(pair) <= set(known):
            crs = given or (LONLAT if pair in DEGREES else None)
            return [known.index(column) for column in pair], crs
    unit = "degrees" if given and is_geographic(given) else "m"
    columns = ", or ".join(" and ".join(pair) for pair in pairs)
    raise ConfigError(f"{name}: no columns of coordinates; it needs {columns} ({unit}), not {shown(header)}")


def _numbers(values: Sequence[str], lines: Sequence[int], where: str, comma: bool) -> Floats:
    numbers = np.full(len(values), math.nan)
    for index, value in enumerate(values):
        text = value.strip()
        if not text:
            continue
        try:
            if "_" in text or (comma and "." in text):
                raise ValueError
            numbers[index] = float(text.replace(",", ".") if comma else text)
        except ValueError:
            remedy = "give one, or leave it empty"
            raise ConfigError(
                f"{where.format(lines[index])} is {shown(value)}, not a number; {remedy}"
            ) from None
    return numbers


def read_features(path: Path, given: str | None, layer: str | None) -> tuple[Any, str]:
    """Return the features of a vector file as a GeoDataFrame with a CRS, and a note if there is one."""
    try:
        file = vector_name(path)
        memory.check(WHOLE * path.stat().st_size, f"{path}, read as a whole,", "split it", str(path))
        layer = one_layer(str(path), path, layer)
        if layer is None:
            raise ConfigError(f"{path} has no features")
        read = partial(pyogrio.read_dataframe, file, layer=layer, force_2d=True)
        table, encoding = in_its_encoding(read)
    except InputRejected as error:
        raise ConfigError(f"{path} {error}") from error
    except ERRORS as error:
        text = error.strerror if isinstance(error, OSError) and error.strerror else reason(error)
        raise ConfigError(f"{path}: cannot be read as a vector file: {text}") from error
    note = encoding_note(path.name, encoding) if encoding else ""
    if table.crs is None:
        if given is None:
            raise ConfigError(f"{path}: carries no CRS; give it with --crs, such as --crs EPSG:25832")
        return table.set_crs(in_plan(given)), note
    crs = table.crs.to_wkt()
    if given is not None and not same(crs, given):
        raise ConfigError(f"{path}: is in {short(crs)}, not {short(given)}; leave the CRS out")
    return table, note


def _points(table: Any, note: str, path: Path) -> Points:
    table = table.explode(index_parts=False, ignore_index=True)
    shapes = table.geometry.to_numpy()
    others = [shape.geom_type for shape in shapes if shape is not None and shape.geom_type != "Point"]
    if others:
        raise ConfigError(f"{path}: has features of the type {others[0]}, not points; lines go to --line")
    attributes = pd.DataFrame(table.drop(columns=table.geometry.name))
    x, y, notes = shapely.get_x(shapes), shapely.get_y(shapes), (note,) if note else ()
    return Points(attributes, x, y, table.crs.to_wkt(), vector=True, notes=notes)


def read_lines(given: str, crs: str | None, run_crs: str) -> list[Floats]:
    """Return the vertices of lines, ``(n, 2)`` each, easting and northing (m) in the CRS of a run.

    A line is straight between its vertices in the CRS of the run.

    - `given`: a vector file of lines, with a layer as in `file_and_layer`, or the vertices of one line:
      ``"x y, x y"``. Parts of one feature that touch at their ends are one line.
    - `crs`: CRS of the lines, given by the user; None: the CRS of the file, or for vertices of the run.
    """
    if _COORDINATES.fullmatch(given) and not Path(given).exists():
        lines, source = [_vertices(given)], crs
    else:
        lines, source = _features(given, crs)
    projected = [np.column_stack(to_crs(line[:, 0], line[:, 1], source, run_crs)) for line in lines]
    if not all(np.isfinite(line).all() for line in projected):
        raise ConfigError(f"--line {shown(given)}: cannot be transformed to {short(run_crs)}; check its CRS")
    long = [line for line in projected if np.ptp(line, axis=0).any()]
    if not long:
        raise ConfigError(f"--line {shown(given)}: has no length; give at least two different points")
    return long


def _vertices(text: str) -> Floats:
    try:
        return np.array([[float(x), float(y)] for x, y in (part.split() for part in text.split(","))])
    except ValueError:
        raise ConfigError(
            f"--line {shown(text)}: is neither a file nor the points of a line, "
            'such as "500010 5600010, 500050 5600030"'
        ) from None


def _features(given: str, crs: str | None) -> tuple[list[Floats], str]:
    """Return the vertices of the lines of a vector file, and their CRS."""
    path, layer = file_and_layer(given)
    table, _ = read_features(path, crs, layer)
    shapes = [shape for shape in table.geometry if shape is not None and not shape.is_empty]
    others = [shape.geom_type for shape in shapes if not shape.geom_type.endswith("LineString")]
    if others:
        raise ConfigError(f"{path}: has features of the type {others[0]}, not lines; points go to --points")
    merged = [shapely.line_merge(shape) for shape in shapes]
    return [shapely.get_coordinates(part) for part in shapely.get_parts(merged)], table.crs.to_wkt()
