"""The folder FlexRoad's own makers write: ``FOLDER/<layer>/<tile id>.tif``, one GeoTIFF a layer and tile.

Both directions stand here, so that no other file need know the layout. Tile, layer, stratum and date
travel as tags inside the files; names of files are for people. Heights are float32, which is exact to
0.03 mm below 512 m and to 0.5 mm anywhere on Earth; NaN is nodata. Masks are 1 where there is road. The
orthophoto has pixels of its own size over the same ground.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.crs import CRS
from rasterio.errors import CRSError, RasterioIOError

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Grid
from flexroad.catalog.tile import LAYERS, Layer, Tile

HEIGHTS = ("dsm", "dtm", "reference")
MASKS = ("road_mask", "reference_road")
PHOTO = "dop"
KNOWN = (*HEIGHTS, *MASKS, PHOTO)

TILE_TAG, LAYER_TAG, STRATUM_TAG = "FLEXROAD_TILE", "FLEXROAD_LAYER", "FLEXROAD_STRATUM"
DATASET_TAG = "FLEXROAD_DATASET"
DATE_TAG, DATE_FORMAT = "TIFFTAG_DATETIME", "%Y:%m:%d %H:%M:%S"
"""TIFF knows no time zone: ours is UTC."""


def write_tile(
    folder: Path,
    tile_id: str,
    grid: Grid,
    layers: Mapping[str, NDArray[Any]],
    stratum: str = "",
    date: datetime | None = None,
    dataset: str = "",
) -> None:
    """Write a tile's layers; files already there are replaced, each at once.

    Parameters
    ----------
    folder : Path
        Where the layers' folders are or will be.
    tile_id : str
        The tile's id, unique in the folder.
    grid : Grid
        The cells of every layer but ``dop``.
    layers : mapping of str to (H, W) array
        By layer name: heights (m) as ``dsm``, ``dtm`` and ``reference``, masks as ``road_mask`` and
        ``reference_road``, red, green and blue (uint8) as ``dop``, ``(3, h, w)`` over the grid's bounds.
    stratum : str
        Class of area for reports.
    date : datetime, optional
        When the data was taken, with a time zone.
    dataset : str
        What reports call the data.

    Raises
    ------
    CatalogError
        If a layer is unknown here or does not fit the grid, if the id makes no file name, or if the CRS or
        the folder does not do.
    """
    if not tile_id or Path(tile_id).name != tile_id:
        raise CatalogError(f"tile id {tile_id!r} makes no file name in {folder}; leave out slashes")
    tags = {TILE_TAG: tile_id, STRATUM_TAG: stratum, DATASET_TAG: dataset}
    if date is not None:
        tags[DATE_TAG] = date.astimezone(UTC).strftime(DATE_FORMAT)
    for name, array in layers.items():
        _check(name, array, grid, tile_id)
    for name, array in layers.items():
        _write(folder / name / f"{tile_id}.tif", grid, name, array, {**tags, LAYER_TAG: name})


def index(folder: Path) -> list[Tile]:
    """Return the tiles whose layers lie in a folder that `write_tile` filled, in the order of their ids.

    Raises
    ------
    CatalogError
        If there is no layer, if a file is no GeoTIFF or lacks its tags, or if the files of a tile
        contradict each other.
    """
    root = folder.resolve()
    files = [path for name in LAYERS for path in sorted((root / name).glob("*.tif"))]
    if not files:
        raise CatalogError(f"no LAYER/*.tif in {folder} with LAYER one of {', '.join(KNOWN)}")
    by_id: dict[str, list[_File]] = {}
    for path in files:
        file = _read(path)
        by_id.setdefault(file.tile_id, []).append(file)
    return [_tile(by_id[tile_id], root) for tile_id in sorted(by_id)]


@dataclass(frozen=True)
class _File:
    """What one file says about itself."""

    path: Path
    tile_id: str
    layer: str
    stratum: str
    dataset: str
    date: datetime | None
    grid: Grid


def _check(name: str, array: NDArray[Any], grid: Grid, tile_id: str) -> None:
    if name not in KNOWN:
        raise CatalogError(f"no layer {name!r} in a prepared folder; known are {', '.join(KNOWN)}")
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
    """Return what a file holds, ``(bands, H, W)``, and how it is kept."""
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
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with rasterio.open(
            temporary,
            "w",
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
        temporary.replace(path)
    except (OSError, RasterioIOError, CRSError) as error:
        # GDAL's own reason is the cause of rasterio's.
        raise CatalogError(f"cannot write {path}: {error.__cause__ or error}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _read(path: Path) -> _File:
    try:
        with rasterio.open(path) as dataset:
            tags, transform, crs = dataset.tags(), dataset.transform, dataset.crs
            width, height = dataset.width, dataset.height
    except RasterioIOError as error:
        raise CatalogError(f"{path} is no GeoTIFF: {error}") from error
    missing = [tag for tag in (TILE_TAG, LAYER_TAG) if not tags.get(tag)]
    if missing or crs is None:
        lack = ", ".join(missing) or "CRS"
        raise CatalogError(f"{path} carries no {lack}; it was not made by FlexRoad, catalog it as rasters")
    cell = transform.a
    if (transform.b, transform.d, transform.e) != (0, 0, -cell):
        raise CatalogError(f"{path} has no square north-up cells: {tuple(transform)[:6]}; write it anew")
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
            f"{path} has {DATE_TAG} {tag!r}, not YYYY:MM:DD HH:MM:SS; write it anew"
        ) from error


def _tile(files: Iterable[_File], root: Path) -> Tile:
    """Return the tile that files of one id make; the files come in the order of `LAYERS`."""
    files = list(files)
    first = next((file for file in files if file.layer != PHOTO), None)
    if first is None:
        raise CatalogError(
            f"{files[0].path} is all there is of tile {files[0].tile_id}; a tile needs heights"
        )
    by_layer: dict[str, _File] = {}
    for file in files:
        if file.layer in by_layer:
            raise CatalogError(
                f"{by_layer[file.layer].path} and {file.path} both say they are layer {file.layer} "
                f"of tile {file.tile_id}; remove one"
            )
        _check_alike(first, file)
        by_layer[file.layer] = file
    date = first.date or datetime.fromtimestamp(first.path.stat().st_mtime, UTC)
    return Tile(
        id=first.tile_id,
        grid=first.grid,
        layers=tuple(
            Layer(name, (by_layer[name].path.relative_to(root).as_posix(),))
            for name in LAYERS
            if name in by_layer
        ),
        root=str(root),
        datetime=date,
        datetime_assumed=first.date is None,
        stratum=first.stratum,
        dataset=first.dataset,
    )


def _check_alike(first: _File, file: _File) -> None:
    """Refuse files that contradict each other about their tile."""
    for what in ("grid", "stratum", "dataset"):
        mine, other = getattr(first, what), getattr(file, what)
        if what == "grid" and file.layer == PHOTO and _same_ground(mine, other):
            continue
        if mine != other:
            raise CatalogError(
                f"{first.path} and {file.path} of tile {file.tile_id} differ in {what}: "
                f"{mine} and {other}; write the tile anew"
            )


def _same_ground(one: Grid, other: Grid) -> bool:
    return one.crs == other.crs and np.allclose(one.bounds, other.bounds, rtol=0, atol=1e-3)
