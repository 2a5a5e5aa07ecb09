"""Camera positions from GNSS tags of photographs, and ground control points, in a metric CRS.

Heights are used as written by the camera; `PlacedPhotos.heights` is their datum. They are not corrected:
simple receivers have errors of metres in height, and many drones add an offset that is not in the file.
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
import scipy
from PIL import ExifTags, Image
from pyproj import Transformer

from flexroad.catalog.crs import in_plan, plan_unit, utm_of
from flexroad.tasks import memory
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.prepare.images import check_pixels, image_errors

GNSS_M = (3.0, 5.0)
"""Accuracy in plan and height of a receiver without corrections, if the file gives no accuracy (m)."""
RTK_M = {50: (0.03, 0.06), 34: (0.5, 1.0)}
"""Accuracy by DJI's RtkFlag (m): 50 is a fixed solution, 34 a float solution."""
BYTES = 12
"""Memory that a photograph takes per pixel while it is matched: four copies in colour."""
FAR_M = 1000.0
"""Photographs farther than this from all others belong to another place (m)."""
HIGHEST_M = 100_000.0
"""Greatest altitude of a camera, above or below the datum (m)."""
LONGEST = 100
"""Largest focal length, in sides or diagonals of the sensor; a longer focal length is taken as unknown."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
"""Diagonal of 35 mm film (mm)."""
WIDEST = 3 / 2
"""Largest aspect ratio of a sensor; a wider photograph is cropped in height."""
SEA_LEVEL, ELLIPSOID = "above mean sea level", "above the WGS 84 ellipsoid"
ALTITUDE_REF = {0: (1, SEA_LEVEL), 1: (-1, SEA_LEVEL), 2: (1, ELLIPSOID), 3: (-1, ELLIPSOID)}
"""EXIF's GPSAltitudeRef: sign and datum."""


@dataclass(frozen=True)
class Shot:
    """Metadata of one photograph."""

    path: Path
    width: int
    height: int
    longitude: float
    """Degrees east, WGS 84."""
    latitude: float
    """Degrees north."""
    altitude: float
    """Height as written by the camera (m)."""
    accuracy: tuple[float, float]
    """Standard deviation in plan and height (m)."""
    heights: str
    """Datum of the altitude, in words."""
    camera: str
    """Make and model; photographs of one camera and focal length are calibrated together."""
    focal_px: float | None
    """Focal length (pixels); None if unknown."""
    taken: datetime | None
    """Time of exposure; None if unknown."""


