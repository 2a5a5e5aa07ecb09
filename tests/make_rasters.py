"""Small raster files for tests, in formats that surveys deliver."""

from pathlib import Path

import numpy as np
import rasterio
from affine import Affine

UTM = "EPSG:25832"


def write(
    path: Path,
    values,
    west: float = 295500.0,
    north: float = 5629500.0,
    *,
    cell: float = 1.0,
    crs: str | None = UTM,
    transform: Affine | None = None,
    driver: str = "GTiff",
    unit: str | None = None,
    scale: tuple[float, float] = (1.0, 0.0),
    tags: dict[str, str] | None = None,
    **profile,
) -> Path:
    """Write a raster, ``(h, w)`` or ``(bands, h, w)``; ``west`` and ``north`` are its north-west corner."""
    values = np.asarray(values)
    bands = values if values.ndim == 3 else values[None]
    path.parent.mkdir(parents=True, exist_ok=True)
    form = dict(zip(("count", "height", "width"), bands.shape, strict=True))
    form |= {"driver": driver, "dtype": bands.dtype, "crs": crs, **profile}
    form["transform"] = transform or Affine(cell, 0, west, 0, -cell, north)
    with rasterio.open(path, "w", **form) as dst:
        dst.write(bands, [*range(1, len(bands) + 1)])
        dst.update_tags(**(tags or {}))
        if unit:
            dst.units = (unit,)
        if scale != (1.0, 0.0):
            dst.scales, dst.offsets = (scale[0],), (scale[1],)
    return path


def write_xyz(path: Path, values, west: float, north: float, *, northward: bool = False) -> Path:
    """Write one point per line, as state surveys do; with ``northward`` rows start in the south."""
    values = np.asarray(values, dtype=float)
    rows = range(values.shape[0])
    lines = [
        f"{west + col + 0.5:.1f} {north - row - 0.5:.1f} {values[row, col]:.2f}"
        for row in (reversed(rows) if northward else rows)
        for col in range(values.shape[1])
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def damage(path: Path, row: int, col: int) -> tuple[slice, slice]:
    """Overwrite the block that has a cell; return its rows and columns in the file."""
    with rasterio.open(path) as raster:
        tall, wide = raster.block_shapes[0]
        i, j = row // tall, col // wide
        start = int(raster.get_tag_item(f"BLOCK_OFFSET_{j}_{i}", "TIFF", bidx=1))
        size = int(raster.get_tag_item(f"BLOCK_SIZE_{j}_{i}", "TIFF", bidx=1))
    data = bytearray(path.read_bytes())
    data[start : start + size] = np.random.default_rng(1).bytes(size)
    path.write_bytes(data)
    return slice(i * tall, (i + 1) * tall), slice(j * wide, (j + 1) * wide)
