"""Raster files in a folder: each opened once, for where it lies and when it was taken."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.warp import transform_bounds

from flexroad.catalog.crs import in_plan, plan_unit, short, utm_of
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.storage.paths import gdal_options

GDAL = {
    # A folder of 10,000 files is not listed anew for each of them; side-car files are still found.
    "GDAL_DISABLE_READDIR_ON_OPEN": "TRUE",
    # GeoTIFF 1.0 files keep their vertical CRS to themselves otherwise.
    "GTIFF_REPORT_COMPD_CS": "YES",
    # GDAL would leave a note of a packed file's size beside it.
    "CPL_VSIL_GZIP_WRITE_PROPERTIES": "NO",
}


@dataclass(frozen=True)
class RasterFile:
    """What one opening of a file told."""

    name: str
    """Relative to the folder, with forward slashes; absolute where it lies elsewhere."""
    crs: str
    """CRS in plan: ``EPSG:25832``, or WKT where there is no code."""
    has_crs: bool
    """False if the file carries no CRS and the caller's stands in."""
    bounds: Bounds
    cell: float
    """Cell size, rounded to 1e-6 (units of the CRS)."""
    width: int
    height: int
    taken: datetime | None
    """By the file's tags, with a time zone."""
    modified: datetime


@contextmanager
def quiet() -> Iterator[None]:
    """Open rasters as both the catalog and the tasks do; files without a georeference warn of nothing."""
    with rasterio.Env(**GDAL, **gdal_options()), warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


class _Skip(Exception):
    """A file that is left out; the message is the reason."""


def scan(root: Path, layer: str, pattern: str, crs: str | None) -> tuple[list[RasterFile], list[str]]:
    """Open each file of a layer once.

    Parameters
    ----------
    root : Path
        The folder, resolved.
    layer : str
        For the messages.
    pattern : str
        Glob pattern relative to ``root``.
    crs : str, optional
        CRS of files that carry none.

    Returns
    -------
    files : list of RasterFile
        By name.
    notes : list of str
        What was skipped and why, a line for each reason.

    Raises
    ------
    CatalogError
        If nothing matches or is usable, or a file without a CRS meets no ``crs``.
    """
    found, notes = opened(root, layer, matching(root, layer, pattern), crs)
    if not found:
        raise CatalogError(f"no usable file for {_option(layer)} {pattern!r} below {root}; {notes[0]}")
    return found, notes


def opened(
    root: Path, layer: str, paths: Iterable[Path], crs: str | None
) -> tuple[list[RasterFile], list[str]]:
    """Open files of a layer, each once; return those that can be used, and what was skipped and why.

    Raises
    ------
    CatalogError
        If a file without a CRS meets no ``crs``.
    """
    found: list[RasterFile] = []
    skipped: dict[str, list[str]] = defaultdict(list)
    with quiet():
        for path in paths:
            try:
                found.append(_open(root, path, crs))
            except _Skip as reason:
                skipped[str(reason)].append(_name(root, path))
    return found, [f"skipped {some(names)} ({layer}): {reason}" for reason, names in skipped.items()]


def some(names: Sequence[str]) -> str:
    """Return the first three names and how many more there are, for a message."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def _option(layer: str) -> str:
    return "--" + layer.replace("_", "-")


def matching(root: Path, layer: str, pattern: str) -> list[Path]:
    """Return the files that match a glob pattern relative to ``root``, by name.

    Raises
    ------
    CatalogError
        If there is none; the line shows what there is.
    """
    try:
        paths = sorted(path for path in root.glob(pattern) if path.is_file())
    except (ValueError, NotImplementedError) as error:
        raise CatalogError(f"{_option(layer)} {pattern!r} is no pattern below {root}: {error}") from error
    if not paths:
        files = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
        there = some(sorted(islice(files, 100)))
        there = f"there are {there}" if there else "the folder is empty"
        raise CatalogError(f"no file matches {_option(layer)} {pattern!r} below {root}; {there}")
    return paths


def _name(root: Path, path: Path) -> str:
    """Return the path relative to the folder where it lies below it."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def _open(root: Path, path: Path, crs: str | None) -> RasterFile:
    try:
        with rasterio.open(path) as src:
            wkt = src.crs.to_wkt() if src.crs else ""
            transform, width, height, bounds = src.transform, src.width, src.height, tuple(src.bounds)
            tags = {**src.tags(), **src.tags(ns="IMAGERY")}
    except (RasterioError, OSError) as error:
        raise _Skip("not a raster GDAL can read") from error
    if transform.is_identity:
        raise _Skip("no georeference; give it a world file or `gdal_translate -a_ullr`")
    if transform.b or transform.d:
        raise _Skip("a rotated raster; turn it north up with gdalwarp")
    name = _name(root, path)
    if not wkt and crs is None:
        raise CatalogError(f"{name} carries no CRS; say which it is with --crs, e.g. --crs EPSG:25832")
    west, south, east, north = bounds
    return RasterFile(
        name=name,
        crs=in_plan(wkt or str(crs)),
        has_crs=bool(wkt),
        # XYZ files that run northward are upside down for GDAL.
        bounds=(west, min(south, north), east, max(south, north)),
        cell=round(min(abs(transform.a), abs(transform.e)), 6),
        width=width,
        height=height,
        taken=_taken(tags),
        modified=datetime.fromtimestamp(path.stat().st_mtime, UTC),
    )


def _taken(tags: Mapping[str, str]) -> datetime | None:
    for tag in ("ACQUISITIONDATETIME", "TIFFTAG_DATETIME"):
        text = tags.get(tag, "").strip()
        try:
            # TIFF writes 2020:05:01, the rest of the world 2020-05-01.
            return zoned(datetime.fromisoformat(text[:10].replace(":", "-") + text[10:]))
        except ValueError:
            continue
    return None


def zoned(date: datetime) -> datetime:
    """Return the date with a time zone; UTC where it has none."""
    return date if date.tzinfo else date.replace(tzinfo=UTC)


def require_metric(file: RasterFile) -> None:
    """Refuse a file whose plan counts in anything but metres.

    Raises
    ------
    CatalogError
        The line names the command that reprojects it.
    """
    unit, metres = plan_unit(file.crs)
    if unit in ("metre", "meter") and metres == 1.0:
        return
    units = unit.replace("foot", "feet") if "foot" in unit else f"{unit}s"
    zone = utm_of(transform_bounds(file.crs, "EPSG:4326", *file.bounds))
    raise CatalogError(
        f"{file.name} is in {short(file.crs)}, which counts in {units}; "
        f"reproject to a metric CRS first, e.g. gdalwarp -t_srs {zone}"
    )
