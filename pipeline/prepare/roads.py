"""Roads that the user has, as a mask: polygons of any vector file, a raster, or a mesh seen from above."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.errors import RasterioError
from rasterio.features import rasterize
from rasterio.warp import Resampling, reproject

from catalog import Grid
from catalog.crs import short
from catalog.frame import Frame
from pipeline.errors import ConfigError
from pipeline.prepare.asked import Asked
from pipeline.prepare.sheet import Sheet
from tasks.types import Bools

MESHES = (".obj", ".ply", ".glb", ".gltf")
AREAS = ("Polygon", "MultiPolygon")


def add_roads(sheet: Sheet, asked: Asked) -> None:
    """Write the road mask of a sheet, if roads were given.

    Raises
    ------
    ConfigError
        If the roads cannot be read, or none lies on the sheet.
    """
    if asked.roads is not None:
        mask = burn(asked.roads, asked.roads_layer, asked.roads_where, sheet.grid)
        sheet.write("road_mask", sheet.grid, mask)


def burn(path: Path, layer: str | None, where: str | None, grid: Grid) -> Bools:
    """Return the cells whose centre is road, ``(H, W)``.

    Parameters
    ----------
    path : Path
        Polygons in any format GDAL reads; a raster that is not 0 on roads; or a mesh of the roads.
    layer : str, optional
        Layer of a vector file with several.
    where : str, optional
        Which features, in SQL: ``class = 'road'``.
    grid : Grid
        The cells.

    Raises
    ------
    ConfigError
        If the file cannot be read, holds lines, or has no road on the grid.
    """
    if not path.exists():
        raise ConfigError(f"--roads {path} does not exist")
    if path.suffix.lower() in MESHES:
        mask = _mesh(path, grid)
    else:
        mask = _raster(path, grid)
        if mask is None:
            mask = _polygons(path, layer, where, grid)
    if not mask.any():
        bounds = ", ".join(f"{edge:.0f}" for edge in grid.bounds)
        raise ConfigError(
            f"no road of {path} lies in the area ({bounds} in {short(grid.crs)}); check the CRS of both"
        )
    return mask


def _mesh(path: Path, grid: Grid) -> Bools:
    from tasks.acquire.mesh import cover, in_metres
    from tasks.acquire.mesh_files import read_mesh

    mesh = read_mesh(path, colours=False)
    return cover(in_metres(mesh, Frame.of(mesh.crs, mesh.bounds[:2], grid.crs)), grid)


def _raster(path: Path, grid: Grid) -> Bools | None:
    """Return the mask if the file is a raster, else None."""
    try:
        with rasterio.open(path) as source:
            if source.count == 0 or source.crs is None:
                return None
            mask = np.zeros(grid.shape, np.uint8)
            reproject(
                (source.read(1, masked=True).filled(0) != 0).astype(np.uint8),
                mask,
                src_transform=source.transform,
                src_crs=source.crs,
                dst_transform=grid.transform,
                dst_crs=grid.crs,
                resampling=Resampling.nearest,
            )
    except RasterioError:
        return None
    return mask != 0


def _polygons(path: Path, layer: str | None, where: str | None, grid: Grid) -> Bools:
    features = _read(path, layer, where)
    if features.crs is None:
        raise ConfigError(f"{path} carries no CRS; give it one, e.g. ogr2ogr -a_srs {short(grid.crs)}")
    features = features[~(features.geometry.isna() | features.geometry.is_empty)].to_crs(grid.crs)
    kinds = sorted(set(features.geom_type) - set(AREAS))
    if kinds:
        raise ConfigError(
            f"{path} holds {kinds[0]}s where polygons of roads are wanted; give their layer with "
            "--roads-layer, choose them with --roads-where, or buffer the lines by half the roads' width"
        )
    if features.empty:
        return np.zeros(grid.shape, bool)
    burnt: Any = rasterize(features.geometry, out_shape=grid.shape, transform=grid.transform, dtype=np.uint8)
    return np.asarray(burnt != 0)


def _read(path: Path, layer: str | None, where: str | None) -> Any:
    import geopandas
    from pyogrio import list_layers
    from pyogrio.errors import DataLayerError, DataSourceError

    try:
        names = list(list_layers(path)[:, 0])
        if layer is None and len(names) > 1:
            raise ConfigError(f"{path} has several layers: {', '.join(names)}; name one with --roads-layer")
        if layer is not None and layer not in names:
            raise ConfigError(f"{path} has no layer {layer!r}; there are {', '.join(names)}")
        found = geopandas.read_file(path, layer=layer or names[0], where=where)
    except (DataSourceError, DataLayerError, ValueError) as error:
        raise ConfigError(
            f"--roads {path} cannot be read as polygons, raster or mesh: {error}; check --roads-where, too"
        ) from error
    if found.empty:
        chosen = f" where {where}" if where else ""
        raise ConfigError(f"{path} has no feature{chosen} in layer {layer or names[0]!r}")
    return found
