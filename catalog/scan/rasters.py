"""Raster files in a folder: extent, CRS, cell size and date, read by opening each file once."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from glob import has_magic
from itertools import islice
from pathlib import Path, PurePath
from types import TracebackType
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.errors import NotGeoreferencedWarning

from flexroad.catalog.crs import bounds_in, height_unit, in_plan, plan_unit, plan_units, short, utm_of
from flexroad.catalog.crs_checks import angle_fault, crs_of, require_scale
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.gdal_options import CHOSEN, DEFAULTS
from flexroad.catalog.grid import FARTHEST, Bounds
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.guard.source_files import InputRejected
from flexroad.catalog.skipped import Skipped, lines
from flexroad.catalog.storage.settings import gdal_options
from flexroad.catalog.text import access_reason, some
from flexroad.catalog.tile import HEIGHTS, ROAD_HEIGHT_BANDS

DATE_TAGS = ("ACQUISITIONDATETIME", "ACQUISITIONDATE", "ACQUISITION_DATE", "TIFFTAG_DATETIME")
"""Tags with a date, the first one with a value wins."""
AGAIN = "give it its georeference with gdal_translate -a_ullr"
BANDS = tuple(name for name, _ in ROAD_HEIGHT_BANDS)
HANDLERS = (
    "rasterio._env.log_error",
    "rasterio._err.log_error",
    "rasterio._err.chaining_error_handler",
)
"""rasterio's functions that decode GDAL's messages for its log and cannot raise errors. If a message is not
UTF-8, Python prints the UnicodeDecodeError. The reader of the file reports the damage by itself."""


@dataclass(frozen=True)
class RasterFile:
    """The header of a raster file."""

    name: str
    """Relative to the folder, with forward slashes; absolute if the file is outside the folder."""
    crs: str
    """Horizontal CRS: ``EPSG:25832``, or WKT where there is no code."""
    has_crs: bool
    """False if the file has no CRS or a wrong CRS, so that the CRS of the caller is used."""
    bounds: Bounds
    cell: float
    """Cell size, rounded to 1e-6 (units of the CRS)."""
    width: int
    height: int
    taken: datetime | None
    """Date in the file's tags, with a time zone, or None."""
    modified: datetime
    height_unit: str | None = None
    """Unit of heights that the band or the CRS declares, or None."""


