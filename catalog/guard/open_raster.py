"""Opening of source rasters: only regular files of known formats, none of which leads to other files.

GDAL chooses the driver by a file's content, whatever its name: a VRT or WMS named ``a.tif`` would make it
read other files or the web. So the driver is chosen here, by the first bytes, and is the only one allowed.
Side-car files and metadata can name further files, too; they are checked as well.

Of VRTs only plain mosaics are read. GDAL's own reader of XML takes names of elements and attributes in any
case, and attributes for elements. So all elements and attributes must be known here, as `gdalbuildvrt` and
`gdal_translate -of VRT` write them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import rasterio
from rasterio.errors import CRSError, RasterioError

from flexroad.catalog.guard.refused import Refused, archive_note, head, require_beside
from flexroad.catalog.storage.paths import Location, gdal_name, sidecars
from flexroad.catalog.trust import AllowedFolders

UNKNOWN = (
    "cannot be read: it is no GeoTIFF, ASCII grid, XYZ, JPEG 2000, PNG, JPEG or VRT; "
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
MAX_DEPTH = 4
"""Largest depth of VRTs that name VRTs."""
BLOCK_CACHE_BYTES = 16 * 2**20
"""Blocks of files that stay open which GDAL keeps in memory; its own default grows with the machine."""
OFFLINE = {"CPL_VSIL_CURL_ALLOWED_FILENAME": "none"}
"""GDAL's option for local files: its file system on the web opens nothing."""
MAX_VRT_BYTES = 64_000_000
VRT_ELEMENTS = frozenset(
    "VRTDataset SRS GeoTransform Metadata MDI VRTRasterBand MaskBand OverviewList BlockXSize BlockYSize "
    "ColorInterp ColorTable Entry CategoryNames Category Description UnitType Offset Scale NoDataValue "
    "HideNoDataValue SimpleSource ComplexSource AveragedSource NoDataFromMaskSource SourceFilename "
    "SourceBand SourceProperties SrcRect DstRect ScaleOffset ScaleRatio NODATA LUT UseMaskBand".split()
)
VRT_ATTRIBUTES = frozenset(
    "rasterXSize rasterYSize dataType band blockXSize blockYSize dataAxisToSRSAxisMapping coordinateEpoch "
    "domain key relativeToVRT shared resampling RasterXSize RasterYSize DataType BlockXSize BlockYSize "
    "xOff yOff xSize ySize c1 c2 c3 c4".split()
)
DECLARATION = re.compile(rb"^(\xef\xbb\xbf)?\s*<\?xml[^<>?]*\?>")
PREFIX = re.compile(r"[^/]*:|/+vsi|<")
ONLY_MOSAICS = (
    "only mosaics of local files, as gdalbuildvrt makes them, are read; or convert it with gdal_translate"
)


@contextmanager
def open_raster(path: Location, allowed: AllowedFolders | None = None) -> Iterator[Any]:
    """Open a source raster with rasterio.

    - `allowed`: where the files that a VRT names may lie; None: anywhere on disk.
    """
    if not isinstance(path, Path):
        with _remote(path) as dataset:
            yield dataset
        return
    path = path.absolute()
    driver, alone = _checked(path, allowed, MAX_DEPTH)
    env = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR" if alone else "TRUE", **OFFLINE)
    with env, rasterio.open(str(path), driver=driver) as dataset:
        _require_no_link(dataset)
        yield dataset


def open_alone(path: Path) -> Any | None:
    """Open a source raster on disk that needs no other file, None if it has side-car files or is a VRT.

    The dataset can be kept open, as it needs none of GDAL's options when it is read.
    """
    driver = _driver(path)
    if driver == "VRT" or _side_cars(path):
        return None
    with rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_CACHEMAX=BLOCK_CACHE_BYTES, **OFFLINE):
        dataset = rasterio.open(str(path), driver=driver)
    try:
        _require_no_link(dataset)
    except Refused:
        dataset.close()
        raise
    return dataset


def has_own_blocks(path: Path, depth: int = MAX_DEPTH) -> bool:
    """Return whether each block of a raster can be read by itself: of a GeoTIFF, or a VRT of GeoTIFFs.

    Text grids and pictures are decoded from their beginning, and GDAL does not return from reading a row of
    an ASCII grid behind a damaged one.
    """
    try:
        driver = _driver(path)
        if driver != "VRT":
            return driver == "GTiff"
        return depth > 0 and all(has_own_blocks(Path(name), depth - 1) for name in vrt_sources(path))
    except OSError:
        return False


@contextmanager
def _remote(path: Any) -> Iterator[Any]:
    driver = SUFFIXES.get(path.suffix.lower())
    if driver is None:
        raise Refused(f"is not read from object storage: its name does not end in {', '.join(SUFFIXES)}")
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
        raise Refused("names another file as its overviews; remove that with gdal_translate")


def _checked(path: Path, allowed: AllowedFolders | None, depth: int) -> tuple[str, bool]:
    """Return the driver of a file, and whether neither it nor the files that it names have side-cars."""
    driver = _driver(path)
    alone = not _side_cars(path)
    if driver != "VRT":
        return driver, alone
    if depth == 0:
        raise Refused(f"is a VRT of VRTs, more than {MAX_DEPTH} deep; convert it with gdal_translate")
    for name in vrt_sources(path):
        if allowed is not None and not allowed.permits(name):
            raise Refused(str(allowed.refusal("is a VRT that", name)))
        alone &= _source(Path(name), allowed, depth)
    return driver, alone


