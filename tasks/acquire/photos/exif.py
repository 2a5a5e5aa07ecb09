"""Where photographs were taken: GNSS tags of the files, ground control points, and their metric frame.

Heights stay what the camera says. Cheap receivers are metres off in height, and many drones add a constant
of their own; no file tells it, so nothing is corrected in silence: `Placed.heights` says what they are.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError
from pyproj import Transformer

from flexroad.catalog.crs import in_plan, plan_unit, utm_of
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

GNSS_M = (3.0, 5.0)
"""Accuracy in plan and height of a receiver without corrections, where the file says none (m)."""
RTK_M = {50: (0.03, 0.06), 34: (0.5, 1.0)}
"""The same by DJI's RtkFlag: 50 is a fixed solution, 34 a floating one."""
FAR_M = 1000.0
"""A larger gap between neighbours makes two places."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
WIDEST = 3 / 2
"""Sensors are no wider than this; a wider picture is a crop of its rows."""
SEA_LEVEL, ELLIPSOID = "above mean sea level", "above the WGS 84 ellipsoid"
ALTITUDE_REF = {0: (1, SEA_LEVEL), 1: (-1, SEA_LEVEL), 2: (1, ELLIPSOID), 3: (-1, ELLIPSOID)}
"""EXIF's GPSAltitudeRef: sign and datum."""


@dataclass(frozen=True)
class Shot:
    """What one photograph's file tells."""

    path: Path
    width: int
    height: int
    longitude: float
    """Degrees east, WGS 84."""
    latitude: float
    """Degrees north."""
    altitude: float
    """As the camera says (m)."""
    accuracy: tuple[float, float]
    """Standard deviation in plan and height (m)."""
    heights: str
    """What the altitude is counted from, by the file."""
    camera: str
    """Make and model; photographs of one camera and focal length are calibrated together."""
    focal_px: float | None
    """Focal length by the file (pixels), None if it tells none."""
    taken: datetime | None


