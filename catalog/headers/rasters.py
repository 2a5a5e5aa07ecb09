"""Raster files in a folder: extent, CRS, cell size and date, read by opening each file once."""

from __future__ import annotations

import errno
import os
import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from glob import has_magic
from itertools import islice
from pathlib import Path

import rasterio
from affine import Affine
from rasterio.errors import NotGeoreferencedWarning

from flexroad.catalog.crs import bounds_in, height_unit, in_plan, plan_unit, short, utm_of
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.headers.globbing import glob, is_folder
from flexroad.catalog.headers.open_raster import ERRORS, open_raster
from flexroad.catalog.headers.raster_faults import AGAIN, georeference_fault, heights_fault
from flexroad.catalog.headers.refused import Refused
from flexroad.catalog.headers.undecodable import undecodable_ignored
from flexroad.catalog.storage.settings import gdal_options
from flexroad.catalog.text import access_reason
from flexroad.catalog.tile import HEIGHTS
from flexroad.catalog.trust import AllowedFolders

GDAL = {
    # Do not list the folder for every file (it may hold 10,000); side-car files are still opened.
    "GDAL_DISABLE_READDIR_ON_OPEN": "TRUE",
    # Otherwise GDAL does not report the vertical CRS of GeoTIFF 1.0 files.
    "GTIFF_REPORT_COMPD_CS": "YES",
    # Do not write a file with the unpacked size beside a .gz file.
    "CPL_VSIL_GZIP_WRITE_PROPERTIES": "NO",
}


DATE_TAGS = ("ACQUISITIONDATETIME", "ACQUISITIONDATE", "ACQUISITION_DATE", "TIFFTAG_DATETIME")
"""Tags with a date, the first one with a value wins."""


@dataclass(frozen=True)
class RasterFile:
    """The header of a raster file."""

    name: str
    """Relative to the folder, with forward slashes; absolute if the file is outside the folder."""
    crs: str
    """Horizontal CRS: ``EPSG:25832``, or WKT where there is no code."""
    has_crs: bool
    """False if the file has no CRS and the caller's is used."""
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


@contextmanager
def quiet() -> Iterator[None]:
    """Set GDAL's options for catalog and tasks; suppress what is printed about files that are damaged.

    That is warnings about files without a georeference, and messages that are no text.
    """
    with rasterio.Env(**GDAL, **gdal_options()), warnings.catch_warnings(), undecodable_ignored():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


class _Skip(Exception):
    """A file that is left out; the message is the reason."""


def scan(
    root: Path, layer: str, pattern: str, crs: str | None, allow: Sequence[str] = ()
) -> tuple[list[RasterFile], list[str]]:
    """Open each file of a layer once.

    Parameters
    ----------
    root : Path
        The folder, resolved.
    layer : str
        Name of the layer, for messages.
    pattern : str
        Glob pattern: see `matching`.
    crs : str, optional
        CRS of files without one.
    allow : sequence of str
        Folders besides ``root`` that the files named by a VRT may lie below.

    Returns
    -------
    files : list of RasterFile
        Ordered by name.
    left_out : list of str
        Skipped files and folders, one line per reason.

    Raises
    ------
    CatalogError
        If no file matches or can be used.
    """
    paths, unlisted = matching(root, layer, pattern)
    files, skipped = opened(root, layer, paths, crs, allow)
    if not files:
        folder, _ = _start(root, pattern)
        raise CatalogError(f"no usable file for {_option(layer)} {pattern!r} below {folder}; {skipped[0]}")
    return files, [*skipped, *unlisted]


def opened(
    root: Path, layer: str, paths: Iterable[Path], crs: str | None, allow: Sequence[str] = ()
) -> tuple[list[RasterFile], list[str]]:
    """Open files of a layer, each once; return the usable ones, and a line per reason on the others.

    Raises
    ------
    CatalogError
        If a file has no CRS and ``crs`` is not one.
    """
    files: list[RasterFile] = []
    allowed = AllowedFolders.of(root, allow)
    skipped: dict[str, list[str]] = defaultdict(list)
    with quiet():
        for path in paths:
            try:
                files.append(_open(root, path, crs, allowed, layer in HEIGHTS))
            except _Skip as reason:
                skipped[str(reason)].append(_name(root, path))
    return files, [skip(some(names), layer, reason) for reason, names in skipped.items()]


