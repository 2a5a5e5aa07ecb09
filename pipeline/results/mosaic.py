"""Mosaic of the GeoTIFFs of a run's tiles: one lazy raster, read block by block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog import Bounds, Grid, Tile
from flexroad.catalog.crs import same
from flexroad.catalog.grid import LATTICE_TOLERANCE
from flexroad.catalog.ids import safe_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.links import contained
from flexroad.catalog.storage.paths import absolute, parse_location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.lazy import lazy_raster
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tasks.export import cog
from flexroad.tasks.io.raster import read_raster

rasterio = lazy("rasterio")


class LayerFile(NamedTuple):
    """One kind of GeoTIFF among the products of a tile."""

    suffix: str
    """The file name after the tile id and the variant."""
    dtype: str
    fill: float
    """Value of cells without a finished tile."""


LAYERS = {
    "height": LayerFile(cog.NAME_HEIGHT, "float32", math.nan),
    "road": LayerFile(cog.NAME_ROAD, "bool", False),
}


class Window(NamedTuple):
    """A rectangular part of a tile's rasters, in cells."""

    stem: str
    """The path of the tile's products without the suffix."""
    row: int
    """First row of the part in the tile."""
    column: int
    """First column of the part in the tile."""
    height: int
    width: int


@dataclass(frozen=True)
class Mosaic:
    """A raster divided into blocks by all tile edges; each block lies in at most one finished tile."""

    grid: Grid
    """The cells of the complete raster."""
    heights: tuple[int, ...]
    """Number of cell rows of each row of blocks."""
    widths: tuple[int, ...]
    """Number of cell columns of each column of blocks."""
    windows: dict[tuple[int, int], Window]
    """The source of each block by its (row, column); blocks without a finished tile are absent."""

    @classmethod
    def of(cls, run: Run, variant: str, bounds: Bounds | None) -> Mosaic:
        """Return the mosaic of the finished tiles of a run in the bounds (m); None for all tiles.

        Raises
        ------
        ConfigError
            If the bounds are empty, or tiles have different cell sizes or lattices.
        """
        tiles = run.catalog.usable
        grid = _grid(tiles, bounds)
        near = [tile for tile in tiles if _meet(tile.grid, grid)]
        statuses = peek_statuses(run, near)
        spans = [(*_span(tile, grid), status) for tile, status in zip(near, statuses, strict=True)]
        rows = _edges([(top, bottom) for top, bottom, *_ in spans], grid.height)
        columns = _edges([(left, right) for _, _, left, right, _ in spans], grid.width)
        windows: dict[tuple[int, int], Window] = {}
        for (top, bottom, left, right, status), tile in zip(spans, near, strict=True):
            if not status.done:
                continue
            stem = str(absolute(run.path) / "tiles" / safe_name(tile.id) / f"{safe_name(tile.id)}_{variant}")
            for i in _between(rows, top, bottom):
                for j in _between(columns, left, right):
                    size = rows[i + 1] - rows[i], columns[j + 1] - columns[j]
                    windows.setdefault((i, j), Window(stem, rows[i] - top, columns[j] - left, *size))
        return cls(grid, _steps(rows), _steps(columns), windows)

    def layer(self, file: LayerFile) -> Any:
        """Return one layer as a Dask array, ``(H, W)``."""
        sources = {block: (window, file.suffix) for block, window in self.windows.items()}
        return lazy_raster(_read, sources, self.heights, self.widths, file.dtype, file.fill)


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


def _meet(a: Grid, b: Grid) -> bool:
    return a.west < b.east and b.west < a.east and a.south < b.north and b.south < a.north


def _span(tile: Tile, grid: Grid) -> tuple[int, int, int, int]:
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


def _edges(spans: Sequence[tuple[int, int]], size: int) -> list[int]:
    """Return the block edges along an axis of ``size`` cells, ascending, with 0 and ``size``."""
    inner = {edge for span in spans for edge in span if 0 < edge < size}
    return sorted({0, size} | inner)


def _between(edges: Sequence[int], start: int, stop: int) -> range:
    """Return the indices of the blocks from ``start`` to ``stop``, which are edges or lie outside."""
    return range(np.searchsorted(edges, max(start, 0)), np.searchsorted(edges, min(stop, edges[-1])))


def _steps(edges: Sequence[int]) -> tuple[int, ...]:
    return tuple(b - a for a, b in pairwise(edges))


def _read(source: tuple[Window, str]) -> NDArray[Any]:
    """Read a part of a product, ``(height, width)``."""
    window, suffix = source
    path = parse_location(window.stem + suffix)
    file = contained(path, path.parents[2])
    part = rasterio.windows.Window(window.column, window.row, window.width, window.height)
    values: NDArray[Any] = read_raster(file, path.name, lambda raster: raster.read(1, window=part))
    return values
