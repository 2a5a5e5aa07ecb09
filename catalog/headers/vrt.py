"""The files that a VRT names: only plain mosaics are read, and only of files that may be read themselves.

GDAL's own reader of XML takes names of elements and attributes in any case, and attributes for elements. So
all elements and attributes must be known here, as `gdalbuildvrt` and `gdal_translate -of VRT` write them.
"""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

from flexroad.catalog.headers.refused import Refused

MAX_BYTES = 64_000_000
ELEMENTS = frozenset(
    "VRTDataset SRS GeoTransform Metadata MDI VRTRasterBand MaskBand OverviewList BlockXSize BlockYSize "
    "ColorInterp ColorTable Entry CategoryNames Category Description UnitType Offset Scale NoDataValue "
    "HideNoDataValue SimpleSource ComplexSource AveragedSource NoDataFromMaskSource SourceFilename "
    "SourceBand SourceProperties SrcRect DstRect ScaleOffset ScaleRatio NODATA LUT UseMaskBand".split()
)
ATTRIBUTES = frozenset(
    "rasterXSize rasterYSize dataType band blockXSize blockYSize dataAxisToSRSAxisMapping coordinateEpoch "
    "domain key relativeToVRT shared resampling RasterXSize RasterYSize DataType BlockXSize BlockYSize "
    "xOff yOff xSize ySize c1 c2 c3 c4".split()
)
DECLARATION = re.compile(rb"^(\xef\xbb\xbf)?\s*<\?xml[^<>?]*\?>")
PREFIX = re.compile(r"[^/]*:|/+vsi|<")
ONLY = "only mosaics of local files, as gdalbuildvrt makes them, are read; or convert it with gdal_translate"


def sources(path: Path) -> tuple[str, ...]:
    """Return the full names of the files that a VRT names.

    Raises
    ------
    Refused
        If the VRT is anything but a plain mosaic of files.
    """
    stats = path.stat()
    if stats.st_size > MAX_BYTES:
        raise Refused(f"is a VRT of {stats.st_size:,} bytes, more than {MAX_BYTES:,}; divide it")
    names = _names(path, stats.st_size, stats.st_mtime_ns)
    folder = _folder(path)
    return tuple(dict.fromkeys(str(folder / name) for name in names))


def _folder(path: Path) -> Path:
    """Return the folder that relative names start from: GDAL follows links of the file, not of folders."""
    for _ in range(40):
        if not path.is_symlink():
            return path.absolute().parent
        path = path.parent / path.readlink()
    raise Refused("is a circle of links; replace it by a file")


@lru_cache(maxsize=256)
def _names(path: Path, size: int, mtime_ns: int) -> tuple[str, ...]:
    """Return the names of a VRT's sources, absolute or relative to its folder; cached by size and time."""
    data = path.read_bytes()
    if re.search(rb"<[!?]", DECLARATION.sub(b"", data)) or b"\0" in data:
        raise Refused(f"is a VRT with comments or declarations; {ONLY}")
    try:
        root = ElementTree.fromstring(data.decode())
    except (ElementTree.ParseError, ValueError) as error:
        raise Refused(f"is a damaged VRT ({error}); fetch it again") from error
    for element in root.iter():
        unknown = [element.tag] if element.tag not in ELEMENTS else sorted({*element.attrib} - ATTRIBUTES)
        if unknown:
            raise Refused(f"is a VRT with {unknown[0][:60]}; {ONLY}")
    return tuple(dict.fromkeys(_name(element) for element in root.iter("SourceFilename")))


def _name(element: ElementTree.Element) -> str:
    name, relative = element.text or "", element.get("relativeToVRT", "0")
    if not name or name != name.strip() or len(element) or PREFIX.match(name):
        raise Refused(f"is a VRT that names {name.strip()!r}; {ONLY}")
    if relative not in ("0", "1") or (relative == "0") != os.path.isabs(name):  # noqa: PTH117
        raise Refused(f"is a VRT that names {name!r}, relative to no known folder; {ONLY}")
    return name
