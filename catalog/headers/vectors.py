"""Vector files of roads, in any format that GDAL reads, and the tiles that they reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely
from pyproj.exceptions import ProjError

from flexroad.catalog.crs import transformer
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.headers.rasters import matching
from flexroad.catalog.tile import REACH_M, Layer, Tile


@dataclass(frozen=True)
class VectorFile:
    """The header of a vector file."""

    path: Path
    """Absolute."""
    has_crs: bool
    """False if the file has no CRS and the caller's is used."""
    extents: tuple[tuple[str, Bounds], ...] | None
    """CRS and bounds of each layer with features, or None if the format does not store them."""


def find(root: Path, given: str, crs: str | None) -> list[VectorFile]:
    """Open vector files.

    Parameters
    ----------
    root : Path
        The folder of the catalog's rasters.
    given : str
        A file, or a glob pattern relative to ``root``.
    crs : str, optional
        CRS of files without one.

    Raises
    ------
    CatalogError
        If there is no such file, or a file is not a vector file or has no CRS.
    """
    paths = [Path(given)] if Path(given).is_file() else matching(root.resolve(), "roads", given)
    return [opened(path, crs) for path in paths]


def opened(path: Path, crs: str | None) -> VectorFile:
    """Open one vector file.

    Raises
    ------
    CatalogError
        If it is not a vector file, or has no CRS and ``crs`` is None.
    """
    import pyogrio

    try:
        names = [name for name, kind in pyogrio.list_layers(path) if kind is not None]
        infos = [pyogrio.read_info(path, layer=name) for name in names]
        # The bounds of an OSM file are known only after reading all of it.
        no_bounds = any(info["driver"] == "OSM" for info in infos)
        if not no_bounds:
            infos = [pyogrio.read_info(path, layer=name, force_total_bounds=True) for name in names]
    except (RuntimeError, ValueError) as error:
        raise CatalogError(f"--roads {path} is not a vector file: {error}") from error
    if not infos:
        raise CatalogError(f"--roads {path} is not a vector file: it has no layer with geometries")
    has_crs = all(info["crs"] for info in infos)
    if not has_crs and crs is None:
        raise CatalogError(
            f"--roads {path} has no CRS; give it with --crs, or add it to the file with ogr2ogr -a_srs"
        )
    # An empty layer has no bounds.
    extents = tuple(
        (info["crs"] or str(crs), tuple(info["total_bounds"]))
        for info in infos
        if info["total_bounds"] is not None
    )
    return VectorFile(path.resolve(), has_crs, None if no_bounds else extents)


def with_roads(tiles: Sequence[Tile], files: Sequence[VectorFile], crs: str | None) -> tuple[Tile, ...]:
    """Return the tiles with a layer ``roads`` of the files within `REACH_M` of each tile.

    Raises
    ------
    CatalogError
        If a file reaches no tile.
    """
    reached = [_reached(file, tiles) for file in files]
    for file, reaches in zip(files, reached, strict=True):
        if not reaches.any():
            raise CatalogError(f"--roads {file.path} reaches no tile; check its CRS and its extent")
    return tuple(
        _with_layer(tile, [file for file, reaches in zip(files, reached, strict=True) if reaches[i]], crs)
        for i, tile in enumerate(tiles)
    )


def _reached(file: VectorFile, tiles: Sequence[Tile]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which tiles are near the file, ``(n,)``; all of them if the file has no bounds."""
    if file.extents is None:
        return np.ones(len(tiles), bool)
    near = np.zeros(len(tiles), bool)
    for target in {tile.grid.crs for tile in tiles}:
        in_target = np.array([tile.grid.crs == target for tile in tiles])
        grown = shapely.box(*np.array([tile.grid.buffered(REACH_M).bounds for tile in tiles]).T)
        for crs, bounds in file.extents:
            box = _box(crs, target, bounds)
            # Bounds that cannot be transformed may still hold features near the tiles.
            near |= in_target & (shapely.intersects(grown, box) if box else True)
    return near


def _box(crs: str, target: str, bounds: Bounds) -> shapely.Polygon | None:
    try:
        placed = transformer(crs, target).transform_bounds(*bounds, densify_pts=21)
    except ProjError:
        return None
    return shapely.box(*placed) if np.isfinite(placed).all() else None


def _with_layer(tile: Tile, files: Sequence[VectorFile], crs: str | None) -> Tile:
    if not files:
        return tile
    root = Path(tile.root)
    names = tuple(
        file.path.relative_to(root).as_posix() if file.path.is_relative_to(root) else str(file.path)
        for file in files
    )
    bare = any(not file.has_crs for file in files)
    return replace(tile, layers=(*tile.layers, Layer("roads", names, crs=crs if bare else None)))