@dataclass(frozen=True, eq=False)
class Control:
    """Ground control points in the metric frame of the photographs."""

    names: tuple[str, ...]
    points: Floats
    """Easting, northing, height, ``(n, 3)``, m."""
    marks: tuple[Mapping[Path, tuple[float, float]], ...]
    """Per point the pixel it is seen at: column and row from the upper left corner of each photograph."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Placed:
    """Photographs in one metric frame."""

    crs: str
    shots: tuple[Shot, ...]
    positions: Floats
    """Easting, northing, altitude of the cameras, ``(n, 3)``, m."""
    accuracy: Floats
    """Standard deviations of the positions, ``(n, 3)``, m."""
    heights: str
    """What heights are counted from, in words."""


def read_shot(path: Path) -> Shot:
    """Read position, camera and date of a photograph from its EXIF and XMP tags.

    DJI's own XMP position is preferred: it has more digits, and accuracies where the drone had corrections.

    Raises
    ------
    TaskError
        If the file is no image or has no GNSS position.
    """
    try:
        with Image.open(path) as image:
            exif, (width, height) = image.getexif(), image.size
            xmp = _xmp(image.info.get("xmp", b""))
            # A file that was cut off shows only when its pixels are read.
            image.draft("L", (width // 8, height // 8))
            image.load()
    except (UnidentifiedImageError, OSError, SyntaxError) as error:
        raise TaskError(
            f"{path} cannot be read as a photograph: {error}; leave it out", file=str(path)
        ) from error
    gps = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
    detail = exif.get_ifd(ExifTags.IFD.Exif)
    try:
        longitude, latitude, altitude, heights = _from_xmp(xmp) or _from_exif(gps)
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise TaskError(
            f"{path} has no GNSS position in its EXIF or XMP tags; leave it out, "
            "or write positions into the files (exiftool -GPSLatitude=...)",
            file=str(path),
        ) from error
    names = (exif.get(tag, "") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    camera = " ".join(str(name).strip("\0 ") for name in names).strip()
    focal = _focal(xmp, detail.get(ExifTags.Base.FocalLengthIn35mmFilm), width, height)
    return Shot(
        path=path,
        width=width,
        height=height,
        longitude=longitude,
        latitude=latitude,
        altitude=altitude,
        accuracy=_accuracy(xmp, gps),
        heights=heights,
        camera=camera,
        focal_px=focal,
        taken=_date(detail.get(ExifTags.Base.DateTimeOriginal)),
    )


def place(shots: Sequence[Shot], to_crs: str | None = None) -> Placed:
    """Move the cameras' positions into one metric frame: the UTM zone of the place, or ``to_crs``.

    Raises
    ------
    TaskError
        If there are fewer than 3 photographs, or they come from different places.
    CatalogError
        If ``to_crs`` is no CRS.
    """
    if len(shots) < 3:
        raise TaskError(f"{len(shots)} photographs are too few: it takes 3 that overlap")
    longitude, latitude = (np.array([getattr(s, a) for s in shots]) for a in ("longitude", "latitude"))
    crs = in_plan(to_crs or utm_of((longitude.min(), latitude.min(), longitude.max(), latitude.max())))
    if plan_unit(crs)[1] != 1 or plan_unit(crs)[0] == "degree":
        raise TaskError(f"{crs} counts in {plan_unit(crs)[0]}; give a CRS in metres: --to-crs EPSG:25832")
    moved = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    positions = np.column_stack([*moved, [shot.altitude for shot in shots]])
    _one_place(shots, positions)
    accuracy = np.array([(shot.accuracy[0], *shot.accuracy) for shot in shots])
    heights = " or ".join(sorted({shot.heights for shot in shots}))
    return Placed(crs, tuple(shots), positions, accuracy, heights)


def read_control(path: Path, placed: Placed, crs: str | None = None) -> Control:
    """Read ground control points from CSV: image, x_px, y_px, easting, northing, height and perhaps name.

    Parameters
    ----------
    path : Path
        The table: one row for each point and photograph. Rows with the same name (without names, the same
        coordinates) are one point. Pixels count from the upper left corner, heights in metres.
    placed : Placed
        The photographs; rows name them by file name.
    crs : str, optional
        CRS of easting and northing; that of the photographs by default.

    Raises
    ------
    TaskError
        If a column is missing, a value is no number or a photograph is unknown.
    """
    known = {shot.path.name: shot.path for shot in placed.shots}
    found: dict[str, tuple[list[float], dict[Path, tuple[float, float]]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                where = [float(row[axis]) for axis in ("easting", "northing", "height")]
                _, marks = found.setdefault(row.get("name") or str(where), (where, {}))
                marks[known[Path(row["image"]).name]] = float(row["x_px"]), float(row["y_px"])
    except OSError as error:
        raise TaskError(f"{path} cannot be read: {error.strerror}", file=str(path)) from error
    except (KeyError, TypeError, ValueError) as error:
        raise TaskError(
            f"{path}, row {sum(len(marks) for _, marks in found.values()) + 1}: {error} is no column, "
            "number or photograph known here; columns are image,x_px,y_px,easting,northing,height[,name]",
            file=str(path),
        ) from error
    points = np.array([where for where, _ in found.values()]).reshape(-1, 3)
    turn = Transformer.from_crs(in_plan(crs or placed.crs), placed.crs, always_xy=True)
    points[:, 0], points[:, 1] = turn.transform(points[:, 0], points[:, 1])
    return Control(tuple(found), points, tuple(marks for _, marks in found.values()))


def _xmp(packet: bytes | str) -> dict[str, str]:
    """Return DJI's tags, which are written as attributes or as elements."""
    text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
    return dict(re.findall(r'drone-dji:(\w+)\s*(?:="|>)\s*([^"<]*)', text))


