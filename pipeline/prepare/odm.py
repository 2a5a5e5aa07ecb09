"""``prepare odm``: an OpenDroneMap project as it lies.

Its rasters are taken where it has them; without a surface model its textured mesh, without that its points.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rasterio.warp
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import RasterioError
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from flexroad.catalog import CatalogError, Grid
from flexroad.catalog.to_metres import MetricTransform
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.blocks import sheet_grid
from flexroad.pipeline.prepare.mesh import MeshAsked, prepare_mesh
from flexroad.pipeline.prepare.points import prepare_points
from flexroad.pipeline.prepare.roads import add_roads
from flexroad.pipeline.prepare.sheet import Published, Sheet
from flexroad.tasks.acquire.points import fill_voids, ground_filter, to_rasters
from flexroad.tasks.types import Floats, Orthophoto

DSM, DTM, PHOTO = "odm_dem/dsm.tif", "odm_dem/dtm.tif", "odm_orthophoto/odm_orthophoto.tif"
MESHES = tuple(
    f"{folder}/odm_textured_model_geo.obj"
    for folder in ("odm_texturing", "odm_texturing_25d", "odm_texturing_dem")
)
CLOUDS = tuple(f"odm_georeferencing/odm_georeferenced_model.{kind}" for kind in ("laz", "las"))
BLOCK = 512
"""Side of the windows that are worked on (cells or pixels): memory does not grow with the area."""


def prepare_odm(
    folder: Path,
    out: Path,
    asked: Asked,
    mesh_asked: MeshAsked,
    options: to_rasters.Options,
    executor: Executor,
    say: Callable[[str], None],
) -> Published:
    """Make rasters and catalog of a project folder of OpenDroneMap.

    Parameters
    ----------
    folder : Path
        The project: what holds ``odm_dem``, ``odm_orthophoto``, ``odm_texturing``.
    out : Path
        Folder to publish in.
    asked, mesh_asked : Asked, MeshAsked
        What the user wants; the latter where there is but a mesh.
    options : to_rasters.Options
        Ground filter and voids where there is no ``dtm.tif``; all of it for mesh and points.
    executor : Executor
        Where blocks of points are worked on.
    say : callable
        Told what is going on.

    Raises
    ------
    ConfigError, CatalogError, TaskError
        If the project has none of what is looked for or a file of it cannot be read; nothing is left behind.
    """
    if (folder / DSM).is_file():
        return _rasters(folder, out, asked, options, say)
    for name in MESHES:
        if (folder / name).is_file():
            return prepare_mesh(folder / name, out, asked, mesh_asked, options, executor, say)
    for name in CLOUDS:
        if (folder / name).is_file():
            return prepare_points([folder / name], out, asked, options, executor, say)
    looked_for = ", ".join((DSM, *MESHES, *CLOUDS))
    raise ConfigError(
        f"{folder} has none of {looked_for}; name the folder of a finished OpenDroneMap project, and let it "
        "make its surface model: --dsm"
    )


def _rasters(
    folder: Path, out: Path, asked: Asked, options: to_rasters.Options, say: Callable[[str], None]
) -> Published:
    frame, grid = _frame(folder / DSM, asked)
    has_dtm, photo = (folder / DTM).is_file(), folder / PHOTO
    dop_cell = asked.dop_cell_m if photo.is_file() else None
    made = DTM if has_dtm else f"slope-filtered cells of the DSM; voids up to {options.void_m:g} m filled"
    name = folder.resolve().name
    facts = {"SOURCE": f"OpenDroneMap, {name}", "DSM": f"{DSM}, maximum per cell", "DTM": made}
    with Sheet(out, grid, dop_cell, facts) as sheet:
        say(f"bringing {folder / DSM} to {grid.width} x {grid.height} cells")
        _heights(sheet, "dsm", folder / DSM, frame, Resampling.max)
        if has_dtm:
            _heights(sheet, "dtm", folder / DTM, frame, Resampling.average)
        else:
            say(f"no {DTM}: filtering the ground from the surface model")
            _filter(sheet, options)
        if sheet.photo_grid is not None:
            say(f"bringing {photo} to {asked.dop_cell_m:g} m")
            _photo(sheet, photo, frame)
        add_roads(sheet, asked)
        published = sheet.publish(asked.tile_size_m, asked.date, asked.dataset or name)
    there = {DTM: has_dtm, PHOTO: dop_cell is not None}
    missing = [f"{folder} has no {layer}" for layer, found in there.items() if not found]
    return published.noting(*frame.notes, *missing)


def _frame(dsm: Path, asked: Asked) -> tuple[MetricTransform, Grid]:
    """Return the way to metres and the cells that cover the surface model."""
    with _opened(dsm) as source:
        crs = source.crs.to_wkt() if source.crs else asked.crs
        if crs is None:
            raise CatalogError(f"{dsm} carries no CRS; give it with --crs, such as --crs EPSG:32632")
        frame = MetricTransform.of(crs, source.bounds[:2], asked.to_crs, asked.height_unit)
        bounds = rasterio.warp.transform_bounds(crs, frame.target, *source.bounds)
    return frame, sheet_grid(bounds, frame.target, asked.cell_m, asked.step_m)


def _heights(sheet: Sheet, layer: str, path: Path, frame: MetricTransform, finer: Resampling) -> None:
    """Bring a raster of heights to the sheet's cells."""
    with _opened(path) as source, _warped(source, frame, sheet.grid, finer) as warped:
        for where, window in _windows(sheet.grid):
            heights = warped.read(1, window=window, masked=True).astype(np.float64).filled(np.nan)
            sheet.write(layer, where, heights * frame.height_m)


