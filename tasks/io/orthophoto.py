"""Read the orthophoto (DOP) of a tile: a window of its files at the requested resolution.

Pixels that coincide with pixels of the file are copied, coarser pixels are means, finer pixels are
interpolated. Pixels that are nodata, masked or transparent in the file are unknown.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from affine import Affine
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling
from rasterio.vrt import WarpedVRT

from flexroad.catalog.grid import LATTICE_TOLERANCE, Grid
from flexroad.catalog.scan.rasters import color_kinds, quiet
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import edges
from flexroad.tasks.errors import LayerMissing, TaskError, Unusable, leave_out
from flexroad.tasks.io.raster import read_raster
from flexroad.tasks.io.raster_grid import RasterGrid, place
from flexroad.tasks.types import Bools, Orthophoto, Source

BITS = {"uint8": 8, "uint16": 16}
"""Bits per colour of the supported types, unless the file declares fewer."""


def read_photo(source: Source, grid: Grid, gsd_m: float | None = None, finest_m: float = 0.0) -> Orthophoto:
    """Read the orthophoto over a grid's bounds.

    A grey photo is returned as three equal bands; of more than three bands (near infrared) the first three
    are used. 16-bit colours are scaled to 8 bits by the depth that the file declares, else by 16.

    - `source`: the photo's files; where files overlap, the first one with a value is used.
    - `grid`: the area to read; only its bounds and CRS are used.
    - `gsd_m`: ground sampling distance of the result (m); by default as in the first file that reaches the
      grid.
    - `finest_m`: smallest ground sampling distance (m) if ``gsd_m`` is None: finer photos are averaged.
    - result: its pixels start in the grid's north-west corner and cover the grid.
    """
    photo: Orthophoto | None = None
    unusable: list[Unusable] = []
    reached = np.zeros((1, 1), bool)
    with quiet():
        for path in source.paths:
            try:
                part = _read(path, source, grid, gsd_m, finest_m)
            except Unusable as error:
                unusable.append(error)
                leave_out(error)
                continue
            if part is None:
                continue
            piece, lattice = part
            gsd_m = piece.grid.cell
            if photo:
                colour = np.where(photo.known, photo.colour, piece.colour)
                piece = replace(photo, colour=colour, known=photo.known | piece.known)
            photo = piece
            reached = reached | lattice.reached(photo.grid)
            if photo.known.all():
                break
    # A tile also lists files around it: an unusable file fails only the tiles that need it.
    if unusable and not (source.optional or reached.all()):
        raise TaskError(str(unusable[0]), unusable[0].file, source.name)
    if photo is None:
        names = ", ".join(path.name for path in source.paths[:3])
        raise LayerMissing(
            f"no {source.name} file overlaps the tile ({edges(grid.bounds)}): {names}; "
            "build the catalog again",
            str(source.paths[0]),
            source.name,
        )
    return photo


def _read(
    path: Location, source: Source, grid: Grid, gsd_m: float | None, finest_m: float
) -> tuple[Orthophoto, RasterGrid] | None:
    """Return a file's pixels over the grid, and the file's lattice; None if it does not overlap the grid."""
    name = f"{source.name} {path.name}"

    def read(src: Any) -> tuple[Orthophoto, RasterGrid] | None:
        lattice = place(src, path, name, grid, grid, source.crs, source.reproject)
        if lattice is None or lattice.window_for(grid) is None:
            return None
        depth = _depth(src, path, name)
        pixels = Grid.covering(grid.crs, grid.bounds, gsd_m or max(_gsd_m(lattice, grid), finest_m))
        colour, known = _warped(src, lattice, pixels)
        if src.count < 3:
            colour = np.repeat(colour, 3, axis=0)
        scaled = np.rint(colour * (255 / (2**depth - 1)))
        return Orthophoto(pixels, np.clip(scaled, 0, 255).astype(np.uint8), known), lattice

    return read_raster(path, name, read, missing=source.missing)


def _gsd_m(lattice: RasterGrid, grid: Grid) -> float:
    """Return the width of a file's pixel on a grid (m), to the millimetre if it is reprojected."""
    if not lattice.crs:
        return lattice.dx
    return max(0.001, round(lattice.dx * grid.cell / lattice.cell_of(grid)[0], 3))


def _depth(src: Any, path: Location, name: str) -> int:
    """Return the number of bits per colour."""
    kind = src.dtypes[0]
    if color_kinds(src)[0] == ColorInterp.palette:
        raise Unusable(
            f"{name} has a palette instead of colours; expand it with gdal_translate -expand rgb", str(path)
        )
    if kind not in BITS:
        raise Unusable(
            f"{name} has colours in {kind}, not 8 or 16 bits; convert it with gdal_translate -ot Byte -scale",
            str(path),
        )
    return int(src.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", BITS[kind]))


def _warped(src: Any, lattice: RasterGrid, pixels: Grid) -> tuple[NDArray[np.float32], Bools]:
    """Return the file's colours on the pixels, ``(1 or 3, h, w)``, not scaled, and which pixels are known."""
    cell_x, cell_y = lattice.cell_of(pixels)
    coarser = min(cell_x / lattice.dx, cell_y / lattice.dy) > 1 + LATTICE_TOLERANCE
    bands = (1, 2, 3) if src.count >= 3 else (1,)
    has_alpha = ColorInterp.alpha in color_kinds(src)
    transform = lattice.transform
    if lattice.northward:
        transform = Affine(lattice.dx, 0, lattice.west, 0, lattice.dy, lattice.bounds[1])
    with WarpedVRT(
        src,
        # If the file's CRS is the same CRS with another name, this prevents a reprojection.
        src_crs=lattice.crs or pixels.crs,
        crs=pixels.crs,
        src_transform=transform,
        transform=pixels.transform,
        width=pixels.width,
        height=pixels.height,
        resampling=Resampling.average if coarser else Resampling.bilinear,
        dtype="float32",
        add_alpha=not has_alpha,
        # A pixel is unknown only if all bands are nodata: pure red has two bands at 0.
        UNIFIED_SRC_NODATA="YES",
    ) as vrt:
        alpha = color_kinds(src).index(ColorInterp.alpha) + 1 if has_alpha else vrt.count
        known: Bools = vrt.read(alpha) > 0
        colour: NDArray[np.float32] = vrt.read(bands)
    return np.where(known, colour, np.float32(0)), known
