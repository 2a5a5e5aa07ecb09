"""Heights as map tiles: PNG with Terrarium's encoding, in squares of Web Mercator.

A height is ``red * 256 + green + blue / 256 - 32768`` metres, so that a step has 1/256 m. (The other encoding
of map tiles, Mapbox's, has steps of 0.1 m.) The encoding has no value for pixels without a height.
"""

from __future__ import annotations

import io
import math

import numpy as np

from flexroad.catalog.grid import Bounds
from flexroad.catalog.lazy import lazy
from flexroad.tasks.types import Floats

Image = lazy("PIL.Image")

VERSION = 1
NAME = ".pmtiles"
MEDIA_TYPE = "application/vnd.pmtiles"
CRS = "EPSG:3857"
SIZE = 512
"""Pixels along a side of a tile."""
STEP_M = 1 / 256
OFFSET_M = 32768.0
HALF = math.pi * 6378137.0
"""Half the width of the map (m)."""
MAX_ZOOM = 24


def encode_png(heights: Floats, no_height: float) -> bytes:
    """Return heights, ``(SIZE, SIZE)``, m, as PNG; pixels without one get ``no_height`` (m)."""
    steps = np.rint((np.where(np.isnan(heights), no_height, heights) + OFFSET_M) / STEP_M).astype(np.uint32)
    colours = np.stack([steps >> 16, steps >> 8 & 255, steps & 255], axis=-1).astype(np.uint8)
    encoded = io.BytesIO()
    Image.fromarray(colours).save(encoded, "PNG")
    return encoded.getvalue()


def zoom_of(pixel_m: float) -> int:
    """Return the first zoom level with pixels of at most a size on the map (m)."""
    return min(max(math.ceil(math.log2(2 * HALF / SIZE / pixel_m) - 1e-6), 0), MAX_ZOOM)


def overview_zoom(bounds: Bounds) -> int:
    """Return the last zoom level of which a tile is as large as bounds on the map (m)."""
    west, south, east, north = bounds
    return min(max(math.floor(math.log2(2 * HALF / max(east - west, north - south))), 0), MAX_ZOOM)


def pixel_centres(zoom: int, column: int, row: int) -> tuple[Floats, Floats]:
    """Return x of the columns and y of the rows of a tile's pixel centres on the map, ``(SIZE,)`` each (m).

    Tiles count from the north-west.
    """
    side = 2 * HALF / 2**zoom
    parts = (np.arange(SIZE) + 0.5) / SIZE
    return -HALF + (column + parts) * side, HALF - (row + parts) * side


def touched(zoom: int, bounds: Bounds) -> list[tuple[int, int]]:
    """Return columns and rows of the tiles that bounds on the map (m) touch."""
    west, south, east, north = bounds
    side, last = 2 * HALF / 2**zoom, 2**zoom - 1
    left, right, top, bottom = (
        min(max(math.floor(distance / side), 0), last)
        for distance in (west + HALF, east + HALF, HALF - north, HALF - south)
    )
    return [(column, row) for row in range(top, bottom + 1) for column in range(left, right + 1)]


def halved(heights: Floats) -> Floats:
    """Return the means of the known heights of 2 x 2 pixels each, ``(H / 2, W / 2)``."""
    height, width = heights.shape
    parts = heights.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(height // 2, width // 2, 4)
    known = ~np.isnan(parts)
    number = known.sum(axis=-1)
    means = np.where(known, parts, 0).sum(axis=-1) / np.maximum(number, 1)
    return np.where(number > 0, means, np.nan)
