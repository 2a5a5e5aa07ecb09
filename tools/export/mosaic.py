"""Heights, normals, road and height source of a run, each as one cloud-optimised GeoTIFF over all its tiles.

Cells are sampled from the surface at their centres. The values are first collected in a temporary raster
without compression; it has only the blocks with tiles. It is copied to the final file at the end: GDAL writes
overviews before the data, so a file cannot grow tile by tile.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.crs import compound
from flexroad.catalog.grid import MOST_CELLS, Bounds, Grid
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.buckets import atomic_file
from flexroad.catalog.storage.paths import Location, write
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import reason
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.levels.seen import top_mask, with_approaches
from flexroad.tasks.products import cog
from flexroad.tasks.quality.height_source import HeightSource, top_height_source
from flexroad.tasks.types import Bools, Floats, Surface
from flexroad.tools.export.source import Options, Source

rasterio = lazy("rasterio")

VERSION = 1
NORMAL_STEPS = 32767
"""Encoded value of a component of 1."""
NO_NORMAL = -32768
NO_ROAD = 255
"""Value of the road mask where no tile is finished."""
PART_CELLS = 2**20
"""Largest number of cells that are sampled at a time."""
CACHE_BYTES = 128 * 2**20
"""Blocks that GDAL keeps in memory; its own default grows with the machine."""
SAME_CELL = 1e-6
"""Tolerance of positions for rounding (cells)."""


@dataclass(frozen=True)
class _Layer:
    """One file of the mosaic."""

    name: str
    """Name of the file, without suffix."""
    bands: tuple[cog.Band, ...]
    overviews: str
    """How cells of an overview are computed from finer cells."""


LAYERS = (
    _Layer("height", (cog.HEIGHT,), "average"),
    _Layer(
        "normal",
        tuple(
            cog.Band(
                f"normal_{axis}", f"Component of the upward unit normal to the {way}", "int16", "", NO_NORMAL
            )
            for axis, way in (("x", "east"), ("y", "north"), ("z", "zenith"))
        ),
        "average",
    ),
    _Layer("road", (replace(cog.ROAD, nodata=NO_ROAD),), "mode"),
    _Layer("height_source", (cog.HEIGHT_SOURCE,), "mode"),
)


def write_mosaics(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any] | None:
    """Write one raster per quantity over all tiles; return the level, if one is given, for the manifest."""
    grid = whole_grid([tile.grid for tile in source.tiles], options.resolution_m)
    level, number = options.level, 0
    # Drafts need the most space: they are next to the files, or on the local disk for a bucket.
    with ScratchFolder(folder if isinstance(folder, Path) else None) as scratch:
        drafts = Path(scratch)
        limits = {"GDAL_CACHEMAX": CACHE_BYTES, "CPL_TMPDIR": str(drafts)}
        with _gdal(folder, **limits), ExitStack() as opened:
            rasters = [opened.enter_context(_draft(drafts, layer, grid, source)) for layer in LAYERS]
            for tile in tiles:
                if shown := _shown(tile, level):
                    _add(rasters, grid, tile, shown)
                    number += 1
        for layer in LAYERS:
            target = folder / f"{layer.name}.tif"
            with atomic_file(target) as local, _gdal(target, **limits):
                _finish(drafts / layer.name, local, layer)
            if style := cog.encode_style(layer.bands[0]) if len(layer.bands) == 1 else b"":
                write(folder / f"{layer.name}{cog.NAME_STYLE}", style)
    if level is None:
        return None
    return {"level": level} | ({} if number else {"notes": [f"no tile has a road of level {level}"]})


@contextmanager
def _gdal(target: Location, **limits: Any) -> Iterator[None]:
    """Set GDAL's limits, and raise its errors as errors of the system."""
    try:
        with rasterio.Env(**limits):
            yield
    except (rasterio.errors.RasterioError, rasterio._err.CPLE_BaseError) as error:
        raise OSError(errno.EIO, reason(error.__cause__ or error), str(target)) from error


def whole_grid(grids: Sequence[Grid], cell: float | None) -> Grid:
    """Return the grid over all grids, on their lattice or on multiples of a cell size (m)."""
    if cell is None:
        whole = Grid.holding(grids)
        if whole is None:
            raise ConfigError("the tiles have cells of several sizes or lattices; give --resolution METRES")
        return whole
    west, north = min(grid.west for grid in grids), max(grid.north for grid in grids)
    east, south = max(grid.east for grid in grids), min(grid.south for grid in grids)
    left, bottom = (math.floor(edge / cell + SAME_CELL) for edge in (west, south))
    right, top = (math.ceil(edge / cell - SAME_CELL) for edge in (east, north))
    width, height = right - left, top - bottom
    if max(width, height) > MOST_CELLS:
        raise ConfigError(f"--resolution {cell:g}: {width} x {height} cells are too many; give a larger one")
    return Grid(grids[0].crs, left * cell, top * cell, cell, width, height)


def _draft(folder: Path, layer: _Layer, grid: Grid, source: Source) -> Any:
    """Open a raster without compression for the values of a layer."""
    heights = layer.bands[0] is cog.HEIGHT and source.vertical
    raster = rasterio.open(
        folder / layer.name,
        "w+",
        driver="GTiff",
        dtype=layer.bands[0].dtype,
        count=len(layer.bands),
        width=grid.width,
        height=grid.height,
        crs=compound(grid.crs, source.vertical) if heights else grid.crs,
        transform=grid.transform,
        nodata=layer.bands[0].nodata,
        tiled=True,
        blockxsize=cog.BLOCK,
        blockysize=cog.BLOCK,
        # With "pixel" GDAL 3.10 fills missing blocks of the later bands with 0 when its memory is small.
        interleave="band",
        sparse_ok=True,
        bigtiff="YES",
    )
    for number, band in enumerate(layer.bands, 1):
        cog.describe(raster, number, band)
    if layer.bands[0].nodata == NO_NORMAL:
        raster.scales = [1 / NORMAL_STEPS] * len(layer.bands)
    return raster


