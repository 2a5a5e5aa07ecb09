"""Mosaic of the GeoTIFFs of a run's tiles: one lazy raster, of which parts are read when they are needed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from xarray.core import indexing

from flexroad.catalog import Bounds, Grid, Tile
from flexroad.catalog.crs import same
from flexroad.catalog.grid import LATTICE_TOLERANCE, overlap
from flexroad.catalog.ids import safe_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import absolute, contained, parse_location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tasks.io.raster import read_raster
from flexroad.tasks.products import cog

if TYPE_CHECKING:
    import rasterio
else:
    rasterio = lazy("rasterio")

LAYERS: tuple[tuple[str, str, str, float, dict[str, str]], ...] = (
    ("height", cog.NAME_HEIGHT, "float32", math.nan, {"units": "m"}),
    ("road", cog.NAME_ROAD, "bool", False, {}),
)
"""Name, end of the file's name, type of data, value off the finished tiles, and attributes of each layer."""


@dataclass(frozen=True, eq=False)
class Mosaic(xr.backends.BackendArray):
    """One layer of the finished tiles, ``(H, W)``; xarray reads it like a file."""

    shape: tuple[int, int]
    stems: tuple[str, ...]
    """Paths of the products of the n finished tiles, without the suffix."""
    boxes: NDArray[np.int64]
    """``(n, 4)``, first and end row, first and end column of each tile; they may lie outside the raster."""
    suffix: str
    dtype: np.dtype[Any]
    fill: float
    """Value of cells without a finished tile."""

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        support = indexing.IndexingSupport.BASIC
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._cells)

    def _cells(self, key: tuple[int | slice, int | slice]) -> NDArray[Any]:
        rows, columns = (np.arange(size)[part] for size, part in zip(self.shape, key, strict=True))
        if not (rows.size and columns.size):
            return np.empty((*rows.shape, *columns.shape), self.dtype)
        top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
        values = np.full((bottom - top, right - left), self.fill, self.dtype)
        first, start = np.maximum(self.boxes[:, [0, 2]], (top, left)).T
        end, stop = np.minimum(self.boxes[:, [1, 3]], (bottom, right)).T
        # The first tile in the catalog comes last, so that its cells stay where tiles overlap.
        for i in np.flatnonzero((first < end) & (start < stop))[::-1]:
            row, column = first[i] - self.boxes[i, 0], start[i] - self.boxes[i, 2]
            window = rasterio.windows.Window(column, row, stop[i] - start[i], end[i] - first[i])
            part = slice(first[i] - top, end[i] - top), slice(start[i] - left, stop[i] - left)
            values[part] = _read(self.stems[i] + self.suffix, window)
        chosen: NDArray[Any] = values[rows - top][..., columns - left]
        return chosen


def mosaic(run: Run, variant: str, bounds: Bounds | None) -> tuple[xr.Dataset, Grid]:
    """Return height and road of the finished tiles of a run in the bounds (m), and their grid.

    The arrays are backed by Dask, with a chunk between any two neighbouring edges of tiles.

    - `bounds`: None for all tiles.
    """
    tiles = run.catalog.usable
    grid = _grid(tiles, bounds)
    near = [tile for tile in tiles if overlap(tile.grid.bounds, grid.bounds)]
    boxes = np.array([_box(tile, grid) for tile in near], np.int64).reshape(-1, 4)
    done = [status.done for status in peek_statuses(run, near)]
    tile_folder = absolute(run.path) / "tiles"
    stems = tuple(
        str(tile_folder / safe_name(tile.id) / f"{safe_name(tile.id)}_{variant}")
        for tile, finished in zip(near, done, strict=True)
        if finished
    )
    layers = {}
    for name, suffix, dtype, fill, attributes in LAYERS:
        layer = Mosaic((grid.height, grid.width), stems, boxes[done], suffix, np.dtype(dtype), fill)
        layers[name] = ("y", "x"), indexing.LazilyIndexedArray(layer), attributes
    raster = xr.Dataset(layers, coords={"x": grid.eastings, "y": grid.northings})
    chunks = {"y": _steps(boxes[:, :2], grid.height), "x": _steps(boxes[:, 2:], grid.width)}
    return raster.chunk(chunks), grid


def _grid(tiles: Sequence[Tile], bounds: Bounds | None) -> Grid:
    """Return the grid on the lattice of the first tile that covers the bounds; None for all tiles."""
    edges = np.array([tile.grid.bounds for tile in tiles])
    (west, south), (east, north) = edges[:, :2].min(axis=0), edges[:, 2:].max(axis=0)
    if bounds is not None:
        west, south, east, north = bounds
    if not (west < east and south < north):
        raise ConfigError(f"bounds {bounds} are empty; give west, south, east, north in metres")
    first = tiles[0].grid
    left = math.floor((west - first.west) / first.cell + LATTICE_TOLERANCE)
    top = math.floor((first.north - north) / first.cell + LATTICE_TOLERANCE)
    right = math.ceil((east - first.west) / first.cell - LATTICE_TOLERANCE)
    bottom = math.ceil((first.north - south) / first.cell - LATTICE_TOLERANCE)
    corner = first.west + left * first.cell, first.north - top * first.cell
    return Grid(first.crs, *corner, first.cell, right - left, bottom - top)


def _box(tile: Tile, grid: Grid) -> tuple[int, int, int, int]:
    """Return first and end row, first and end column of a tile in the grid; they may lie outside it."""
    cells = tile.grid
    left, top = (cells.west - grid.west) / grid.cell, (grid.north - cells.north) / grid.cell
    offset = max(abs(left - round(left)), abs(top - round(top)))
    if cells.cell != grid.cell or offset > LATTICE_TOLERANCE or not same(cells.crs, grid.crs):
        raise ConfigError(
            f"tile {tile.id} ({cells.cell:g} m cells from {cells.west:.10g}, {cells.north:.10g}) is not on "
            f"the {grid.cell:g} m cells of the first tile; give bounds without this tile"
        )
    return round(top), round(top) + cells.height, round(left), round(left) + cells.width


def _steps(edges: NDArray[np.int64], size: int) -> tuple[int, ...]:
    """Return the lengths of the chunks along an axis of ``size`` cells, which the edges of tiles divide."""
    inside = edges[(edges > 0) & (edges < size)]
    return tuple(np.diff(np.unique([0, *inside, size])).tolist())


def _read(product: str, window: Any) -> NDArray[Any]:
    """Read a part of a product, ``(height, width)``."""
    path = parse_location(product)
    file = contained(path, path.parents[2])
    values: NDArray[Any] = read_raster(file, path.name, lambda raster: raster.read(1, window=window))
    return values
