"""Rendered photographs of a synthetic hill from given positions, with the tags that a drone writes."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from pyproj import Transformer
from scipy.ndimage import gaussian_filter, map_coordinates

CRS = "EPSG:32632"
CORNER = np.array([420_000.0, 5_650_000.0])
"""Easting and northing of the ground's south-west corner (m)."""
SIDE_M, TEXEL_M, DATUM_M = 70.0, 0.05, 100.0
WIDTH, HEIGHT = 640, 480
FILM_MM = 32
FOCAL = FILM_MM / np.hypot(36, 24) * np.hypot(WIDTH, HEIGHT)
FLYING_M = 40.0


@dataclass(frozen=True)
class Photograph:
    """One photograph."""

    path: Path
    centre: np.ndarray
    """Easting, northing, height."""
    rotation: np.ndarray
    """World to camera."""

    def pixels(self, points):
        """Return column and row of world points, ``(n, 2)``."""
        local = (points - self.centre) @ self.rotation.T
        return FOCAL * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)


def ground(easting, northing):
    """Return the true height (m): waves 3 m high, about 30 m long, on a slope."""
    x, y = easting - CORNER[0], northing - CORNER[1]
    return DATUM_M + 1.5 * np.sin(x / 5) * np.cos(y / 6) + 0.03 * x


@cache
def texture():
    """Return colours of the ground, ``(n, n, 3)``, row 0 in the south: noise of several scales."""
    rng = np.random.default_rng(0)
    n = round(SIDE_M / TEXEL_M)
    grey = sum(gaussian_filter(rng.standard_normal((n, n)), s) * s for s in (1, 3, 9))
    tint = gaussian_filter(rng.standard_normal((n, n, 3)), (20, 20, 0)) * 300
    return np.clip(120 + 55 * grey[..., None] + tint, 0, 255)


def photographs(folder, **tags):
    """Write two strips of four nadir photographs with small rotations; return them."""
    rng = np.random.default_rng(5)
    colours, photos = texture(), []
    for number in range(8):
        strip, along = divmod(number, 4)
        offset = np.array([28 + 14 * strip, 21 + 9.5 * along]) + rng.uniform(-0.5, 0.5, 2)
        centre = np.array([*CORNER + offset, DATUM_M + FLYING_M + rng.uniform(-0.5, 0.5)])
        rotation = _rotation(*np.radians(rng.uniform(-3, 3, 3)))
        path = folder / f"DJI_{number:04}.JPG"
        image = render(centre, rotation, colours)
        Image.fromarray(image).save(path, quality=95, exif=exif(centre, **tags))
        photos.append(Photograph(path, centre, rotation))
    return photos


def render(centre, rotation, colours):
    """Return the image of the ground from a camera, ``(h, w, 3)``."""
    col, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = (
        np.stack([(col - WIDTH / 2) / FOCAL, (row - HEIGHT / 2) / FOCAL, np.ones(col.shape)], -1) @ rotation
    )
    height = np.full(col.shape, DATUM_M)
    for _ in range(25):
        # The ground is less steep than the rays, so this fixed-point iteration converges.
        place = centre + rays * ((height - centre[2]) / rays[..., 2])[..., None]
        height = ground(place[..., 0], place[..., 1])
    texel = [(place[..., axis] - CORNER[axis]) / TEXEL_M - 0.5 for axis in (1, 0)]
    bands = [map_coordinates(colours[..., band], texel, order=1, mode="mirror") for band in range(3)]
    return np.rint(np.stack(bands, -1)).astype(np.uint8)


def exif(centre, film_mm=FILM_MM, offset=(0, 0, 0), model="Made"):
    """Return a drone's tags for a camera at ``centre`` whose GNSS position has the error ``offset`` (m)."""
    tags = Image.Exif()
    tags[ExifTags.Base.Make], tags[ExifTags.Base.Model] = "Test", model
    detail = tags.get_ifd(ExifTags.IFD.Exif)
    detail[ExifTags.Base.DateTimeOriginal] = "2024:05:17 10:30:00"
    if film_mm:
        detail[ExifTags.Base.FocalLengthIn35mmFilm] = film_mm
    east, north, up = np.asarray(centre) + offset
    longitude, latitude = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(east, north)
    gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
    for name, ref, degrees, signs in (
        (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, longitude, "EW"),
        (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, latitude, "NS"),
    ):
        size = abs(degrees)
        gps[ref] = signs[degrees < 0]
        gps[name] = (int(size), int(size * 60 % 60), round(size * 3600 % 60, 6))
    gps[ExifTags.GPS.GPSAltitudeRef] = b"\0"
    gps[ExifTags.GPS.GPSAltitude] = round(float(up), 3)
    return tags


def _rotation(roll, pitch, yaw):
    """Return the rotation from world to camera: nadir view, columns east, rows south, then rotated."""
    down = np.diag([1.0, -1.0, -1.0])
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return x @ y @ z @ down
