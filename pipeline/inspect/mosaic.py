"""The GeoTIFFs of a run's tiles as one raster that is read block by block."""

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
from flexroad.catalog.storage.paths import absolute, parse_location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute.lazy import lazy_raster
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.products import safe_name
from flexroad.tasks.export import cog
from flexroad.tasks.io.raster import opened


class LayerFile(NamedTuple):
    """A raster among the products of a tile."""

    suffix: str
    dtype: str
    fill: float
    """Value where no finished tile is."""


LAYERS = {
    "height": LayerFile(cog.NAME_HEIGHT, "float32", math.nan),
    "road": LayerFile(cog.NAME_ROAD, "bool", False),
}


class Window(NamedTuple):
    """A part of a tile's rasters."""

    stem: str
    """The path of the tile's products up to their suffix."""
    row: int
    """First row of the part, in the tile."""
    column: int
    height: int
    width: int


@dataclass(frozen=True)
class Mosaic:
    """Blocks between all edges of tiles; each lies in one finished tile, or in none."""

    grid: Grid
    """The cells of the whole raster."""
    heights: tuple[int, ...]
    """Rows of each row of blocks."""
    widths: tuple[int, ...]
    windows: dict[tuple[int, int], Window]
    """What a block is read from, by its row and column; none where no finished tile is."""

    @classmethod
    def of(cls, run: Run, variant: str, bounds: Bounds | None) -> Mosaic:
        """Lay out the finished tiles of a run over some bounds (m), or over all tiles.

        Raises
        ------
        ConfigError
            If the bounds are empty, or the tiles have different cells.
        """
        tiles = run.catalog.tiles
        grid = _grid(tiles, bounds)
        near = [tile for tile in tiles if _meet(tile.grid, grid)]
        spans = [(*_span(tile, grid), now) for tile, now in zip(near, peek_statuses(run, near), strict=True)]
        rows = _edges([(top, bottom) for top, bottom, *_ in spans], grid.height)
        columns = _edges([(left, right) for _, _, left, right, _ in spans], grid.width)
        windows: dict[tuple[int, int], Window] = {}
        for (top, bottom, left, right, now), tile in zip(spans, near, strict=True):
            if not now.done:
                continue
            stem = str(absolute(run.folder(tile.id).path) / f"{safe_name(tile.id)}_{variant}")
            for i in _between(rows, top, bottom):
                for j in _between(columns, left, right):
                    size = rows[i + 1] - rows[i], columns[j + 1] - columns[j]
                    windows.setdefault((i, j), Window(stem, rows[i] - top, columns[j] - left, *size))
        return cls(grid, _steps(rows), _steps(columns), windows)

    def layer(self, file: LayerFile) -> Any:
        """Return one layer as Dask array, ``(H, W)``."""
        sources = {block: (window, file.suffix) for block, window in self.windows.items()}
        return lazy_raster(_read, sources, self.heights, self.widths, file.dtype, file.fill)


def _grid(tiles: Sequence[Tile], bounds: Bounds | None) -> Grid:
    """Return the cells of the tiles' lattice that cover the bounds."""
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
    """Return a tile's first and last row and column in the grid, which may lie beyond it."""
    own = tile.grid
    left, top = (own.west - grid.west) / grid.cell, (grid.north - own.north) / grid.cell
    off = max(abs(left - round(left)), abs(top - round(top)))
    if own.cell != grid.cell or off > LATTICE_TOLERANCE or not same(own.crs, grid.crs):
        raise ConfigError(
            f"tile {own.cell:g} m at ({own.west:.10g}, {own.north:.10g}) is not on the {grid.cell:g} m cells "
            f"of the first tile; give bounds without tile {tile.id}"
        )
    return round(top), round(top) + own.height, round(left), round(left) + own.width


def _edges(spans: Sequence[tuple[int, int]], size: int) -> list[int]:
    """Return where blocks begin and end along an axis of ``size`` cells."""
    inner = {edge for span in spans for edge in span if 0 < edge < size}
    return sorted({0, size} | inner)


def _between(edges: Sequence[int], start: int, stop: int) -> range:
    """Return the numbers of the blocks from ``start`` to ``stop``, which are edges or lie outside."""
    return range(np.searchsorted(edges, max(start, 0)), np.searchsorted(edges, min(stop, edges[-1])))


def _steps(edges: Sequence[int]) -> tuple[int, ...]:
    return tuple(b - a for a, b in pairwise(edges))


def _read(source: tuple[Window, str]) -> NDArray[Any]:
    """Read a part of a product, ``(height, width)``."""
    from rasterio import windows

    window, suffix = source
    path = parse_location(window.stem + suffix)
    with opened(path, path.name) as raster:
        part = windows.Window(window.column, window.row, window.width, window.height)
        values: NDArray[Any] = raster.read(1, window=part)
    return values