_Shown = tuple[Surface, Bools, NDArray[np.uint8], int]
"""The content of the rasters on a tile: surface, filtered road cells on the grid of its mask, height source.

The last entry is the level of a deck or tunnel, or 0 if the surface is shown everywhere.
"""


def _shown(tile: FinishedTile, level: int | None) -> _Shown | None:
    """Return the content for a level, or for the highest level if it is None; None if the tile lacks it."""
    surface, clusters, quality = tile.surface, tile.clusters, tile.quality
    if level is None:
        core = tile.tile.grid
        top = surface.top(*np.meshgrid(core.eastings, core.northings))
        return surface.highest, top_mask(clusters), top_height_source(quality, top), 0
    if level == 0:
        return surface, with_approaches(clusters).mask, quality.height_source, 0
    if level not in surface.numbers:
        return None
    (own,) = (own for own in clusters.levels if own.number == level)
    height_source = dict(quality.levels)[level].height_source
    return surface.at(level), own.mask, height_source, level


def _add(rasters: Sequence[Any], grid: Grid, tile: FinishedTile, shown: _Shown) -> None:
    """Write the cells of a tile into the drafts."""
    (surface, kept, of_source, level), road, core = shown, tile.road, tile.tile.grid
    for part, column, line in _parts(grid, core.bounds):
        eastings, northings = part.eastings, part.northings
        outside = road.outside[_cells(road.grid, eastings, northings)]
        is_road = kept[_cells(road.grid, eastings, northings)].astype(np.uint8)
        height_source = of_source[_cells(core, eastings, northings)]
        if level:
            beyond = ~tile.surface.covers(level, *np.meshgrid(eastings, northings))
            outside, is_road = outside | beyond, np.where(beyond, NO_ROAD, is_road)
            height_source = np.where(beyond, HeightSource.NONE, height_source)
        heights = surface.lattice(eastings, northings)
        heights[outside] = np.nan
        normals = encoded_normals(surface.normal(eastings[None, :], northings[:, None]))
        normals[:, ~np.isfinite(heights)] = NO_NORMAL
        values: tuple[NDArray[Any], ...] = (
            heights.astype(np.float32)[None],
            normals,
            is_road.astype(np.uint8)[None],
            height_source.astype(np.uint8)[None],
        )
        window = rasterio.windows.Window(column, line, part.width, part.height)
        for raster, new in zip(rasters, values, strict=True):
            # Where tiles overlap, nodata of a later tile does not replace values of an earlier tile.
            nodata = np.isnan(new) if np.isnan(raster.nodata) else new == raster.nodata
            raster.write(np.where(nodata, raster.read(window=window), new), window=window)


def encoded_normals(normals: Floats) -> NDArray[np.int16]:
    """Return unit normals, ``(H, W, 3)``, as whole numbers, ``(3, H, W)``; NaN becomes nodata."""
    steps = np.rint(np.moveaxis(normals, -1, 0) * NORMAL_STEPS)
    return np.nan_to_num(steps, nan=NO_NORMAL).astype(np.int16)


def _parts(grid: Grid, bounds: Bounds) -> Iterator[tuple[Grid, int, int]]:
    """Yield the cells of a grid with their centre in bounds, by bands of rows, with first column and row.

    Centres on the western or northern edge are included; centres on the other edges are not.
    """
    west, south, east, north = bounds
    columns = _first(west - grid.west, grid.cell), _first(east - grid.west, grid.cell)
    rows = _first(grid.north - north, grid.cell), _first(grid.north - south, grid.cell)
    left, right = max(columns[0], 0), min(columns[1], grid.width)
    top, bottom = max(rows[0], 0), min(rows[1], grid.height)
    if left >= right:
        return
    step = max(PART_CELLS // (right - left), 1)
    for line in range(top, bottom, step):
        yield grid.part(slice(line, min(line + step, bottom)), slice(left, right)), left, line


def _first(distance: float, cell: float) -> int:
    """Return the first cell whose centre is at least a distance (m) from the edge."""
    return math.ceil(distance / cell - 0.5 - SAME_CELL)


def _cells(grid: Grid, eastings: Floats, northings: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and columns of a grid under all pairs of coordinates, as an open mesh (`np.ix_`)."""
    rows, _ = grid.cells(eastings[:1], northings)
    _, columns = grid.cells(eastings, northings[:1])
    return rows[:, None], columns[None, :]


def _finish(draft: Path, path: Path, layer: _Layer) -> None:
    """Copy a draft to a cloud-optimised GeoTIFF with overviews, and read it once.

    When GDAL closes a file, it does not report blocks that it could not write. Only reading shows them.
    """
    rasterio.shutil.copy(
        draft,
        path,
        driver="COG",
        compress="deflate",
        predictor="yes",
        blocksize=cog.BLOCK,
        overview_resampling=layer.overviews,
        sparse_ok="YES",
        bigtiff="IF_SAFER",
    )
    with rasterio.open(path) as raster:
        for _, window in raster.block_windows():
            raster.read(window=window)