def skip(names: str, layer: str, reason: str) -> str:
    """Return the line on files or folders of a layer that a catalog leaves out."""
    return f"skipped {names} ({layer}): {reason}"


def some(names: Sequence[str]) -> str:
    """Return the first three names and the number of the others, for a message."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _option(layer: str) -> str:
    return "--" + layer.replace("_", "-")


def matching(root: Path, layer: str, pattern: str) -> tuple[list[Path], list[str]]:
    """Return the files that match a glob pattern, by name, and lines on the folders that cannot be listed.

    If the pattern's last part has a dot, it names files, and a folder that matches is in place of one.

    Parameters
    ----------
    root : Path
        The folder that relative patterns start from, resolved.
    layer : str
        Name of the layer, for messages.
    pattern : str
        Relative to ``root``; absolute, or with ``..``, it names files outside.

    Raises
    ------
    CatalogError
        If no file matches; the message shows which files exist.
    """
    folder, relative = _start(root, pattern)
    try:
        found, unlisted = glob(folder, relative)
    except (ValueError, NotImplementedError) as error:
        raise CatalogError(f"{_option(layer)} {pattern!r} is no pattern below {folder}: {error}") from error
    names_files = "." in Path(relative).name
    paths = [path for path in found if names_files or not is_folder(path)]
    lines = unlisted_lines(root, layer, unlisted)
    if not paths:
        there = lines[0] if lines else _there(folder)
        raise CatalogError(f"no file matches {_option(layer)} {pattern!r} below {folder}; {there}")
    return paths, lines


def unlisted_lines(root: Path, layer: str, unlisted: Iterable[tuple[Path, OSError]]) -> list[str]:
    """Return a line on each folder that cannot be listed."""
    return [
        skip(f"folder {_name(root, folder)}", layer, f"it {access_reason(error)}")
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


def _there(folder: Path) -> str:
    """Return which files are in a folder, for a message."""
    if not folder.is_dir():
        return "the folder does not exist"
    files = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if not is_folder(path))
    names = some(sorted(islice(files, 100)))
    return f"there are {names}" if names else "the folder is empty"


def _name(root: Path, path: Path) -> str:
    """Return the path relative to the folder if it lies below it, else the complete path."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def _open(root: Path, path: Path, crs: str | None, allowed: AllowedFolders, heights: bool) -> RasterFile:
    try:
        with open_raster(path, allowed) as src:
            wkt = src.crs.to_wkt() if src.crs else ""
            transform, width, height, bounds = src.transform, src.width, src.height, tuple(src.bounds)
            fault = georeference_fault(src) or (heights_fault(src) if heights else None)
            tags = {**src.tags(), **src.tags(ns="IMAGERY")}
            unit = src.units[0]
        modified = path.stat().st_mtime
    except Refused as error:
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
    plan, crs_unit = _system(wkt, crs)
    west, south, east, north = bounds
    return RasterFile(
        name=_name(root, path),
        crs=plan,
        has_crs=bool(wkt),
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
    """Return the date in a raster's tags, None if there is none.

    Parameters
    ----------
    tags : Mapping[str, str]
        Those of the file and of GDAL's domain IMAGERY; the acquisition goes before the writing of the image.
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
    """Check that a file's horizontal CRS is in metres.

    Parameters
    ----------
    file : RasterFile
    option : str
        Option of the command that reprojects files, for the message; empty if it has none.

    Raises
    ------
    CatalogError
        If it is not; the message names the command that reprojects the file.
    """
    unit, metres = plan_unit(file.crs)
    if unit in ("metre", "meter") and metres == 1.0:
        return
    units = unit.replace("foot", "feet") if "foot" in unit else f"{unit}s"
    zone = utm_of(bounds_in("EPSG:4326", file.crs, file.bounds))
    instead = f", or use {option} --to-crs {zone}" if option else ""
    raise CatalogError(
        f"{file.name} is in {short(file.crs)}, whose unit is {units}; "
        f"reproject to a metric CRS first, e.g. gdalwarp -t_srs {zone}{instead}"
    )
