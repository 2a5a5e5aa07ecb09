"""Road masks from the user's own road data: polygons of a vector file, a raster, or a mesh.

Lines have no width, so they give no mask. Their file is entered in the catalog, for ``segment: vector``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from rasterio.warp import Resampling, reproject

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.crs import short
from flexroad.catalog.crs_checks import angle_fault
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.guard.open_vector import encoding_note, in_its_encoding, vector_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.inputs import MESHES
from flexroad.catalog.scan.rasters import read_valid
from flexroad.catalog.scan.vectors import VectorFile, file_and_layer, one_layer, opened
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import memory
from flexroad.tasks.io.vectors import ENCODING, has_place
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.types import Bools
from flexroad.tools.prepare.mesh.read import read_mesh
from flexroad.tools.prepare.mesh.sample import in_metres, project_down
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.raster_writer import RasterWriter

geopandas = lazy("geopandas")
pyogrio = lazy("pyogrio")

AREAS = ("Polygon", "MultiPolygon")
RASTER_BYTES = 4
"""Memory to read a raster, as a multiple of its values: masked, compared and copied."""
CUT = "cut it to the area, e.g. gdal_translate -projwin"
LINES = ("LineString", "MultiLineString")


def check_roads(common: PrepareOptions) -> None:
    """Check the roads before the long work; for a mesh only check that it exists."""
    if common.roads is None:
        return
    path, layer = file_and_layer(common.roads)
    if not path.exists():
        raise ConfigError(f"--roads {path} does not exist")
    if path.suffix.lower() in MESHES or _is_raster(path) or _osm(path, layer):
        return
    _read(path, layer, common.roads_where, rows=1)


def add_roads(writer: RasterWriter, common: PrepareOptions) -> bool:
    """Write the road mask, if roads were given; a vector file of roads is entered in the catalog, too.

    - result: whether a road mask was written: False without roads, and for lines.
    """
    if common.roads is None:
        return False
    path, layer = file_and_layer(common.roads)
    notes = list[str]()
    mask = burn(path, layer, common.roads_where, writer.grid, notes.append)
    if mask is not None:
        writer.write("road_mask", writer.grid, mask)
    vectors = _vectors(path, layer)
    if vectors is not None:
        if mask is None:
            # The catalog has the layer.
            chosen = f", where: {json.dumps(common.roads_where)}" if common.roads_where else ""
            notes.append(
                f"{path} has lines, so no road mask is made; run with a configuration that has "
                f"segment: {{method: vector{chosen}}}"
            )
        writer.attach_roads(vectors, *notes)
    return mask is not None


def _vectors(path: Path, layer: str | None) -> VectorFile | None:
    """Return the header of a vector file, or None if the file is not a vector file."""
    try:
        return opened(path, None, layer)
    except CatalogError:
        return None


def burn(
    path: Path,
    layer: str | None,
    where: str | None,
    grid: Grid,
    notify: Callable[[str], None] = lambda line: None,
) -> Bools | None:
    """Return the cells whose centre is road, ``(H, W)``, or None if the roads are lines.

    - `path`: polygons in any format GDAL reads; a raster that is not 0 on roads; or a mesh of the roads.
    - `where`: SQL condition that selects features: ``class = 'road'``.
    - `notify`: receives one line about text in another encoding than declared.
    """
    mask = _mesh(path, grid) if path.suffix.lower() in MESHES else _raster(path, grid)
    if mask is None:
        features = _features(path, layer, where, grid, notify)
        if features is None:
            return None
        mask = cells(features.geometry.to_numpy(), grid)
    if not mask.any():
        raise _no_overlap(path, grid)
    return mask


def _no_overlap(path: Path, grid: Grid) -> ConfigError:
    bounds = ", ".join(f"{edge:.0f}" for edge in grid.bounds)
    return ConfigError(
        f"no road of {path} is in the area ({bounds} in {short(grid.crs)}); check the CRS of both"
    )


def _mesh(path: Path, grid: Grid) -> Bools:
    mesh = read_mesh(path, colours=False)
    mesh = in_metres(mesh, MetricTransform.of(mesh.crs, mesh.bounds[:2], grid.crs))
    return project_down(mesh, grid)[1] >= 0


def _is_raster(path: Path) -> bool:
    try:
        with open_raster(path) as source:
            return bool(source.count and source.crs)
    except ERRORS:
        return False


def _raster(path: Path, grid: Grid) -> Bools | None:
    """Return the mask if the file is a raster, else None."""
    try:
        with open_raster(path) as source:
            if source.count == 0 or source.crs is None:
                return None
            needed = RASTER_BYTES * np.dtype(source.dtypes[0]).itemsize * source.width * source.height
            memory.check(
                needed, f"--roads {path}, {source.width:,} x {source.height:,} cells,", CUT, str(path)
            )
            mask = np.zeros(grid.shape, np.uint8)
            reproject(
                (read_valid(source).filled(0) != 0).astype(np.uint8),
                mask,
                src_transform=source.transform,
                src_crs=source.crs,
                dst_transform=grid.transform,
                dst_crs=grid.crs,
                resampling=Resampling.nearest,
            )
    except ERRORS:
        return None
    road: Bools = mask != 0
    return road


def _features(
    path: Path, layer: str | None, where: str | None, grid: Grid, notify: Callable[[str], None]
) -> Any:
    """Return the polygons of a vector file in the grid's CRS; None if it has lines."""
    if _osm(path, layer):
        return None
    features = _read(path, layer, where)
    if encoding := features.attrs.get(ENCODING):
        notify(f"--roads: {encoding_note(path.name, encoding)}")
    features = features[~(features.geometry.isna() | features.geometry.is_empty)].to_crs(grid.crs)
    features = features[has_place(features.geometry.to_numpy())]
    kinds = sorted(set(features.geom_type) - {*AREAS, *LINES})
    if kinds:
        raise ConfigError(
            f"{path} has {kinds[0]}s, but roads must be polygons or lines; select a layer with "
            "FILE|layername=NAME, or features with --roads-where"
        )
    if not set(features.geom_type) & set(LINES):
        return features
    if not features.intersects(shapely.box(*grid.bounds)).any():
        raise _no_overlap(path, grid)
    return None


def _osm(path: Path, layer: str | None) -> bool:
    """Return whether a file is in OSM's own format: it has mostly lines, and is slow to read."""
    vectors = _vectors(path, layer)
    return vectors is not None and vectors.extents is None and layer is None


def _read(path: Path, layer: str | None, where: str | None, rows: int | None = None) -> Any:
    """Return the features of a layer; ``rows`` limits their number."""
    try:
        file = vector_name(path)
        layer = one_layer(f"--roads {path}", path, layer)
        read = partial(geopandas.read_file, file, layer=layer, where=where, rows=rows)
        features, encoding = in_its_encoding(read)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError, ValueError, OSError) as error:
        raise ConfigError(
            f"--roads {path} cannot be read as polygons, raster or mesh: {error}; also check --roads-where"
        ) from error
    if features.crs is None:
        raise ConfigError(f"{path} has no CRS; assign one, e.g. ogr2ogr -a_srs EPSG:25832 NEW.gpkg {path}")
    if angles := angle_fault(features.crs.to_wkt(), tuple(features.total_bounds)):
        raise ConfigError(f"--roads {path} {angles}; declare its CRS with ogr2ogr -a_srs")
    if features.empty:
        condition = f" where {where}" if where else ""
        raise ConfigError(f"{path} has no feature{condition} in layer {layer!r}")
    features.attrs[ENCODING] = encoding
    return features
