"""Folders written by FlexRoad itself: ``FOLDER/<layer>/<tile id>.tif``, one GeoTIFF per layer and tile.

This module both writes and reads them. Tile id, layer, stratum and date are stored as tags in the files;
file names are never parsed. Heights are float32, which is exact to 0.03 mm below 512 m and to 0.5 mm anywhere
on Earth; NaN is nodata. Masks are 1 where there is road. The orthophoto has its own pixel size over the same
bounds.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
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
from flexroad.catalog.headers.open_raster import ERRORS, open_raster
from flexroad.catalog.storage.paths import write
from flexroad.catalog.text import write_reason
from flexroad.catalog.tile import LAYERS, REACH_M, Layer, Tile, by_cover

HEIGHTS = ("dsm", "dtm", "road_height", "reference")
MASKS = ("road_mask", "reference_road")
PHOTO = "dop"
SUPPORTED = (*HEIGHTS, *MASKS, PHOTO)

TILE_TAG, LAYER_TAG, STRATUM_TAG = "FLEXROAD_TILE", "FLEXROAD_LAYER", "FLEXROAD_STRATUM"
DATASET_TAG = "FLEXROAD_DATASET"
DATE_TAG, DATE_FORMAT = "TIFFTAG_DATETIME", "%Y:%m:%d %H:%M:%S"
"""TIFF dates have no time zone; they are written and read as UTC."""


def write_tile(
    folder: Path,
    tile_id: str,
    grid: Grid,
    layers: Mapping[str, NDArray[Any]],
    stratum: str = "",
    date: datetime | None = None,
    dataset: str = "",
) -> None:
    """Write a tile's layers; existing files are replaced, each atomically.

    Parameters
    ----------
    folder : Path
        Parent of the layers' folders.
    tile_id : str
        The tile's id, unique in the folder.
    grid : Grid
        Grid of every layer but ``dop``.
    layers : mapping of str to (H, W) array
        Arrays by layer name: heights (m) as ``dsm``, ``dtm``, ``road_height`` and ``reference``, masks as
        ``road_mask`` and ``reference_road``, red, green and blue (uint8) as ``dop``, ``(3, h, w)`` over the
        grid's bounds.
    stratum : str
        Class of area for reports.
    date : datetime, optional
        Date of the survey, with a time zone.
    dataset : str
        Name of the data in reports.

    Raises
    ------
    CatalogError
        If a layer is not supported or does not fit the grid, the id is not a valid file name, the CRS is
        invalid, or the folder cannot be written.
    """
    if not tile_id or Path(tile_id).name != tile_id:
        raise CatalogError(f"tile id {tile_id!r} is not a valid file name in {folder}; leave out slashes")
    tags = {TILE_TAG: tile_id, STRATUM_TAG: stratum, DATASET_TAG: dataset}
    if date is not None:
        tags[DATE_TAG] = date.astimezone(UTC).strftime(DATE_FORMAT)
    for name, array in layers.items():
        _check(name, array, grid, tile_id)
    for name, array in layers.items():
        _write(folder / name / f"{tile_id}.tif", grid, name, array, {**tags, LAYER_TAG: name})


def index(folder: Path, only: Container[str] | None = None) -> list[Tile]:
    """Return the tiles of a folder written by `write_tile`, in the order of their ids.

    A tile's layers list its own file first, then those of the tiles of the same dataset, CRS and cell size
    that lie within `REACH_M` of it. Tiles that overlap are other surveys of the same ground, and do not list
    each other's files.

    Parameters
    ----------
    folder : Path
        Parent of the layers' folders.
    only : container of str, optional
        Ids of the tiles to return; other tiles in the folder are left out, as neighbours as well.

    Raises
    ------
    CatalogError
        If there is no layer, a file is not a GeoTIFF or lacks its tags, or the files of a tile contradict
        each other.
    """
    root = folder.resolve()
    files = [path for name in LAYERS for path in sorted((root / name).glob("*.tif"))]
    if not files:
        raise CatalogError(f"no LAYER/*.tif in {folder} with LAYER one of {', '.join(SUPPORTED)}")
    by_id: dict[str, list[_File]] = {}
    for path in files:
        file = _read(path)
        if only is None or file.tile_id in only:
            by_id.setdefault(file.tile_id, []).append(file)
    return _with_neighbours([_tile(by_id[tile_id], root) for tile_id in sorted(by_id)])


@dataclass(frozen=True)
class _File:
    """The header and tags of one file."""

    path: Path
    tile_id: str
    layer: str
    stratum: str
    dataset: str
    date: datetime | None
    grid: Grid


def _check(name: str, array: NDArray[Any], grid: Grid, tile_id: str) -> None:
    if name not in SUPPORTED:
        raise CatalogError(f"no layer {name!r} in a prepared folder; layers are {', '.join(SUPPORTED)}")
    if name == PHOTO:
        fits = array.ndim == 3 and len(array) == 3 and array.dtype == np.uint8
        if not fits or array.shape[1] * grid.width != array.shape[2] * grid.height:
            raise CatalogError(
                f"layer dop of tile {tile_id} is {array.shape} of {array.dtype}, not 3 x h x w of uint8 "
                f"with square pixels over {grid.width} x {grid.height} cells"
            )
    elif array.shape != grid.shape:
        raise CatalogError(f"layer {name} of tile {tile_id} is {array.shape}, but its grid is {grid.shape}")


def _bands(name: str, array: NDArray[Any]) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return the bands of a file, ``(bands, H, W)``, and its creation options."""
    if name == PHOTO:
        return array, {"photometric": "RGB", "interleave": "pixel", "predictor": 2}
    if name in HEIGHTS:
        return array.astype(np.float32)[None], {"nodata": np.nan, "predictor": 3}
    return (array != 0).astype(np.uint8)[None], {}


