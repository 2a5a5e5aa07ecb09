"""What the header of an open raster says, and where its cells lie."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

from rasterio.enums import MaskFlags

from flexroad.catalog.crs import bounds_in, in_plan, same, short
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.grid import Bounds, Grid
from flexroad.catalog.scan.rasters import georeference_fault
from flexroad.catalog.scan.valid_cells import alpha_band
from flexroad.catalog.storage.paths import Location
from flexroad.tasks.errors import Unusable
from flexroad.tasks.io.raster_grid import RasterGrid


@dataclass(frozen=True)
class Header:
    """What a file says of its cells."""

    lattice: RasterGrid | None
    """None if the file has no georeference."""
    fault: str | None
    """Why the position cannot be used, to follow the file's name; None if it can."""
    crs: str | None
    """As WKT."""
    all_valid: bool
    """Whether the first band has no cells without a value."""
    nan_is_nodata: bool
    """Whether its cells without a value are NaN, and only they."""
    alpha: int | None
    """Number of the alpha band that GDAL does not take for a mask, None without one."""

    @classmethod
    def of(cls, src: Any) -> Header:
        """Return that of an open raster."""
        transform, masks = src.transform, src.mask_flag_enums[0]
        fault = georeference_fault(src)
        if fault is None and (transform.b or transform.d):
            fault = "is rotated; turn it north up with gdalwarp"
        known = fault is None and not transform.is_identity
        alpha = alpha_band(src)
        return cls(
            lattice=RasterGrid.of(transform, src.width, src.height) if known else None,
            fault=None if transform.is_identity else fault,
            crs=src.crs.to_wkt() if src.crs else None,
            all_valid=MaskFlags.all_valid in masks and alpha is None,
            nan_is_nodata=masks == [MaskFlags.nodata] and math.isnan(src.nodata) and alpha is None,
            alpha=alpha,
        )


_headers = WeakKeyDictionary[Any, Header]()


def header(src: Any) -> Header:
    """Return the header of an open raster. rasterio makes parts of it anew at each access, so it is kept."""
    found = _headers.get(src)
    if found is None:
        found = _headers[src] = Header.of(src)
    return found


def file_crs(src: Any, given: str | None) -> str | None:
    """Return the CRS of an open raster: its own, else or where that cannot be, the given one (`crs_of`)."""
    found = header(src)
    return crs_of(found.crs, given, found.lattice.bounds) if found.lattice else found.crs or given


def place(
    src: Any,
    path: Location,
    name: str,
    grid: Grid,
    core: Grid,
    crs: str | None,
    reproject: bool = False,
) -> RasterGrid | None:
    """Return a file's lattice, or None if it is in another CRS and outside the grid; see `read_window`."""
    found = header(src)
    if found.fault:
        raise Unusable(f"{name} {found.fault}", str(path))
    lattice, own_crs = found.lattice, file_crs(src, crs)
    if lattice is None:
        if src.shape == core.shape:
            return RasterGrid(core.west, core.north, core.cell, core.cell, core.width, core.height)
        raise Unusable(
            f"{name} has no georeference and has {src.width} x {src.height} cells, "
            f"the tile {core.width} x {core.height}; give it a world file",
            str(path),
        )
    if own_crs is None:
        raise Unusable(f"{name} has no CRS; build the catalog again with --crs", str(path))
    if same(own_crs, grid.crs):
        return lattice
    if not _overlap(bounds_in(grid.crs, own_crs, lattice.bounds), grid.bounds):
        return None
    if reproject:
        return replace(lattice, crs=in_plan(own_crs))
    raise Unusable(
        f"{name} is in {short(own_crs)}, the tile in {short(grid.crs)}; "
        f"reproject it, e.g. gdalwarp -t_srs {short(grid.crs)}, or make the catalog with --reproject",
        str(path),
    )


def _overlap(a: Bounds, b: Bounds) -> bool:
    # Written so that bounds that cannot be transformed (inf, NaN) count as overlapping: they are an error.
    return not (a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1])
