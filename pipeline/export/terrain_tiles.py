"""Heights of a run as map tiles in one PMTiles file.

Pixels of the finest zoom level are sampled from the surface at their centres; those of the others are means.
A map tile may belong to several tiles of the run, and PMTiles wants them in the order of their ids, so that
heights are collected in a temporary file: memory grows by an index of the map tiles alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np

from flexroad.catalog.crs import bounds_in, name, scales, transformer
from flexroad.catalog.grid import Bounds
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.storage.staging import atomic_file
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.source import Options, Source
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.export import terrarium
from flexroad.tasks.export.terrarium import SIZE
from flexroad.tasks.spline.levelled import top_of
from flexroad.tasks.types import Floats

pmtiles = lazy("pmtiles")

VERSION = terrarium.VERSION
INSTALL = "pip install 'flexroad[export]'"
BLOCK_BYTES = 4 * SIZE * SIZE


@dataclass
class _Canvas:
    """Heights of map tiles in a file, float32, m; NaN where there are none."""

    file: IO[bytes]
    places: dict[tuple[int, int, int], int] = field(default_factory=dict)
    """Number of the block in the file of each map tile: zoom, column, row."""

    def read(self, tile: tuple[int, int, int]) -> Floats:
        """Return the heights of a map tile, ``(SIZE, SIZE)``."""
        if tile not in self.places:
            return np.full((SIZE, SIZE), np.nan)
        self.file.seek(self.places[tile] * BLOCK_BYTES)
        return np.frombuffer(self.file.read(BLOCK_BYTES), "<f4").reshape(SIZE, SIZE).astype(np.float64)

    def write(self, tile: tuple[int, int, int], heights: Floats) -> None:
        """Keep the heights of a map tile."""
        self.file.seek(self.places.setdefault(tile, len(self.places)) * BLOCK_BYTES)
        self.file.write(heights.astype("<f4").tobytes())


def write_tiles(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> None:
    """Write the PMTiles file.

    Raises
    ------
    ConfigError
        If the library is missing, or no tile has a height.
    OSError
        If the file cannot be written.
    """
    writer = load_writer()
    grids = [tile.grid for tile in source.tiles]
    placed = np.array([bounds_in(terrarium.CRS, grid.crs, grid.bounds) for grid in grids])
    bounds: Bounds = (*placed[:, :2].min(axis=0).tolist(), *placed[:, 2:].max(axis=0).tolist())
    middle = (bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2
    ground_m = min(scales(terrarium.CRS, source.crs, *middle))
    zoom = terrarium.zoom_of((options.resolution_m or min(grid.cell for grid in grids)) / ground_m)
    first = min(terrarium.overview_zoom(bounds), zoom)
    beside = folder if isinstance(folder, Path) else None
    with TemporaryFile(dir=beside) as heights, TemporaryFile(dir=beside) as images:
        canvas = _Canvas(heights)
        lowest = min((_add(canvas, zoom, tile) for tile in tiles), default=np.inf)
        if not canvas.places:
            raise ConfigError(f"{source.run.path}: no selected tile has a height")
        for level in range(zoom, first, -1):
            _add_overviews(canvas, level)
        target = folder / f"{source.run.path.name}{terrarium.NAME}"
        with atomic_file(target) as local, local.open("wb") as file:
            archive = writer(file)
            # Its own one lies in the system's folder for temporary files, which may be memory.
            archive.tile_f.close()
            archive.tile_f = images
            _write(archive, canvas, source, bounds, float(np.floor(lowest)) - 1)


def load_writer() -> Any:
    """Return the class that writes PMTiles archives.

    Raises
    ------
    ConfigError
        If its library is not installed.
    """
    try:
        return import_module("pmtiles.writer").Writer
    except ImportError as error:
        raise ConfigError(f"pmtiles needs the library pmtiles; install it with {INSTALL}") from error


def _add(canvas: _Canvas, zoom: int, tile: FinishedTile) -> float:
    """Sample the pixels of a tile; return its lowest height (m), infinite without any."""
    surface, road, grid = top_of(tile.surface), tile.road, tile.tile.grid
    placed, lowest = bounds_in(terrarium.CRS, grid.crs, grid.bounds), np.inf
    west, south, east, north = grid.bounds
    to_run = transformer(terrarium.CRS, grid.crs)
    for column, row in terrarium.touched(zoom, placed):
        x, y = terrarium.pixel_centres(zoom, column, row)
        columns = np.flatnonzero((placed[0] <= x) & (x <= placed[2]))
        rows = np.flatnonzero((placed[1] <= y) & (y <= placed[3]))
        if not (columns.size and rows.size):
            continue
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        eastings, northings = to_run.transform(*np.meshgrid(x[part[1]], y[part[0]]))
        inside = (west <= eastings) & (eastings <= east) & (south <= northings) & (northings <= north)
        inside[inside] = ~road.outside[road.grid.cells(eastings[inside], northings[inside])]
        values = surface.height(eastings[inside], northings[inside])
        if not np.isfinite(values).any():
            continue
        lowest = min(lowest, float(np.nanmin(values)))
        heights = canvas.read((zoom, column, row))
        known = heights[part]
        known[inside] = np.where(np.isnan(values), known[inside], values)
        canvas.write((zoom, column, row), heights)
    return lowest


def _add_overviews(canvas: _Canvas, zoom: int) -> None:
    """Add the map tiles of the level above: means of four pixels."""
    for parent in sorted(
        {(zoom - 1, column // 2, row // 2) for z, column, row in canvas.places if z == zoom}
    ):
        _, column, row = parent
        quarters = [
            [terrarium.halved(canvas.read((zoom, 2 * column + i, 2 * row + j))) for i in (0, 1)]
            for j in (0, 1)
        ]
        canvas.write(parent, np.block(quarters))


def _write(archive: Any, canvas: _Canvas, source: Source, bounds: Bounds, no_height: float) -> None:
    """Write the images of all map tiles in the order of their ids, and what they are."""
    for number, tile in sorted((pmtiles.tile.zxy_to_tileid(*tile), tile) for tile in canvas.places):
        archive.write_tile(number, terrarium.encode_png(canvas.read(tile), no_height))
    west, south, east, north = bounds_in("EPSG:4326", terrarium.CRS, bounds)
    levels = [zoom for zoom, _, _ in canvas.places]
    header = {
        "tile_type": pmtiles.tile.TileType.PNG,
        "tile_compression": pmtiles.tile.Compression.NONE,
        "min_lon_e7": round(west * 1e7),
        "min_lat_e7": round(south * 1e7),
        "max_lon_e7": round(east * 1e7),
        "max_lat_e7": round(north * 1e7),
        "center_zoom": min(levels),
        "center_lon_e7": round((west + east) / 2 * 1e7),
        "center_lat_e7": round((south + north) / 2 * 1e7),
    }
    datum = name(source.vertical) if source.vertical else "the vertical datum of the survey"
    metadata = {
        "name": source.run.path.name,
        "description": f"Heights of the ground in metres above {datum}, not above the ellipsoid",
        "attribution": "FlexRoad; the licence of the survey applies",
        "type": "overlay",
        "encoding": "terrarium",
        "tileSize": SIZE,
        "height": "red * 256 + green + blue / 256 - 32768",
        "no_height_m": no_height,
        "vertical_crs": source.vertical,
        "crs_of_run": source.crs,
    }
    archive.finalize(header, metadata)