@dataclass(frozen=True, eq=False)
class Control:
    """Ground control points in the metric frame of the photographs."""

    names: tuple[str, ...]
    points: Floats
    """Easting, northing, height, ``(n, 3)``, m."""
    marks: tuple[Mapping[Path, tuple[float, float]], ...]
    """Pixels of each point by photograph: column and row from the upper left corner."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.names)


@dataclass(frozen=True, eq=False)
class PlacedPhotos:
    """Photographs in one metric frame."""

    crs: str
    shots: tuple[Shot, ...]
    positions: Floats
    """Easting, northing, altitude of the cameras, ``(n, 3)``, m."""
    accuracy: Floats
    """Standard deviations of the positions, ``(n, 3)``, m."""
    heights: str
    """Datum of the heights, in words."""


def read_shot(path: Path) -> Shot:
    """Read position, camera and date of a photograph from its EXIF and XMP tags.

    DJI's XMP position is preferred: it has more digits, and accuracies if the drone had corrections.
    """
    remedy = "leave it out, or make it smaller"
    with image_errors(f"{path} cannot be read as a photograph", remedy, path), Image.open(path) as image:
        check_pixels(image, str(path), remedy, path)
        memory.check(BYTES * image.width * image.height, str(path), remedy, str(path))
        exif, (width, height) = image.getexif(), image.size
        packet = image.info.get("xmp", b"")
        text = packet.decode("utf-8", "replace") if isinstance(packet, bytes) else packet
        # DJI's tags may be attributes or elements.
        xmp = dict(re.findall(r'drone-dji:(\w+)\s*(?:="|>)\s*([^"<]*)', text))
        # A truncated file is detected only when its pixels are read.
        image.draft("L", (width // 8, height // 8))
        image.load()
        gps = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
        detail = exif.get_ifd(ExifTags.IFD.Exif)
    try:
        longitude, latitude, altitude, heights = _from_xmp(xmp) or _from_exif(gps)
        accuracy = _accuracy(xmp, gps)
        focal = _focal(xmp, detail.get(ExifTags.Base.FocalLengthIn35mmFilm), width, height)
    except (ArithmeticError, KeyError, TypeError, ValueError, IndexError) as error:
        raise TaskError(
            f"{path} has no GNSS position in its EXIF or XMP tags, or numbers that cannot be read; leave it "
            "out, or write positions into the files (exiftool -GPSLatitude=...)",
            file=str(path),
        ) from error
    names = (exif.get(tag, "") for tag in (ExifTags.Base.Make, ExifTags.Base.Model))
    camera = " ".join(" ".join(str(name).strip("\0 ").split()) for name in names).strip()[:100]
    return Shot(
        path=path,
        width=width,
        height=height,
        longitude=longitude,
        latitude=latitude,
        altitude=altitude,
        accuracy=accuracy,
        heights=heights,
        camera=camera,
        focal_px=focal,
        taken=_date(detail.get(ExifTags.Base.DateTimeOriginal)),
    )


def place_photos(shots: Sequence[Shot], to_crs: str | None = None) -> PlacedPhotos:
    """Transform the camera positions to one metric CRS: the UTM zone of the place, or ``to_crs``."""
    if len(shots) < 3:
        raise TaskError(f"{len(shots)} photographs are too few; at least 3 that overlap are needed")
    longitude, latitude = (np.array([getattr(s, a) for s in shots]) for a in ("longitude", "latitude"))
    crs = in_plan(to_crs or utm_of((longitude.min(), latitude.min(), longitude.max(), latitude.max())))
    if plan_unit(crs)[1] != 1 or plan_unit(crs)[0] == "degree":
        raise TaskError(f"{crs} is in {plan_unit(crs)[0]}; give a CRS in metres: --to-crs EPSG:25832")
    plan = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(longitude, latitude)
    positions = np.column_stack([*plan, [shot.altitude for shot in shots]])
    _check_one_place(shots, positions)
    accuracy = np.array([(shot.accuracy[0], *shot.accuracy) for shot in shots])
    heights = " or ".join(sorted({shot.heights for shot in shots}))
    return PlacedPhotos(crs, tuple(shots), positions, accuracy, heights)


def read_control(path: Path, placed: PlacedPhotos, crs: str | None = None) -> Control:
    """Read ground control points from CSV: image, x_px, y_px, easting, northing, height, optionally name.

    - `path`: the table: one row per point and photograph. Rows with the same name (without names, the same
      coordinates) are one point. Pixels are counted from the upper left corner; heights are in metres.
    - `placed`: the photographs; rows refer to them by file name.
    - `crs`: CRS of easting and northing; by default the CRS of the photographs.
    """
    paths = {shot.path.name: shot.path for shot in placed.shots}
    by_name: dict[str, tuple[list[float], dict[Path, tuple[float, float]]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for row in csv.DictReader(file):
                position = [float(row[axis]) for axis in ("easting", "northing", "height")]
                _, marks = by_name.setdefault(row.get("name") or str(position), (position, {}))
                marks[paths[Path(row["image"]).name]] = float(row["x_px"]), float(row["y_px"])
    except OSError as error:
        raise TaskError(f"{path} cannot be read: {error.strerror}", file=str(path)) from error
    except (KeyError, TypeError, ValueError) as error:
        raise TaskError(
            f"{path}, row {sum(len(marks) for _, marks in by_name.values()) + 1}: {error} is not a "
            "column, number or photograph; columns are image,x_px,y_px,easting,northing,height[,name]",
            file=str(path),
        ) from error
    points = np.array([position for position, _ in by_name.values()]).reshape(-1, 3)
    transformer = Transformer.from_crs(in_plan(crs or placed.crs), placed.crs, always_xy=True)
    points[:, 0], points[:, 1] = transformer.transform(points[:, 0], points[:, 1])
    return Control(tuple(by_name), points, tuple(marks for _, marks in by_name.values()))


def _from_xmp(xmp: Mapping[str, str]) -> tuple[float, float, float, str] | None:
    # Early firmware misspells the longitude.
    longitude = xmp.get("GpsLongitude") or xmp.get("GpsLongtitude")
    if not (longitude and "GpsLatitude" in xmp and "AbsoluteAltitude" in xmp):
        return None
    ellipsoid = xmp.get("AltitudeType") == "RtkAlt"
    heights = ELLIPSOID if ellipsoid else f"{SEA_LEVEL} as the drone takes it"
    return _validated(float(longitude), float(xmp["GpsLatitude"]), float(xmp["AbsoluteAltitude"]), heights)


def _from_exif(gps: Mapping[int, Any]) -> tuple[float, float, float, str]:
    tag = ExifTags.GPS
    longitude, latitude = _degrees(gps[tag.GPSLongitude]), _degrees(gps[tag.GPSLatitude])
    if gps.get(tag.GPSLongitudeRef, "E") == "W":
        longitude = -longitude
    if gps.get(tag.GPSLatitudeRef, "N") == "S":
        latitude = -latitude
    ref = gps.get(tag.GPSAltitudeRef, 0)
    sign, heights = ALTITUDE_REF[ref[0] if isinstance(ref, bytes) else int(ref)]
    return _validated(longitude, latitude, sign * float(gps[tag.GPSAltitude]), heights)


def _validated(
    longitude: float, latitude: float, altitude: float, heights: str
) -> tuple[float, float, float, str]:
    # Receivers without a position write zeros. NaN fails the comparisons below, too.
    has_fix = (longitude, latitude) != (0, 0)
    if not (has_fix and abs(longitude) <= 180 and abs(latitude) <= 90 and abs(altitude) <= HIGHEST_M):
        raise ValueError(f"{longitude}, {latitude}, {altitude} is not a position")
    return longitude, latitude, altitude, heights


def _degrees(parts: Sequence[Any]) -> float:
    degrees, minutes, seconds = (float(part) for part in parts)
    return degrees + minutes / 60 + seconds / 3600


def _accuracy(xmp: Mapping[str, str], gps: Mapping[int, Any]) -> tuple[float, float]:
    """Return standard deviations in plan and height (m): from the file, else for the type of receiver."""
    if all(f"RtkStd{axis}" in xmp for axis in ("Lon", "Lat", "Hgt")):
        east, north, up = (float(xmp[f"RtkStd{axis}"]) for axis in ("Lon", "Lat", "Hgt"))
        # A drone without a solution writes zeros.
        if min(east, north, up) > 0 and max(east, north, up) <= FAR_M:
            return max(east, north), up
    typical = RTK_M.get(int(xmp.get("RtkFlag", "0") or 0), GNSS_M)
    written = float(gps.get(ExifTags.GPS.GPSHPositioningError, math.nan))
    return (written, written * typical[1] / typical[0]) if 0 < written <= FAR_M else typical


def _focal(xmp: Mapping[str, str], film_mm: Any, width: int, height: int) -> float | None:
    """Return the focal length (pixels): the manufacturer's calibration, else from the 35 mm equivalent.

    The equivalent compares diagonals of full sensors (CIPA DCG-001); wide photographs are cropped in height.
    """
    longer, shorter = max(width, height), min(width, height)
    if 0 < float(xmp.get("CalibratedFocalLength") or 0) <= LONGEST * longer:
        return float(xmp["CalibratedFocalLength"])
    if not film_mm or not 0 < float(film_mm) <= LONGEST * FILM_DIAGONAL_MM:
        return None
    return float(film_mm) / FILM_DIAGONAL_MM * math.hypot(longer, max(shorter, longer / WIDEST))


def _date(text: Any) -> datetime | None:
    try:
        return datetime.strptime(str(text), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None


def _check_one_place(shots: Sequence[Shot], positions: Floats) -> None:
    groups = scipy.cluster.hierarchy.fcluster(
        scipy.cluster.hierarchy.linkage(positions[:, :2], "single"), FAR_M, "distance"
    )
    if groups.max() == 1:
        return
    first = [shots[int(np.argmax(groups == k))].path.name for k in range(1, groups.max() + 1)]
    raise TaskError(
        f"the photographs are from {groups.max()} places more than {FAR_M:g} m apart "
        f"({', '.join(first[:4])}); prepare each place separately"
    )
