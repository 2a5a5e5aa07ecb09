"""Opening of source rasters: only regular files of known formats, none of which leads to other files.

GDAL chooses the driver by a file's content, whatever its name: a VRT or WMS named ``a.tif`` would make it
read other files or the web. So the driver is chosen here, by the first bytes, and is the only one allowed.
Side-car files and metadata can name further files, too; they are checked as well.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import rasterio
from rasterio.errors import CRSError, RasterioError

from flexroad.catalog.guard.rejected import InputRejected, archive_note, head, require_beside
from flexroad.catalog.storage.paths import Location, gdal_name, sidecars

UNKNOWN = (
    "cannot be read: it is no GeoTIFF, ASCII grid, XYZ, JPEG 2000, PNG or JPEG; "
    "fetch it again, or convert it with gdal_translate"
)
MAGIC = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"\x89PNG\r\n\x1a\n": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"\0\0\0\x0cjP  \r\n\x87\n": "JP2OpenJPEG",
    b"\xff\x4f\xff\x51": "JP2OpenJPEG",
}
SUFFIXES = {
    ".tif": "GTiff",
    ".tiff": "GTiff",
    ".asc": "AAIGrid",
    ".xyz": "XYZ",
    ".jp2": "JP2OpenJPEG",
    ".png": "PNG",
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
}
"""Drivers in object storage, by the suffix of a file's name: to read its first bytes is a request more."""
NOT_TEXT = re.compile(rb"[<\0-\x08\x0e-\x19\x1b-\x1f]")
"""Bytes that ASCII grids and XYZ do not have; 0x1a ends some files."""
MARK = re.compile(rb"<[A-Za-z]{3}")
ASCII_GRID = re.compile(rb"\s*(ncols|nrows|xll|yll|cellsize|dx|dy|nodata)", re.IGNORECASE)
APPENDED = (".aux.xml", ".ovr", ".msk", ".aux")
REPLACED = (".aux.xml", ".aux", ".prj", ".tab", ".wld")
ERRORS = (RasterioError, CRSError, OSError, UnicodeDecodeError)
"""What rasterio raises for damaged files; the last one if a name in the CRS is not UTF-8."""
BLOCK_CACHE_BYTES = 16 * 2**20
"""Blocks of files that stay open which GDAL keeps in memory; its own default grows with the machine."""
OFFLINE = {"CPL_VSIL_CURL_ALLOWED_FILENAME": "none"}
"""GDAL's option for local files: its file system on the web opens nothing."""
A_VRT = "is a VRT, which only names other files; give those files by a pattern, e.g. 'dsm/*.tif'"


@contextmanager
def open_raster(path: Location) -> Iterator[Any]:
    """Open a source raster with rasterio."""
    if not isinstance(path, Path):
        with _remote(path) as dataset:
            yield dataset
        return
    path = path.absolute()
    driver, alone = _driver(path), not _side_cars(path)
    env = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR" if alone else "TRUE", **OFFLINE)
    with env, rasterio.open(str(path), driver=driver) as dataset:
        _require_no_link(dataset)
        yield dataset


def open_alone(path: Path) -> Any | None:
    """Open a source raster on disk that needs no other file, None if it has side-car files.

    The dataset can be kept open, as it needs none of GDAL's options when it is read.
    """
    driver = _driver(path)
    if _side_cars(path):
        return None
    with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_CACHEMAX=BLOCK_CACHE_BYTES, **OFFLINE):
        dataset = rasterio.open(str(path), driver=driver)
    try:
        _require_no_link(dataset)
    except InputRejected:
        dataset.close()
        raise
    return dataset


def has_own_blocks(path: Path) -> bool:
    """Return whether each block of a raster can be read by itself: that of a GeoTIFF.

    Text grids and pictures are decoded from their beginning, and GDAL does not return from reading a row of
    an ASCII grid behind a damaged one.
    """
    try:
        return _driver(path) == "GTiff"
    except OSError:
        return False


