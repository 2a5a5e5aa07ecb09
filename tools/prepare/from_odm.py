"""``flexroad prepare``: rasters from an OpenDroneMap project.

The input is the project's surface model and orthophoto, else its textured mesh, else its point cloud.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.enums import ColorInterp, Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.crs import bounds_in
from flexroad.catalog.grid import Bounds
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.scan.rasters import color_kinds, date_of
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.errors import ConfigError
from flexroad.tasks import memory
from flexroad.tasks.types import Floats, Orthophoto
from flexroad.tools.prepare.options import SMALLER, PrepareOptions, prepared_grid, written
from flexroad.tools.prepare.points import ground_filter, tin, to_rasters
from flexroad.tools.prepare.raster_writer import PreparedDataset, RasterWriter
from flexroad.tools.prepare.roads import add_roads, check_roads

DSM, DTM, PHOTO = "odm_dem/dsm.tif", "odm_dem/dtm.tif", "odm_orthophoto/odm_orthophoto.tif"
MESHES = tuple(
    f"{folder}/odm_textured_model_geo.obj"
    for folder in ("odm_texturing", "odm_texturing_25d", "odm_texturing_dem")
)
CLOUDS = tuple(f"odm_georeferencing/odm_georeferenced_model.{kind}" for kind in ("laz", "las"))
BLOCK = 512
"""Side of the windows that are processed one at a time (cells or pixels), to bound the memory."""
FILTER_BYTES = 200
"""Memory of the ground filter per cell of a window and its rim (bytes); measured."""


def found(folder: Path) -> tuple[str, list[Path]]:
    """Return the kind and the path of the input for a project's rasters; ``odm`` is its surface model."""
    for name in (*MESHES, *CLOUDS) if not (folder / DSM).is_file() else ():
        if (folder / name).is_file():
            return "mesh" if name in MESHES else "points", [folder / name]
    return "odm", [folder]


def prepare_odm(
    folder: Path, out: Path, common: PrepareOptions, options: to_rasters.Options, log: Callable[[str], None]
) -> PreparedDataset:
    """Make the rasters and the catalog of an area from the surface model of an OpenDroneMap project.

    - `folder`: the project: the folder that contains ``odm_dem`` and ``odm_orthophoto``.
    - `options`: ground filter and voids if there is no ``dtm.tif``.
    """
    if not (folder / DSM).is_file():
        candidates = ", ".join((DSM, *MESHES, *CLOUDS))
        raise ConfigError(
            f"{folder} has none of {candidates}; give the folder of a finished OpenDroneMap project, "
            "made with its option --dsm"
        )
    check_roads(common)
    has_dtm, photo = (folder / DTM).is_file(), folder / PHOTO
    frame, bounds, date = _frame(folder / DSM, common)
    grid = prepared_grid(bounds, frame.target, common, str(folder / DSM), out, photo=photo.is_file())
    dop_cell = common.dop_cell_m if photo.is_file() else None
    dtm_source = (
        DTM if has_dtm else f"slope-filtered cells of the DSM; voids up to {options.void_m:g} m filled"
    )
    name = folder.resolve().name
    tags = {"SOURCE": f"OpenDroneMap, {name}", "DSM": f"{DSM}, maximum per cell", "DTM": dtm_source}
    with RasterWriter(out, grid, dop_cell, tags, frame.vertical) as writer:
        log(f"resampling {folder / DSM} to {grid.width} x {grid.height} cells")
        _resample_heights(writer, "dsm", folder / DSM, frame, Resampling.max)
        if has_dtm:
            _resample_heights(writer, "dtm", folder / DTM, frame, Resampling.average)
        else:
            log(f"no {DTM}: filtering the ground from the surface model")
            _filter_ground(writer, options)
        if writer.photo_grid is not None:
            log(f"resampling {photo} to {common.dop_cell_m:g} m")
            _resample_photo(writer, photo, frame)
        add_roads(writer, common)
        published = writer.publish(
            common.tile_size_m,
            common.date or date,
            common.dataset or name,
            common.min_cover,
            written([folder / DSM]),
        )
    present = {DTM: has_dtm, PHOTO: dop_cell is not None}
    missing = [f"{folder} has no {name}" for name, exists in present.items() if not exists]
    return published.with_notes(*frame.notes, *missing)