def _from_xmp(xmp: Mapping[str, str]) -> tuple[float, float, float, str] | None:
    # Early firmware misspells the longitude.
    longitude = xmp.get("GpsLongitude") or xmp.get("GpsLongtitude")
    if not (longitude and "GpsLatitude" in xmp and "AbsoluteAltitude" in xmp):
        return None
    ellipsoid = xmp.get("AltitudeType") == "RtkAlt"
    heights = ELLIPSOID if ellipsoid else f"{SEA_LEVEL} as the drone takes it"
    return _checked(float(longitude), float(xmp["GpsLatitude"]), float(xmp["AbsoluteAltitude"]), heights)


def _from_exif(gps: Mapping[int, Any]) -> tuple[float, float, float, str]:
    tag = ExifTags.GPS
    longitude, latitude = _degrees(gps[tag.GPSLongitude]), _degrees(gps[tag.GPSLatitude])
    if gps.get(tag.GPSLongitudeRef, "E") == "W":
        longitude = -longitude
    if gps.get(tag.GPSLatitudeRef, "N") == "S":
        latitude = -latitude
    ref = gps.get(tag.GPSAltitudeRef, 0)
    sign, heights = ALTITUDE_REF[ref[0] if isinstance(ref, bytes) else int(ref)]
    return _checked(longitude, latitude, sign * float(gps[tag.GPSAltitude]), heights)


def _checked(
    longitude: float, latitude: float, altitude: float, heights: str
) -> tuple[float, float, float, str]:
    # Receivers without a fix write zeros; NaN fails the comparison, too.
    somewhere = (longitude, latitude) != (0, 0)
    if not (somewhere and abs(longitude) <= 180 and abs(latitude) <= 90 and math.isfinite(altitude)):
        raise ValueError(f"{longitude}, {latitude}, {altitude} is no position")
    return longitude, latitude, altitude, heights


def _degrees(parts: Sequence[Any]) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600


def _accuracy(xmp: Mapping[str, str], gps: Mapping[int, Any]) -> tuple[float, float]:
    """Return standard deviations in plan and height (m): the file's own, else by the kind of receiver."""
    if all(f"RtkStd{axis}" in xmp for axis in ("Lon", "Lat", "Hgt")):
        east, north, up = (float(xmp[f"RtkStd{axis}"]) for axis in ("Lon", "Lat", "Hgt"))
        # A drone without a solution writes zeros.
        if min(east, north, up) > 0:
            return max(east, north), up
    plain = RTK_M.get(int(xmp.get("RtkFlag", "0") or 0), GNSS_M)
    told = float(gps.get(ExifTags.GPS.GPSHPositioningError, math.nan))
    return (told, told * plain[1] / plain[0]) if told > 0 else plain


def _focal(xmp: Mapping[str, str], film_mm: Any, width: int, height: int) -> float | None:
    """Return the focal length (pixels): the maker's calibration, else from the 35 mm equivalent.

    The equivalent compares diagonals of whole sensors (CIPA DCG-001); of a wide picture the rows are cropped.
    """
    if float(xmp.get("CalibratedFocalLength") or 0) > 0:
        return float(xmp["CalibratedFocalLength"])
    if not film_mm or not float(film_mm) > 0:
        return None
    longer, shorter = max(width, height), min(width, height)
    return float(film_mm) / FILM_DIAGONAL_MM * math.hypot(longer, max(shorter, longer / WIDEST))


def _date(text: Any) -> datetime | None:
    try:
        return datetime.strptime(str(text), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None


def _one_place(shots: Sequence[Shot], positions: Floats) -> None:
    from scipy.cluster.hierarchy import fcluster, linkage

    group = fcluster(linkage(positions[:, :2], "single"), FAR_M, "distance")
    if group.max() == 1:
        return
    first = [shots[int(np.argmax(group == k))].path.name for k in range(1, group.max() + 1)]
    raise TaskError(
        f"the photographs come from {group.max()} places more than {FAR_M:g} m apart "
        f"({', '.join(first[:4])}); prepare each place by itself"
    )