def _source(path: Path, allowed: AllowedFolders | None, depth: int) -> bool:
    """Check a file that a VRT names, which GDAL opens with any driver; return whether it has no side-cars."""
    try:
        driver, alone = _checked(path, allowed, depth - 1)
        if driver != "VRT":
            stats = path.stat()
            _require_plain_once(path, driver, stats.st_size, stats.st_mtime_ns)
    except FileNotFoundError:
        # GDAL reports it when it needs the file.
        return True
    except Refused as error:
        raise Refused(f"is a VRT of {path}, which {error}") from error
    return alone


@lru_cache(maxsize=16384)
def _require_plain_once(path: Path, driver: str, size: int, mtime_ns: int) -> None:
    """Check the metadata of a file; cached by size and time."""
    _require_plain(path, driver)


def _require_plain(path: Path, driver: str) -> None:
    try:
        env = rasterio.Env(GDAL_DISABLE_READDIR_ON_OPEN="TRUE", **OFFLINE)
        with env, rasterio.open(str(path), driver=driver) as dataset:
            _require_no_link(dataset)
    except (RasterioError, UnicodeDecodeError) as error:
        raise Refused(f"cannot be read: {error}; fetch it again") from error


def vrt_sources(path: Path) -> tuple[str, ...]:
    """Return the full names of the files that a VRT names."""
    stats = path.stat()
    if stats.st_size > MAX_VRT_BYTES:
        raise Refused(f"is a VRT of {stats.st_size:,} bytes, more than {MAX_VRT_BYTES:,}; divide it")
    names = _vrt_names(path, stats.st_size, stats.st_mtime_ns)
    folder = _vrt_folder(path)
    return tuple(dict.fromkeys(str(folder / name) for name in names))


def _vrt_folder(path: Path) -> Path:
    """Return the folder that relative names start from: GDAL follows links of the file, not of folders."""
    for _ in range(40):
        if not path.is_symlink():
            return path.absolute().parent
        path = path.parent / path.readlink()
    raise Refused("is a circle of links; replace it by a file")


@lru_cache(maxsize=256)
def _vrt_names(path: Path, size: int, mtime_ns: int) -> tuple[str, ...]:
    """Return the names of a VRT's sources, absolute or relative to its folder; cached by size and time."""
    data = path.read_bytes()
    if re.search(rb"<[!?]", DECLARATION.sub(b"", data)) or b"\0" in data:
        raise Refused(f"is a VRT with comments or declarations; {ONLY_MOSAICS}")
    try:
        root = ElementTree.fromstring(data.decode())
    except (ElementTree.ParseError, ValueError) as error:
        raise Refused(f"is a damaged VRT ({error}); fetch it again") from error
    for element in root.iter():
        unknown = (
            [element.tag] if element.tag not in VRT_ELEMENTS else sorted({*element.attrib} - VRT_ATTRIBUTES)
        )
        if unknown:
            raise Refused(f"is a VRT with {unknown[0][:60]}; {ONLY_MOSAICS}")
    return tuple(dict.fromkeys(_vrt_name(element) for element in root.iter("SourceFilename")))


def _vrt_name(element: ElementTree.Element) -> str:
    name, relative = element.text or "", element.get("relativeToVRT", "0")
    if not name or name != name.strip() or len(element) or PREFIX.match(name):
        raise Refused(f"is a VRT that names {name.strip()!r}; {ONLY_MOSAICS}")
    if relative not in ("0", "1") or (relative == "0") != os.path.isabs(name):  # noqa: PTH117
        raise Refused(f"is a VRT that names {name!r}, relative to no known folder; {ONLY_MOSAICS}")
    return name


def _driver(path: Path) -> str:
    """Return the name of GDAL's driver for a file, by its first bytes."""
    data = head(path)
    for magic, driver in MAGIC.items():
        # Of a file that a VRT names, GDAL takes a mark of XML before the first zero for its format.
        if data.startswith(magic) and not MARK.search(data.partition(b"\0")[0]):
            return driver
    if data.startswith(b"\x1f\x8b") and path.suffix.lower() == ".gz":
        return "XYZ"
    text = data.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith((b"<VRTDataset", b"<?xml")) and b"<VRTDataset" in data:
        return "VRT"
    # Marks of other formats may stand anywhere in a text.
    if not text or text.startswith(b"{") or NOT_TEXT.search(data):
        raise Refused(UNKNOWN + archive_note(data))
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
        except Refused as error:
            raise Refused(f"has the side-car file {side.name}, which {error}") from error
    return found


def _check_side_car(side: Path) -> None:
    suffix = side.suffix.lower()
    if suffix in (".ovr", ".msk"):
        if _driver(side) != "GTiff":
            raise Refused("is no TIFF; remove it")
        _side_cars(side)
        # Not cached: GDAL takes a raster without a mask that it cannot read.
        _require_plain(side, "GTiff")
    elif suffix == ".xml":
        _require_xml(side)
    elif suffix == ".aux" and head(side).startswith(b"EHFA_HEADER_TAG"):
        raise Refused("is of Erdas Imagine and may name other files; remove it")


def _require_xml(side: Path) -> None:
    """Raise an error if a file is cut off or has zeros: GDAL then takes a raster without its nodata value."""
    data = side.read_bytes()
    if b"\0" in data or not data.rstrip().endswith(b">"):
        raise Refused("is damaged; fetch it again, or remove it")


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
