"""Rasters made from inputs that are not rasters (point files). They are stored next to the catalog."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.guard.source_files import require_regular
from flexroad.catalog.storage.outputs import atomic_path
from flexroad.catalog.text import one_line

Floats = NDArray[np.float64]
MAX_BYTES = 500_000_000
"""Largest size of the arrays of one file: points of a tile at 0.1 m have 150 MB."""
MAX_CELLS = 25_000_000
TOLERANCE = 0.01
"""Greatest distance of a point from the lattice (cells)."""


def write_heights(target: Path, heights: Floats, transform: Affine, crs: str) -> None:
    """Write heights as a GeoTIFF (float32, NaN is nodata)."""
    target.parent.mkdir(parents=True, exist_ok=True)
    rows, cols = heights.shape
    profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "compress": "deflate", "nodata": np.nan}
    with (
        atomic_path(target) as temporary,
        rasterio.open(
            temporary, "w", width=cols, height=rows, transform=transform, crs=crs, **profile
        ) as raster,
    ):
        raster.write(heights.astype(np.float32), 1)


def is_current(source: Path, target: Path) -> bool:
    """Return whether a raster is undamaged, and not older than the file from which it was made."""
    try:
        if target.stat().st_mtime_ns < source.stat().st_mtime_ns:
            return False
        with open_raster(target) as raster:
            raster.read(1)
    except ERRORS:
        return False
    return True


def rasters_of_points(source: Path, corner: tuple[float, float]) -> tuple[dict[str, Floats], Affine]:
    """Return the values of points on a lattice as rasters, by the name of their array, and their transform.

    - `source`: NumPy archive with the arrays x and y (m) and others of their shape, or of the shape ``(y,
      x)``.
    - `corner`: added to coordinates that are all below 1000 m: they are relative to the corner of the tile.
    """
    arrays = _arrays(source)
    try:
        x, y = arrays.pop("x").astype(np.float64), arrays.pop("y").astype(np.float64)
    except KeyError as error:
        raise CatalogError(f"{source.name} has no array {error}; points need x, y and z") from None
    if x.ndim == y.ndim == 1 and any(values.shape == (y.size, x.size) for values in arrays.values()):
        x, y = np.meshgrid(x, y)
    values = {name: array.ravel() for name, array in arrays.items() if array.shape == x.shape}
    x, y = x.ravel(), y.ravel()
    if not x.size or x.size != y.size or not values or not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise CatalogError(f"{source.name}: x, y and z do not belong together; points need one of each")
    if max(np.abs(x).max(), np.abs(y).max()) < 1000:
        x, y = x + corner[0], y + corner[1]
    steps = np.diff(np.unique(x))
    # Rounded numbers that should be equal differ by less than a millimetre.
    cell = float(steps[steps > 0.001].min(initial=np.inf))
    col, row = (x - x.min()) / cell, (y.max() - y) / cell
    shape = round(row.max()) + 1, round(col.max()) + 1
    off = max(np.abs(axis - np.round(axis)).max() for axis in (col, row))
    if not np.isfinite(cell) or off > TOLERANCE or shape[0] * shape[1] > MAX_CELLS:
        raise CatalogError(
            f"{source.name}: its points lie on no lattice; make rasters of them (`flexroad prepare`)"
        )
    rasters = {name: np.full(shape, np.nan) for name in values}
    for name, raster in rasters.items():
        raster[np.round(row).astype(int), np.round(col).astype(int)] = values[name]
    return rasters, Affine(cell, 0, x.min() - cell / 2, 0, -cell, y.max() + cell / 2)


def _arrays(source: Path) -> dict[str, NDArray[np.generic]]:
    """Return the numeric arrays of an archive, after a check of their size."""
    try:
        require_regular(source)
        with zipfile.ZipFile(source) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise CatalogError(f"{source.name} has {size / 1e9:.2f} GB of arrays: no tile has as many points")
        with np.load(source, allow_pickle=False) as archive:
            arrays: Mapping[str, NDArray[np.generic]] = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise CatalogError(f"{source.name} cannot be read: {one_line(error)}") from error
    return {name: array for name, array in arrays.items() if array.dtype.kind in "fiub"}