class _Hooks:
    """Python's two hooks that print errors of `HANDLERS`, replaced while any thread needs it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0

    def __enter__(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._unraisable, self._printed = sys.unraisablehook, sys.excepthook
                sys.unraisablehook, sys.excepthook = self._unless_ignored, self._unless_traceless

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if not self._users:
                sys.unraisablehook, sys.excepthook = self._unraisable, self._printed

    def _unless_ignored(self, event: Any) -> None:
        if event.exc_type is not UnicodeDecodeError or event.object not in HANDLERS:
            self._unraisable(event)

    def _unless_traceless(
        self, kind: type[BaseException], value: BaseException, traceback: TracebackType | None
    ) -> None:
        # Cython prints the error itself, before it is ignored; an error of Python has a traceback.
        if kind is not UnicodeDecodeError or traceback is not None:
            self._printed(kind, value, traceback)


_hooks = _Hooks()


@contextmanager
def quiet() -> Iterator[None]:
    """Set GDAL's options for catalog and tasks; suppress what is printed about files that are damaged.

    These are warnings about files without a georeference, and messages that are not text.
    """
    with rasterio.Env(**CHOSEN, **DEFAULTS, **gdal_options()), warnings.catch_warnings(), _hooks:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


class _Skip(Exception):
    """A file that is left out; the message is the reason."""


def scan(root: Path, layer: str, pattern: str, crs: str | None) -> tuple[list[RasterFile], list[Skipped]]:
    """Open each file of a layer once."""
    paths, unlisted = matching(root, layer, pattern)
    files, skipped = opened(root, layer, paths, crs)
    if not files:
        folder, _ = _start(root, pattern)
        raise CatalogError(
            f"no usable file for {_option(layer)} {pattern!r} below {folder}; {lines(skipped)[0]}"
        )
    return files, [*skipped, *unlisted]


def opened(
    root: Path, layer: str, paths: Iterable[Path], crs: str | None
) -> tuple[list[RasterFile], list[Skipped]]:
    """Open files of a layer, each once; return the usable ones, and the others with the reason."""
    files: list[RasterFile] = []
    skipped: list[Skipped] = []
    with quiet():
        for path in paths:
            try:
                files.append(_open(root, path, crs, layer in HEIGHTS))
            except _Skip as reason:
                skipped.append(Skipped(name_below(root, path), layer, str(reason), str(root)))
    return files, skipped


def _option(layer: str) -> str:
    return "--" + layer.replace("_", "-")


def matching(root: Path, layer: str, pattern: str) -> tuple[list[Path], list[Skipped]]:
    """Return the files that match a glob pattern, by name, and the folders that cannot be listed.

    If the pattern's last part has a dot, it names files: a matching folder is taken for a file.

    - `root`: the folder that relative patterns start from, resolved.
    - `pattern`: relative to ``root``; absolute, or with ``..``, it names files outside.
    """
    folder, relative = _start(root, pattern)
    try:
        found, unlisted = glob(folder, relative)
    except (ValueError, NotImplementedError) as error:
        raise CatalogError(f"{_option(layer)} {pattern!r} is no pattern below {folder}: {error}") from error
    names_files = "." in Path(relative).name
    paths = [path for path in found if names_files or not _is_folder(path)]
    skipped = unlisted_folders(root, layer, unlisted)
    if not paths:
        why = lines(skipped)[0] if skipped else there(folder)
        raise CatalogError(f"no file matches {_option(layer)} {pattern!r} below {folder}; {why}")
    return paths, skipped


def glob(folder: Path, pattern: str) -> tuple[list[Path], list[tuple[Path, OSError]]]:
    """Return all paths that match a glob pattern, and the folders that may have more.

    - `paths`: files, folders, and links to nothing, by name.
    - `unlisted`: folders on the pattern's way that cannot be listed, each with the error; `Path.glob` ignores
      them.
    """
    paths, unlisted = sorted(folder.glob(pattern)), list[tuple[Path, OSError]]()
    above = PurePath(pattern).parts[:-1]
    places = {folder}
    for depth in range(1, len(above) + 1):
        places.update(folder.glob("/".join(above[:depth])))
    for place in sorted(places):
        try:
            with os.scandir(place):
                pass
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            unlisted.append((place, error))
    return paths, unlisted


def _is_folder(path: Path) -> bool:
    """Return whether a path is a folder; False if it cannot be looked up."""
    # `Path.is_dir` raises an error for a name in a folder without permission.
    return os.path.isdir(path)  # noqa: PTH112


def unlisted_folders(root: Path, layer: str, unlisted: Iterable[tuple[Path, OSError]]) -> list[Skipped]:
    """Return folders that cannot be listed as a catalog keeps them."""
    return [
        Skipped(f"{name_below(root, folder)}/", layer, f"it {access_reason(error)}", str(root))
        for folder, error in unlisted
    ]


def _start(root: Path, pattern: str) -> tuple[Path, str]:
    """Return the folder that a pattern starts from, and the rest of the pattern, relative to it."""
    if not (os.path.isabs(pattern) or ".." in Path(pattern).parts):  # noqa: PTH117
        return root, pattern
    # As in catalogs, .. is resolved by name: links are not followed.
    whole = Path(os.path.normpath(root / pattern))
    if whole.is_relative_to(root) and whole != root:
        return root, whole.relative_to(root).as_posix()
    parts = whole.parts
    fixed = next((n for n, part in enumerate(parts) if has_magic(part)), len(parts) - 1)
    return Path(*parts[:fixed]), str(Path(*parts[fixed:]))


def there(folder: Path, remedy: str = "") -> str:
    """Return which files are in a folder, with the remedy if it has files, for a message."""
    if not folder.is_dir():
        return "the folder does not exist"
    files = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if not _is_folder(path))
    names = some(sorted(islice(files, 100)))
    return f"there are {names}{remedy}" if names else "the folder is empty"


def name_below(root: Path, path: Path) -> str:
    """Return the path relative to the folder if it lies below it, else the complete path."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def _open(root: Path, path: Path, crs: str | None, heights: bool) -> RasterFile:
    try:
        with open_raster(path) as src:
            wkt = src.crs.to_wkt() if src.crs else ""
            transform, width, height, bounds = src.transform, src.width, src.height, tuple(src.bounds)
            fault = georeference_fault(src) or (heights_fault(src) if heights else None)
            tags = {**src.tags(), **src.tags(ns="IMAGERY")}
            unit = src.units[0]
        modified = path.stat().st_mtime
    except InputRejected as error:
        raise _Skip(f"it {error}") from error
    except ERRORS as error:
        if getattr(error, "errno", None) in (errno.EMFILE, errno.ENFILE):
            # A limit of this process: the file is not at fault.
            raise
        why = access_reason(error)
        raise _Skip(f"it {why}" if why else "not a raster that GDAL can read") from error
    if transform.is_identity:
        raise _Skip("no georeference; give it a world file or `gdal_translate -a_ullr`")
    if fault:
        raise _Skip(f"it {fault}")
    if transform.b or transform.d:
        raise _Skip("a rotated raster; turn it north up with gdalwarp")
    has_crs = bool(wkt) and crs_of(wkt, crs, bounds) == wkt
    plan, crs_unit = _system(wkt if has_crs else "", crs)
    if angles := angle_fault(plan, bounds):
        raise _Skip(f"it {angles}; give its CRS with --crs, or declare it with gdal_edit.py -a_srs")
    west, south, east, north = bounds
    return RasterFile(
        name=name_below(root, path),
        crs=plan,
        has_crs=has_crs,
        # GDAL swaps south and north of XYZ files that are sorted from south to north.
        bounds=(west, min(south, north), east, max(south, north)),
        cell=_cell(transform),
        width=width,
        height=height,
        taken=date_of(tags),
        modified=datetime.fromtimestamp(modified, UTC),
        height_unit=unit or crs_unit,
    )