def _frame(dsm: Path, common: PrepareOptions) -> tuple[MetricTransform, Bounds, datetime | None]:
    """Return the transform to metres, the bounds of the surface model (m), and the date from its tags."""
    with _opened(dsm) as source:
        crs = source.crs.to_wkt() if source.crs else common.crs
        if crs is None:
            raise CatalogError(f"{dsm} carries no CRS; give it with --crs, such as --crs EPSG:32632")
        frame = MetricTransform.of(crs, source.bounds[:2], common.to_crs, common.height_unit)
        bounds = bounds_in(frame.target, crs, tuple(source.bounds))
        date = date_of({**source.tags(), **source.tags(ns="IMAGERY")})
    return frame, bounds, date


def _resample_heights(
    writer: RasterWriter, layer: str, path: Path, frame: MetricTransform, reduction: Resampling
) -> None:
    """Write a raster of heights, resampled to the writer's cells by `_warped`."""
    with _opened(path) as source, _warped(source, frame, writer.grid, reduction) as warped:
        for part, window in _windows(writer.grid):
            heights = warped.read(1, window=window, masked=True).astype(np.float64).filled(np.nan)
            writer.write(layer, part, heights * frame.height_m)


def _resample_photo(writer: RasterWriter, path: Path, frame: MetricTransform) -> None:
    grid = writer.photo_grid
    assert grid is not None
    with _opened(path) as source:
        if source.count < 3 or source.dtypes[0] != "uint8":
            raise CatalogError(
                f"{path} does not have three 8-bit bands; move the file away to go on without an orthophoto"
            )
        with _warped(source, frame, grid, Resampling.average) as warped:
            for part, window in _windows(grid):
                valid = warped.dataset_mask(window=window) > 0
                writer.write_photo(Orthophoto(part, warped.read((1, 2, 3), window=window), valid))


def _filter_ground(writer: RasterWriter, options: to_rasters.Options) -> None:
    """Write a DTM made from the DSM: the heights of its ground cells, with voids interpolated."""
    slope = options.filter
    reach = slope.reach_m + tin.voids_reach_m(options.void_m, writer.grid.cell)
    side = BLOCK + 2 * reach / writer.grid.cell
    cells = min(side**2, writer.grid.width * writer.grid.height)
    memory.check(
        FILTER_BYTES * cells, f"the ground filter over {reach:.0f} m of {writer.grid.cell:g} m cells", SMALLER
    )
    for part, _ in _windows(writer.grid):
        rim = _clipped(part.buffered(reach), writer.grid)
        dsm: Floats = writer.read("dsm", rim)
        is_ground = ground_filter.ground_cells(dsm, rim.cell, slope)
        dtm = tin.fill_voids(np.where(is_ground, dsm, np.nan), rim, options.void_m)
        writer.write("dtm", part, dtm[rim.window(part)])


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with open_raster(path) as source:
            yield source
    except ERRORS as error:
        raise CatalogError(f"{path} cannot be read as a raster: {error}; run OpenDroneMap again") from error


def _warped(source: Any, frame: MetricTransform, grid: Grid, reduction: Resampling) -> WarpedVRT:
    """Return a raster resampled to a grid: by ``reduction`` if its cells are smaller, else bilinearly."""
    cell = max(abs(source.transform.a), abs(source.transform.e)) * (frame.plan_m or 1.0)
    return WarpedVRT(
        source,
        src_crs=source.crs or frame.source,
        crs=grid.crs,
        transform=grid.transform,
        width=grid.width,
        height=grid.height,
        resampling=reduction if cell < grid.cell * 1.001 else Resampling.bilinear,
        # The alpha band marks pixels outside the source: they have no colour.
        add_alpha=source.count >= 3
        and source.nodata is None
        and ColorInterp.alpha not in color_kinds(source),
    )


def _windows(grid: Grid) -> Iterator[tuple[Grid, Window]]:
    """Yield windows of `BLOCK` x `BLOCK` cells that cover a grid."""
    for row in range(0, grid.height, BLOCK):
        for col in range(0, grid.width, BLOCK):
            rows, cols = slice(row, min(row + BLOCK, grid.height)), slice(col, min(col + BLOCK, grid.width))
            yield grid.part(rows, cols), Window.from_slices(rows, cols)


def _clipped(part: Grid, whole: Grid) -> Grid:
    """Return the part of a grid that is inside another grid of the same lattice."""
    west, north = max(part.west, whole.west), min(part.north, whole.north)
    east, south = min(part.east, whole.east), max(part.south, whole.south)
    return Grid.covering(whole.crs, (west, south, east, north), whole.cell)
