"""Opening of source rasters: only regular files of known formats that do not lead to other files.

GDAL chooses the driver by a file's content, whatever its name: a VRT or WMS named ``a.tif`` would make it
read other files or the web. So the driver is chosen here, by the first bytes, and no other is allowed.
Side-car files and metadata can name further files, too; they are checked as well.

A thread keeps rasters open (`kept_raster`): a tile, its corners and its edges read the same files. Only files
on disk without side-car files are kept. A file is opened again if it or its folder has changed.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rasterio
from rasterio.errors import CRSError, RasterioError

from flexroad.catalog.guard.source_files import (
    InputRejected,
    archive_note,
    head,
    require_beside,
    side_car_names,
)
from flexroad.catalog.storage.paths import Location, gdal_name, sidecars

UNKNOWN = (
    "cannot be read: it is no GeoTIFF, ASCII grid, XYZ, JPEG 2000, PNG or JPEG; "
    "fetch it again, or convert it with gdal_translate"
)
MAGIC = {
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "GTiff"),
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
"""Drivers in object storage, by the suffix of a file's name: reading the first bytes would need a request."""
NOT_TEXT = re.compile(rb"[<\0-\x08\x0e-\x19\x1b-\x1f]")
"""Bytes that ASCII grids and XYZ do not have; 0x1a ends some files."""
MARK = re.compile(rb"<[A-Za-z]{3}")
ASCII_GRID = re.compile(rb"\s*(ncols|nrows|xll|yll|cellsize|dx|dy|nodata)", re.IGNORECASE)
ERRORS = (RasterioError, CRSError, OSError, UnicodeDecodeError)
"""Errors of rasterio for damaged files; the last is for a name in the CRS that is not UTF-8."""
BLOCK_CACHE_BYTES = 16 * 2**20
"""Size of GDAL's cache of blocks of open files; GDAL's default grows with the memory of the machine."""
OFFLINE = {"CPL_VSIL_CURL_ALLOWED_FILENAME": "none"}
"""GDAL's option for local files: its file system on the web opens nothing."""
MOST_KEPT = 64
"""Largest number of files that a thread keeps open: nine tiles with seven layers."""
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
    """Return whether each block of a raster can be read by itself: only blocks of a GeoTIFF can.

    Text grids and pictures are decoded from their beginning. GDAL does not return from reading a row of
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
    # Stop GDAL from searching side-car files of a file without them.
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
        # GDAL takes a side-car file for XML if a mark of XML comes before the first zero.
        if data.startswith(magic) and not MARK.search(data.partition(b"\0")[0]):
            return driver
    if data.startswith(b"\x1f\x8b") and path.suffix.lower() == ".gz":
        return "XYZ"
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((b"<VRTDataset", b"<?xml")) and b"<VRTDataset" in data:
        raise InputRejected(A_VRT)
    # Marks of other formats may be anywhere in a text.
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


def _check_side_car(side: Path) -> None:
    suffix = side.suffix.lower()
    if suffix in (".ovr", ".msk"):
        if MAGIC.get(head(side)[:4]) != "GTiff":
            raise InputRejected("is no TIFF; remove it")
        _side_cars(side)
        try:
            env = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="TRUE", **OFFLINE)
            with env, rasterio.open(str(side), driver="GTiff") as dataset:
                _require_no_link(dataset)
        except (RasterioError, UnicodeDecodeError) as error:
            # If GDAL cannot read a mask, it reads the raster without the mask.
            raise InputRejected(f"cannot be read: {error}; fetch it again") from error
    elif suffix == ".xml":
        data = side.read_bytes()
        # If the file is cut off or has zeros, GDAL reads the raster without its nodata value.
        if b"\0" in data or not data.rstrip().endswith(b">"):
            raise InputRejected("is damaged; fetch it again, or remove it")
    elif suffix == ".aux" and head(side).startswith(b"EHFA_HEADER_TAG"):
        raise InputRejected("is of Erdas Imagine and may name other files; remove it")


@contextmanager
def kept_raster(path: Location) -> Iterator[Any]:
    """Open a source raster as `open_raster` does, and keep it open for the next time if nothing fails."""
    if not isinstance(path, Path):
        with open_raster(path) as dataset:
            yield dataset
        return
    path = path.absolute()
    # The state is read before the file is opened: a later change is noticed the next time.
    state = _state(path)
    dataset = _idle.take(path, state) or open_alone(path)
    if dataset is None:
        with open_raster(path) as dataset:
            yield dataset
        return
    try:
        yield dataset
    except BaseException:
        dataset.close()
        raise
    _idle.keep(path, state, dataset)


def _state(path: Path) -> tuple[int, ...]:
    """Return numbers that change with the file or with the names in its folder; last the process id."""
    file = path.stat()
    # A forked process would share the position in the file with its parent.
    return file.st_ino, file.st_size, file.st_mtime_ns, path.parent.stat().st_mtime_ns, os.getpid()


class _Idle(threading.local):
    """The open files of a thread that it does not use at the moment."""

    def __init__(self) -> None:
        self.files = OrderedDict[Path, tuple[tuple[int, ...], Any]]()

    def take(self, path: Path, state: tuple[int, ...]) -> Any | None:
        """Return the file if it is open in this state, else None."""
        before, dataset = self.files.pop(path, (None, None))
        if dataset is not None and before == state:
            # Opening a file clears this thread's last error in GDAL. This call raises the error of any file,
            # and so clears it.
            with contextlib.suppress(Exception):
                _ = dataset.colorinterp
            return dataset
        self._close(before, dataset)
        return None

    def keep(self, path: Path, state: tuple[int, ...], dataset: Any) -> None:
        """Keep an open file, and close the one that has not been used for longest if there are too many."""
        self._close(*self.files.pop(path, (None, None)))
        self.files[path] = state, dataset
        if len(self.files) > MOST_KEPT:
            _, longest = self.files.popitem(last=False)
            self._close(*longest)

    @staticmethod
    def _close(state: tuple[int, ...] | None, dataset: Any) -> None:
        if state and state[-1] == os.getpid():
            dataset.close()


_idle = _Idle()