def _system(wkt: str, crs: str | None) -> tuple[str, str | None]:
    """Return the horizontal CRS and the unit of heights that a raster's WKT declares, ``crs`` without WKT."""
    if not wkt:
        if crs is None:
            raise _Skip("it has no CRS; give it with --crs, e.g. --crs EPSG:25832")
        return in_plan(crs), None
    try:
        declared = height_unit(wkt)
        return in_plan(wkt), declared[0] if declared else None
    except CatalogError as error:
        raise _Skip(f"it has an {error}") from error


def _cell(transform: Affine) -> float:
    cell = float(round(min(abs(transform.a), abs(transform.e)), 6))
    if not cell:
        raise _Skip(f"it has cells of {transform.a:g} x {transform.e:g}; {AGAIN}")
    return cell


def date_of(tags: Mapping[str, str]) -> datetime | None:
    """Return the date in a raster's tags, or None.

    - `tags`: tags of the file and of GDAL's domain IMAGERY; the date of acquisition has priority over the
      date of writing.
    """
    for tag in DATE_TAGS:
        text = tags.get(tag, "").strip()
        try:
            # TIFF writes dates as 2020:05:01, ISO 8601 as 2020-05-01.
            return zoned(datetime.fromisoformat(text[:10].replace(":", "-") + text[10:]))
        except ValueError:
            continue
    return None


def zoned(date: datetime) -> datetime:
    """Return the date with a time zone: its own, else UTC."""
    return date if date.tzinfo else date.replace(tzinfo=UTC)


