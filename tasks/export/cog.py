"""Heights (the paper's R^S), road mask and support of a tile as cloud-optimised GeoTIFF."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats

VERSION = 2
NAME_HEIGHT = "_height.tif"
NAME_ROAD = "_road.tif"
NAME_SUPPORT = "_support.tif"
MEDIA_TYPE = "image/tiff; application=geotiff; profile=cloud-optimized"


def encode_height(height: Floats, grid: Grid) -> bytes:
    """Return heights at the cell centres of a grid, ``(H, W)``, m, as GeoTIFF: float32, nodata NaN.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    return _encode(
        height.astype(np.float32),
        grid,
        "height",
        "m",
        nodata=np.nan,
        predictor=3,
        overview_resampling="average",
    )


def encode_mask(road: Bools, grid: Grid) -> bytes:
    """Return a road mask, ``(H, W)``, as GeoTIFF: uint8, 1 is road.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    return _encode(road.astype(np.uint8), grid, "road", "", predictor=2, overview_resampling="mode")


def encode_support(support: NDArray[np.uint8], grid: Grid) -> bytes:
    """Return the `Support` of each cell, ``(H, W)``, as GeoTIFF: uint8; 0 is nodata.

    Raises
    ------
    TaskError
        If the array does not have the grid's shape.
    """
    return _encode(support, grid, "support", "", nodata=0, predictor=2, overview_resampling="mode")


def _encode(values: NDArray[Any], grid: Grid, name: str, unit: str, **options: Any) -> bytes:
    from rasterio.io import MemoryFile

    if values.shape != grid.shape:
        raise TaskError(f"{name} of {values.shape} cells does not fit a grid of {grid.shape}")
    profile = {
        "driver": "COG",
        "dtype": values.dtype,
        "count": 1,
        "width": grid.width,
        "height": grid.height,
        "crs": grid.crs,
        "transform": grid.transform,
        "compress": "deflate",
    }
    with MemoryFile() as file:
        with file.open(**profile, **options) as raster:
            raster.write(values, 1)
            raster.set_band_description(1, name)
            raster.set_band_unit(1, unit)
        encoded: bytes = file.read()
    return encoded
