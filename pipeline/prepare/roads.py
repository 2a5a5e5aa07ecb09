"""Roads that the user has, as a mask: polygons of any vector file, a raster, or a mesh seen from above.

Lines have no width of their own: they go into the catalog as they are, for ``segment: vector``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from rasterio.errors import RasterioError
from rasterio.warp import Resampling, reproject

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.crs import short
from flexroad.catalog.headers.vectors import VectorFile, opened
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.sheet import Sheet
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.types import Bools

MESHES = (".obj", ".ply", ".glb", ".gltf")
AREAS = ("Polygon", "MultiPolygon")
LINES = ("LineString", "MultiLineString")


def add_roads(sheet: Sheet, asked: Asked) -> bool:
    """Write the road mask of a sheet, if roads were given, and name them in its catalog if they are vectors.

    Returns
    -------
    bool
        Whether there is a road mask now: not without roads, nor from lines.

    Raises
    ------
    ConfigError
        If the roads cannot be read, or none lies on the sheet.
    """
    if asked.roads is None:
        return False
    mask = burn(asked.roads, asked.roads_layer, asked.roads_where, sheet.grid)
    if mask is not None:
        sheet.write("road_mask", sheet.grid, mask)
    vectors = _vectors(asked.roads)
    if vectors is not None:
        sheet.attach_roads(vectors, *([] if mask is not None else [_of_lines(asked)]))
    return mask is not None


def _vectors(path: Path) -> VectorFile | None:
    """Return what a vector file tells, or None if it is none."""
    try:
        return opened(path, None)
    except CatalogError:
        return None


def _of_lines(asked: Asked) -> str:
    told = {"layer": asked.roads_layer, "where": asked.roads_where}
    chosen = "".join(f", {name}: {json.dumps(text)}" for name, text in told.items() if text)
    return (
        f"{asked.roads} holds lines, so there is no road mask; run with a configuration that has "
        f"segment: {{method: vector{chosen}}}"
    )


def burn(path: Path, layer: str | None, where: str | None, grid: Grid) -> Bools | None:
    """Return the cells whose centre is road, ``(H, W)``, or None if the roads are lines.

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
        If the file cannot be read, holds points, or has no road on the grid.
    """
    if not path.exists():
        raise ConfigError(f"--roads {path} does not exist")
    mask = _mesh(path, grid) if path.suffix.lower() in MESHES else _raster(path, grid)
    if mask is None:
        features = _features(path, layer, where, grid)
        if features is None:
            return None
        mask = cells(features.geometry.to_numpy(), grid)
    if not mask.any():
        raise _elsewhere(path, grid)
    return mask


def _elsewhere(path: Path, grid: Grid) -> ConfigError:
    bounds = ", ".join(f"{edge:.0f}" for edge in grid.bounds)
    return ConfigError(
        f"no road of {path} lies in the area ({bounds} in {short(grid.crs)}); check the CRS of both"
    )


def _mesh(path: Path, grid: Grid) -> Bools:
    from flexroad.tasks.acquire.mesh.read import read_mesh
    from flexroad.tasks.acquire.mesh.sample import cover, in_metres

    mesh = read_mesh(path, colours=False)
    return cover(in_metres(mesh, MetricTransform.of(mesh.crs, mesh.bounds[:2], grid.crs)), grid)


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
    road: Bools = mask != 0
    return road


def _features(path: Path, layer: str | None, where: str | None, grid: Grid) -> Any:
    """Return the polygons of a vector file in the grid's CRS, or None if it holds lines."""
    vectors = _vectors(path)
    if vectors is not None and vectors.extents is None and layer is None:
        # OSM's own format, which holds roads mostly as lines, is too much to be read for a look.
        return None
    features = _read(path, layer, where)
    if features.crs is None:
        raise ConfigError(f"{path} carries no CRS; give it one, e.g. ogr2ogr -a_srs {short(grid.crs)}")
    features = features[~(features.geometry.isna() | features.geometry.is_empty)].to_crs(grid.crs)
    kinds = sorted(set(features.geom_type) - {*AREAS, *LINES})
    if kinds:
        raise ConfigError(
            f"{path} holds {kinds[0]}s where polygons or lines of roads are wanted; give their layer with "
            "--roads-layer, or choose them with --roads-where"
        )
    if not set(features.geom_type) & set(LINES):
        return features
    if not features.intersects(shapely.box(*grid.bounds)).any():
        raise _elsewhere(path, grid)
    return None


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