def _photo(sheet: Sheet, path: Path, frame: MetricTransform) -> None:
    grid = sheet.photo_grid
    assert grid is not None
    with _opened(path) as source:
        if source.count < 3 or source.dtypes[0] != "uint8":
            raise CatalogError(
                f"{path} has no three bands of bytes; move it away to do without an orthophoto"
            )
        with _warped(source, frame, grid, Resampling.average) as warped:
            for where, window in _windows(grid):
                known = warped.dataset_mask(window=window) > 0
                sheet.write_photo(Orthophoto(where, warped.read((1, 2, 3), window=window), known))


def _filter(sheet: Sheet, options: to_rasters.Options) -> None:
    """Make the terrain of the surface: its ground cells, and what lies between them."""
    slope = options.filter
    reach = slope.radius_m + (slope.low_radius_m if slope.low_m is not None else 0)
    reach += fill_voids.reach_m(options.void_m, sheet.grid.cell)
    for where, _ in _windows(sheet.grid):
        rim = _clipped(where.buffered(reach), sheet.grid)
        dsm: Floats = sheet.read("dsm", rim)
        cells = ground_filter.ground_cells(dsm, rim.cell, slope)
        dtm = fill_voids.fill(np.where(cells, dsm, np.nan), rim, options.void_m)
        sheet.write("dtm", where, dtm[rim.window(where)])


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with rasterio.open(path) as source:
            yield source
    except RasterioError as error:
        raise CatalogError(
            f"{path} cannot be read as a raster: {error}; let OpenDroneMap make it again"
        ) from error


def _warped(source: Any, frame: MetricTransform, grid: Grid, finer: Resampling) -> WarpedVRT:
    """Return a raster on a grid: ``finer`` says how where its own cells are smaller, else bilinear."""
    cell = max(abs(source.transform.a), abs(source.transform.e)) * (frame.plan_m or 1.0)
    return WarpedVRT(
        source,
        src_crs=source.crs or frame.source,
        crs=grid.crs,
        transform=grid.transform,
        width=grid.width,
        height=grid.height,
        resampling=finer if cell < grid.cell * 1.001 else Resampling.bilinear,
        # Pixels outside get no colour by their alpha.
        add_alpha=source.count >= 3 and source.nodata is None and not _has_alpha(source),
    )


def _has_alpha(source: Any) -> bool:
    return ColorInterp.alpha in source.colorinterp


def _windows(grid: Grid) -> Iterator[tuple[Grid, Window]]:
    """Cut a grid into windows of `BLOCK` cells."""
    for row in range(0, grid.height, BLOCK):
        for col in range(0, grid.width, BLOCK):
            height, width = min(BLOCK, grid.height - row), min(BLOCK, grid.width - col)
            west, north = grid.west + col * grid.cell, grid.north - row * grid.cell
            yield Grid(grid.crs, west, north, grid.cell, width, height), Window(col, row, width, height)


def _clipped(part: Grid, whole: Grid) -> Grid:
    """Return what of one grid lies on another of the same lattice."""
    west, north = max(part.west, whole.west), min(part.north, whole.north)
    east, south = min(part.east, whole.east), max(part.south, whole.south)
    return Grid.covering(whole.crs, (west, south, east, north), whole.cell)