def _write(path: Path, grid: Grid, name: str, array: NDArray[Any], tags: Mapping[str, str]) -> None:
    bands, profile = _bands(name, array)
    count, height, width = bands.shape
    if name == PHOTO:
        grid = Grid(grid.crs, grid.west, grid.north, grid.width * grid.cell / width, width, height)
    # Encoded in memory: GDAL does not raise an error where a disk is full when it closes a file.
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


def _read(path: Path) -> _File:
    try:
        with open_raster(path) as dataset:
            tags, transform, crs = dataset.tags(), dataset.transform, dataset.crs
            width, height = dataset.width, dataset.height
    except ERRORS as error:
        raise CatalogError(f"{path} is not a GeoTIFF: {error}") from error
    missing = [tag for tag in (TILE_TAG, LAYER_TAG) if not tags.get(tag)]
    if missing or crs is None:
        lack = ", ".join(missing) or "CRS"
        raise CatalogError(f"{path} has no {lack}; FlexRoad did not write it, so catalog it as rasters")
    cell = transform.a
    if (transform.b, transform.d, transform.e) != (0, 0, -cell):
        raise CatalogError(f"{path} has no square north-up cells: {tuple(transform)[:6]}; write it again")
    return _File(
        path=path,
        tile_id=tags[TILE_TAG],
        layer=tags[LAYER_TAG],
        stratum=tags.get(STRATUM_TAG, ""),
        dataset=tags.get(DATASET_TAG, ""),
        date=_date(path, tags.get(DATE_TAG)),
        grid=Grid(crs.to_string(), transform.c, transform.f, cell, width, height),
    )


def _date(path: Path, tag: str | None) -> datetime | None:
    if tag is None:
        return None
    try:
        return datetime.strptime(tag, DATE_FORMAT).replace(tzinfo=UTC)
    except ValueError as error:
        raise CatalogError(
            f"{path} has {DATE_TAG} {tag!r}, not YYYY:MM:DD HH:MM:SS; write it again"
        ) from error


def _tile(files: Iterable[_File], root: Path) -> Tile:
    """Return the tile made of the files of one id, given in the order of `LAYERS`."""
    files = list(files)
    first = next((file for file in files if file.layer != PHOTO), None)
    if first is None:
        raise CatalogError(
            f"{files[0].path} is the only file of tile {files[0].tile_id}; a tile needs heights"
        )
    by_layer: dict[str, _File] = {}
    for file in files:
        if file.layer in by_layer:
            raise CatalogError(
                f"{by_layer[file.layer].path} and {file.path} are both tagged as layer {file.layer} "
                f"of tile {file.tile_id}; remove one"
            )
        _check_same_tile(first, file)
        by_layer[file.layer] = file
    date = first.date or datetime.fromtimestamp(first.path.stat().st_mtime, UTC)
    return Tile(
        id=first.tile_id,
        grid=first.grid,
        layers=tuple(
            Layer(name, (by_layer[name].path.relative_to(root).as_posix(),), extents=(first.grid.bounds,))
            for name in LAYERS
            if name in by_layer
        ),
        root=str(root),
        datetime=date,
        datetime_assumed=first.date is None,
        stratum=first.stratum,
        dataset=first.dataset,
    )


def _check_same_tile(first: _File, file: _File) -> None:
    """Raise an error if two files of a tile differ in grid, stratum or dataset."""
    for name in ("grid", "stratum", "dataset"):
        expected, value = getattr(first, name), getattr(file, name)
        if name == "grid" and file.layer == PHOTO and _same_bounds(expected, value):
            continue
        if expected != value:
            raise CatalogError(
                f"{first.path} and {file.path} of tile {file.tile_id} differ in {name}: "
                f"{expected} and {value}; write the tile again"
            )


def _same_bounds(a: Grid, b: Grid) -> bool:
    return a.crs == b.crs and np.allclose(a.bounds, b.bounds, rtol=0, atol=1e-3)


def _with_neighbours(tiles: Sequence[Tile]) -> list[Tile]:
    """Return the tiles, given with their own files, with the files of their neighbours."""
    groups: dict[tuple[str, float, str], list[Tile]] = {}
    for tile in tiles:
        groups.setdefault((tile.grid.crs, tile.grid.cell, tile.dataset), []).append(tile)
    near = {tile.id: [tile] for tile in tiles}
    for (_, cell, _), group in groups.items():
        bounds = [tile.grid.bounds for tile in group]
        reached = np.array([tile.grid.buffered(REACH_M).bounds for tile in group])
        tree = shapely.STRtree(shapely.box(*np.array(bounds).T))
        for one, other in sorted(tree.query(shapely.box(*reached.T)).T.tolist()):
            if not overlap(bounds[one], bounds[other], LATTICE_TOLERANCE * cell):
                near[group[one].id].append(group[other])
    return [_joined(near[tile.id]) for tile in tiles]


def _joined(tiles: Sequence[Tile]) -> Tile:
    """Return the first tile with the files of all of them."""
    layers = []
    for name in LAYERS:
        parts = [layer for layer in (tile.layer(name) for tile in tiles) if layer]
        if parts:
            files = tuple(chain.from_iterable(part.files for part in parts))
            layers.append(replace(parts[0], files=files, extents=tuple(part.extents[0] for part in parts)))
    covering, nearby = by_cover(layers, tiles[0].grid)
    return replace(tiles[0], layers=covering, nearby=nearby)
