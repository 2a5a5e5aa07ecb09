"""Vector files of roads, named by the tiles they reach: any format GDAL reads, wherever the file lies."""

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
    """What one opening of a file told."""

    path: Path
    """Absolute."""
    has_crs: bool
    """False if the file carries no CRS and the caller's stands in."""
    extents: tuple[tuple[str, Bounds], ...] | None
    """CRS and bounds of each layer with features, or None where only reading all of them would tell."""


def find(root: Path, given: str, crs: str | None) -> list[VectorFile]:
    """Open vector files.

    Parameters
    ----------
    root : Path
        The folder of the catalog's rasters.
    given : str
        A file, or a glob pattern relative to ``root``.
    crs : str, optional
        CRS of files that carry none.

    Raises
    ------
    CatalogError
        If there is no such file, or one is no vector file or has no CRS.
    """
    paths = [Path(given)] if Path(given).is_file() else matching(root.resolve(), "roads", given)
    return [opened(path, crs) for path in paths]


def opened(path: Path, crs: str | None) -> VectorFile:
    """Open one vector file.

    Raises
    ------
    CatalogError
        If it is no vector file, or has no CRS and ``crs`` is None.
    """
    import pyogrio

    try:
        names = [name for name, kind in pyogrio.list_layers(path) if kind is not None]
        infos = [pyogrio.read_info(path, layer=name) for name in names]
        # OSM's own format knows its bounds only after all of it was read.
        far = any(info["driver"] == "OSM" for info in infos)
        if not far:
            infos = [pyogrio.read_info(path, layer=name, force_total_bounds=True) for name in names]
    except (RuntimeError, ValueError) as error:
        raise CatalogError(f"--roads {path} is no vector file: {error}") from error
    if not infos:
        raise CatalogError(f"--roads {path} is no vector file: it has no layer with geometries")
    has_crs = all(info["crs"] for info in infos)
    if not has_crs and crs is None:
        raise CatalogError(
            f"--roads {path} carries no CRS; say which it is with --crs, or give it one with ogr2ogr -a_srs"
        )
    # An empty layer has no bounds.
    extents = tuple(
        (info["crs"] or str(crs), tuple(info["total_bounds"]))
        for info in infos
        if info["total_bounds"] is not None
    )
    return VectorFile(path.resolve(), has_crs, None if far else extents)


def with_roads(tiles: Sequence[Tile], files: Sequence[VectorFile], crs: str | None) -> tuple[Tile, ...]:
    """Return the tiles with the files that come within `REACH_M` of each as its layer ``roads``.

    Raises
    ------
    CatalogError
        If a file reaches no tile.
    """
    reached = [_reached(file, tiles) for file in files]
    for file, reaches in zip(files, reached, strict=True):
        if not reaches.any():
            raise CatalogError(f"--roads {file.path} reaches no tile; check its CRS and its place")
    return tuple(
        _named(tile, [file for file, reaches in zip(files, reached, strict=True) if reaches[i]], crs)
        for i, tile in enumerate(tiles)
    )


def _reached(file: VectorFile, tiles: Sequence[Tile]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return the tiles near the file, ``(n,)``; all where it does not tell its bounds."""
    if file.extents is None:
        return np.ones(len(tiles), bool)
    near = np.zeros(len(tiles), bool)
    for target in {tile.grid.crs for tile in tiles}:
        here = np.array([tile.grid.crs == target for tile in tiles])
        grown = shapely.box(*np.array([tile.grid.buffered(REACH_M).bounds for tile in tiles]).T)
        for crs, bounds in file.extents:
            box = _box(crs, target, bounds)
            # Bounds that have no place in the tiles' CRS may be wider than what lies near the tiles.
            near |= here & (shapely.intersects(grown, box) if box else True)
    return near


def _box(crs: str, target: str, bounds: Bounds) -> shapely.Polygon | None:
    try:
        placed = transformer(crs, target).transform_bounds(*bounds, densify_pts=21)
    except ProjError:
        return None
    return shapely.box(*placed) if np.isfinite(placed).all() else None


def _named(tile: Tile, files: Sequence[VectorFile], crs: str | None) -> Tile:
    if not files:
        return tile
    root = Path(tile.root)
    names = tuple(
        file.path.relative_to(root).as_posix() if file.path.is_relative_to(root) else str(file.path)
        for file in files
    )
    bare = any(not file.has_crs for file in files)
    return replace(tile, layers=(*tile.layers, Layer("roads", names, crs=crs if bare else None)))
