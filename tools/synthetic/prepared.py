"""Folders written by FlexRoad itself: ``FOLDER/<layer>/<tile id>.tif``, one GeoTIFF per layer and tile.

`write_tile` returns the written tile, and `with_neighbours` adds the files of neighbouring tiles. Tile id,
layer, stratum and date are also stored as tags in the files. Heights are float32, exact to 0.03 mm below 512
m and to 0.5 mm anywhere on Earth; NaN is nodata. Masks are 1 on roads. The orthophoto has another pixel size
over the same bounds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import CRSError
from rasterio.io import MemoryFile

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import LATTICE_TOLERANCE, Grid, overlap
from flexroad.catalog.storage.paths import write
from flexroad.catalog.text import write_reason
from flexroad.catalog.tile import LAYERS, REACH_M, Layer, Tile, by_cover

HEIGHTS = ("dsm", "dtm", "road_height", "reference")
PHOTO = "dop"

TILE_TAG, LAYER_TAG, STRATUM_TAG = "FLEXROAD_TILE", "FLEXROAD_LAYER", "FLEXROAD_STRATUM"
DATASET_TAG = "FLEXROAD_DATASET"
DATE_TAG, DATE_FORMAT = "TIFFTAG_DATETIME", "%Y:%m:%d %H:%M:%S"
"""TIFF dates have no time zone; they are written as UTC."""


def write_tile(
    folder: Path,
    tile_id: str,
    grid: Grid,
    layers: Mapping[str, NDArray[Any]],
    stratum: str = "",
    date: datetime | None = None,
    dataset: str = "",
) -> Tile:
    """Write a tile's layers; return the tile, whose layers list only its own files (see `with_neighbours`).

    Existing files are replaced, each atomically.

    - `grid`: grid of every layer but ``dop``.
    - `layers`: heights (m) and masks, ``(H, W)``, by layer name; red, green and blue (uint8) as ``dop``,
      ``(3, h, w)`` over the grid's bounds.
    - `stratum`: class of area for reports.
    - `date`: date of the survey, with a time zone; None: when the files were written.
    - `dataset`: name of the data in reports.
    """
    tags = {TILE_TAG: tile_id, STRATUM_TAG: stratum, DATASET_TAG: dataset}
    if date is not None:
        tags[DATE_TAG] = date.astimezone(UTC).strftime(DATE_FORMAT)
    for name, array in layers.items():
        _write(folder / name / f"{tile_id}.tif", grid, name, array, {**tags, LAYER_TAG: name})
    names = [name for name in LAYERS if name in layers]
    return Tile(
        tile_id,
        grid,
        tuple(Layer(name, (f"{name}/{tile_id}.tif",), extents=(grid.bounds,)) for name in names),
        str(folder.resolve()),
        date.astimezone(UTC) if date else datetime.now(UTC),
        datetime_assumed=date is None,
        stratum=stratum,
        dataset=dataset,
    )


def with_neighbours(tiles: Iterable[Tile]) -> list[Tile]:
    """Return tiles of one folder, results of `write_tile`, with the files of their neighbours.

    A tile's layers list its own file first, then the files of tiles within `REACH_M` with the same dataset,
    CRS and cell size. Tiles that overlap are different surveys of the same ground, and do not list each
    other's files. The tiles are ordered by their ids.
    """
    ordered = sorted(tiles, key=lambda tile: tile.id)
    groups: dict[tuple[str, float, str], list[Tile]] = {}
    for tile in ordered:
        groups.setdefault((tile.grid.crs, tile.grid.cell, tile.dataset), []).append(tile)
    near = {tile.id: [tile] for tile in ordered}
    for (_, cell, _), group in groups.items():
        bounds = [tile.grid.bounds for tile in group]
        reached = np.array([tile.grid.buffered(REACH_M).bounds for tile in group])
        tree = shapely.STRtree(shapely.box(*np.array(bounds).T))
        for one, other in sorted(tree.query(shapely.box(*reached.T)).T.tolist()):
            if not overlap(bounds[one], bounds[other], LATTICE_TOLERANCE * cell):
                near[group[one].id].append(group[other])
    return [_joined(near[tile.id]) for tile in ordered]


def _write(path: Path, grid: Grid, name: str, array: NDArray[Any], tags: Mapping[str, str]) -> None:
    bands, profile = (array != 0).astype(np.uint8)[None], dict[str, Any]()
    if name == PHOTO:
        bands, profile = array, {"photometric": "RGB", "interleave": "pixel", "predictor": 2}
    elif name in HEIGHTS:
        bands, profile = array.astype(np.float32)[None], {"nodata": np.nan, "predictor": 3}
    count, height, width = bands.shape
    if name == PHOTO:
        grid = Grid(grid.crs, grid.west, grid.north, grid.width * grid.cell / width, width, height)
    # Encoded in memory: when GDAL closes a file on a full disk, it does not raise an error.
    with MemoryFile() as memory:
        try:
            with memory.open(
                driver="GTiff",
                width=width,
                height=height,
                count=count,
                dtype=bands.dtype,
                crs=CRS.from_string(grid.crs),
                transform=grid.transform,
                compress="deflate",
                **profile,
            ) as dataset:
                dataset.write(bands)
                dataset.update_tags(**tags)
            write(path, memory.getbuffer())
        except (OSError, CRSError) as error:
            raise CatalogError(f"cannot write {path}: {write_reason(error)}") from error


def _joined(tiles: Sequence[Tile]) -> Tile:
    """Return the first tile with the files of all tiles."""
    layers = []
    for name in LAYERS:
        parts = [layer for layer in (tile.layer(name) for tile in tiles) if layer]
        if parts:
            files = tuple(chain.from_iterable(part.files for part in parts))
            layers.append(replace(parts[0], files=files, extents=tuple(part.extents[0] for part in parts)))
    covering, nearby = by_cover(layers, tiles[0].grid)
    return replace(tiles[0], layers=covering, nearby=nearby)