def require_metric(file: RasterFile, option: str = "") -> None:
    """Check that a file's horizontal CRS is in metres, and that they are metres on the ground.

    - `option`: option of the command that reprojects files, for the message; empty if it has none.
    """
    unit, metres = plan_unit(file.crs)
    instead = f", or use {option} --to-crs {{zone}}" if option else ""
    remedy = f"reproject to a metric CRS first, e.g. gdalwarp -t_srs {{zone}}{instead}"
    if unit in ("metre", "meter") and metres == 1.0:
        require_scale(file.name, file.crs, file.bounds, remedy)
        return
    zone = utm_of(bounds_in("EPSG:4326", file.crs, file.bounds))
    units = plan_units(file.crs)
    raise CatalogError(
        f"{file.name} is in {short(file.crs)}, whose unit is {units}; {remedy.format(zone=zone)}"
    )


def georeference_fault(dataset: Any) -> str | None:
    """Return why the position of an open raster is not valid, to follow its name; None if it is valid."""
    # A dataset makes its transform anew each time.
    transform = dataset.transform
    east_step, _, west, _, north_step, north = transform[:6]
    if not all(map(math.isfinite, transform[:6])):
        cells = f"cells of {east_step:g} x {north_step:g}"
        return f"has the origin {west:g}, {north:g} and {cells}, which is no place; {AGAIN}"
    if not transform.determinant:
        return f"has cells of {east_step:g} x {north_step:g}; {AGAIN}"
    corners = (west, north, west + dataset.width * east_step, north + dataset.height * north_step)
    if max(map(abs, corners)) > FARTHEST:
        return (
            f"reaches from {west:g}, {north:g} to {corners[2]:g}, {corners[3]:g}, which is no place; {AGAIN}"
        )
    return None


def heights_fault(dataset: Any) -> str | None:
    """Return why an open raster has no heights, to follow its name; None if it has them.

    Heights are its only band of numbers, or its first band if the bands are described as `ROAD_HEIGHT_BANDS`.
    """
    kinds = [kind for kind in color_kinds(dataset) if kind != ColorInterp.alpha]
    if len(kinds) > 1 and dataset.descriptions[: len(BANDS)] != BANDS:
        bands = f"{len(kinds)} bands ({', '.join(kind.name for kind in kinds[:4])})"
        return f"has {bands}, but heights are one; keep theirs with gdal_translate -b 1"
    if ColorInterp.palette in kinds:
        return "has a palette of colours, no heights; give a raster of heights"
    if dataset.dtypes[0].startswith("complex"):
        return f"has complex numbers ({dataset.dtypes[0]}), no heights; give a raster of heights"
    return None


def color_kinds(dataset: Any) -> tuple[ColorInterp, ...]:
    """Return the kind of each band of an open raster, such as grey or alpha."""
    # The call raises GDAL's last error, and so clears it. This error may concern an unimportant tag.
    with contextlib.suppress(Exception):
        _ = dataset.colorinterp
    return tuple(dataset.colorinterp)


def alpha_band(dataset: Any) -> int | None:
    """Return the number of an open raster's alpha band that GDAL does not use as a mask, or None.

    GDAL uses only alpha bands of uint8 or uint16, in files without another mask and without a nodata value.
    """
    kinds = color_kinds(dataset)
    if ColorInterp.alpha not in kinds[1:] or MaskFlags.alpha in dataset.mask_flag_enums[0]:
        return None
    return int(kinds.index(ColorInterp.alpha, 1)) + 1


def read_valid(dataset: Any, **how: Any) -> Any:
    """Return the first band of an open raster as a masked array; cells without a value are masked."""
    values = dataset.read(1, masked=True, **how)
    alpha = alpha_band(dataset)
    return values if alpha is None else np.ma.masked_where(transparent(dataset, alpha, **how), values)


def transparent(dataset: Any, alpha: int, **how: Any) -> NDArray[np.bool_]:
    """Return the cells without a value by an alpha band; NaN means transparent, too."""
    opaque: NDArray[np.bool_] = dataset.read(alpha, **how) > 0
    return ~opaque