@contextmanager
def _remote(path: Any) -> Iterator[Any]:
    driver = SUFFIXES.get(path.suffix.lower())
    if driver is None:
        raise InputRejected(
            f"is not read from object storage: its name does not end in {', '.join(SUFFIXES)}"
        )
    names = sidecars(path)
    if path.name not in names:
        raise FileNotFoundError(str(path))
    # Stop GDAL from searching side-car files if there are none.
    env = {} if names - {path.name} else {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR"}
    with rasterio.Env(**env), rasterio.open(gdal_name(path), driver=driver) as dataset:
        _require_no_link(dataset)
        yield dataset


def _require_no_link(dataset: Any) -> None:
    """Raise an error if metadata, of the file or of ``.aux.xml``, names a file of overviews."""
    if any(key.upper() == "OVERVIEW_FILE" for key in dataset.tags(ns="OVERVIEWS")):
        raise InputRejected("names another file as its overviews; remove that with gdal_translate")


def _driver(path: Path) -> str:
    """Return the name of GDAL's driver for a file, by its first bytes."""
    data = head(path)
    for magic, driver in MAGIC.items():
        # Of a side-car file, GDAL takes a mark of XML before the first zero for its format.
        if data.startswith(magic) and not MARK.search(data.partition(b"\0")[0]):
            return driver
    if data.startswith(b"\x1f\x8b") and path.suffix.lower() == ".gz":
        return "XYZ"
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((b"<VRTDataset", b"<?xml")) and b"<VRTDataset" in data:
        raise InputRejected(A_VRT)
    # Marks of other formats may stand anywhere in a text.
    if not text or text.startswith(b"{") or NOT_TEXT.search(data):
        raise InputRejected(UNKNOWN + archive_note(data))
    return "AAIGrid" if ASCII_GRID.match(text) else "XYZ"


def _side_cars(path: Path) -> list[Path]:
    """Return the side-car files of a raster that GDAL may open; refuse those that lead to other files."""
    folder = path.parent
    # Links that lead nowhere are refused, too.
    found = [folder / name for name in side_car_names(path.name) if os.path.lexists(f"{folder}/{name}")]
    for side in found:
        try:
            require_beside(side, path)
            _check_side_car(side)
        except FileNotFoundError:
            continue
        except InputRejected as error:
            raise InputRejected(f"has the side-car file {side.name}, which {error}") from error
    return found


def _require_plain(path: Path) -> None:
    """Check the metadata of overviews or a mask."""
    try:
        env = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="TRUE", **OFFLINE)
        with env, rasterio.open(str(path), driver="GTiff") as dataset:
            _require_no_link(dataset)
    except (RasterioError, UnicodeDecodeError) as error:
        raise InputRejected(f"cannot be read: {error}; fetch it again") from error


def _check_side_car(side: Path) -> None:
    suffix = side.suffix.lower()
    if suffix in (".ovr", ".msk"):
        if MAGIC.get(head(side)[:4]) != "GTiff":
            raise InputRejected("is no TIFF; remove it")
        _side_cars(side)
        # GDAL takes a raster without a mask that it cannot read.
        _require_plain(side)
    elif suffix == ".xml":
        _require_xml(side)
    elif suffix == ".aux" and head(side).startswith(b"EHFA_HEADER_TAG"):
        raise InputRejected("is of Erdas Imagine and may name other files; remove it")


def _require_xml(side: Path) -> None:
    """Raise an error if a file is cut off or has zeros: GDAL then takes a raster without its nodata value."""
    data = side.read_bytes()
    if b"\0" in data or not data.rstrip().endswith(b">"):
        raise InputRejected("is damaged; fetch it again, or remove it")


@lru_cache(maxsize=65536)
def side_car_names(name: str) -> tuple[str, ...]:
    """Return the names of side-car files that GDAL looks for beside a file of this name."""
    path = Path(name)
    end = path.suffix[1:]
    worlds = {f".{end}w", f".{end[:1]}{end[-1:]}w"} if end else set()
    appended = [name + case for text in APPENDED for case in (text, text.upper())]
    replaced = [
        path.with_suffix(case).name
        for text in sorted({*REPLACED, *worlds})
        for case in dict.fromkeys((text, text.lower(), text.upper()))
    ]
    return (*appended, *replaced)
