"""Heights of bridge decks from classified point clouds; terrain models do not contain bridges.

A cloud is decoded once, in chunks, into a small raster of deck heights that is stored beside the catalog.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

from flexroad.catalog.grid import Bounds
from flexroad.catalog.headers.open_raster import ERRORS, open_raster
from flexroad.catalog.headers.point_clouds import chunks
from flexroad.catalog.storage.outputs import output_file

Floats = NDArray[np.float64]

DECK = 17
"""Class of bridge decks (ASPRS LAS 1.4)."""
CELL_M = 1.0


def deck_raster(cloud: Path, target: Path, square: Bounds, crs: str) -> bool:
    """Write the mean height of a cloud's bridge points per cell; return whether there are any.

    An existing target that is not older than the cloud is kept, unless it is damaged.

    Parameters
    ----------
    cloud : Path
        LAS or LAZ file, in ``crs`` and metres.
    target : Path
        GeoTIFF to write: float32, NaN where there is no bridge.
    square : Bounds
        Bounds of the raster (m); points outside are ignored.
    crs : str
        CRS of the cloud and the raster.

    Raises
    ------
    CatalogError
        If the cloud cannot be read; names the file.
    """
    kept = _kept(cloud, target)
    if kept is not None:
        return kept
    west, south, east, north = square
    width, height = math.ceil((east - west) / CELL_M), math.ceil((north - south) / CELL_M)
    total, count = np.zeros(width * height), np.zeros(width * height, np.int64)
    for x, y, z in _decks(cloud):
        col, row = np.floor((x - west) / CELL_M).astype(int), np.floor((north - y) / CELL_M).astype(int)
        inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
        cell = row[inside] * width + col[inside]
        total += np.bincount(cell, z[inside], minlength=total.size)
        count += np.bincount(cell, minlength=count.size)
    with np.errstate(invalid="ignore"):
        heights = (total / count).reshape(height, width)
    _write(target, heights, Affine(CELL_M, 0, west, 0, -CELL_M, north), crs)
    return bool(count.any())


def _kept(cloud: Path, target: Path) -> bool | None:
    """Return whether an existing target has bridges; None if it is older than the cloud, or damaged."""
    try:
        if target.stat().st_mtime_ns < cloud.stat().st_mtime_ns:
            return None
        with open_raster(target) as raster:
            return bool(np.isfinite(raster.read(1)).any())
    except ERRORS:
        return None


def _decks(cloud: Path) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Yield easting, northing and height of the bridge points, chunk by chunk (m)."""
    for chunk in chunks(cloud):
        deck = chunk.kind == DECK
        yield chunk.x[deck], chunk.y[deck], chunk.z[deck]


def _write(target: Path, heights: Floats, transform: Affine, crs: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.tmp")
    rows, cols = heights.shape
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "compress": "deflate", "nodata": np.nan}
    with rasterio.open(
        temporary, "w", width=cols, height=rows, transform=transform, crs=crs, **profile
    ) as raster:
        raster.write(heights.astype(np.float32), 1)
    temporary.replace(output_file(target))
