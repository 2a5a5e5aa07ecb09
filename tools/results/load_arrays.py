"""Load one tile from xarray DataArrays in memory; the counterpart of `load` for files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from rasterio.enums import Resampling

from flexroad.catalog.crs import height_unit, in_plan, is_geographic, is_projected, plan_unit, same, short
from flexroad.catalog.crs_checks import require_scale
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import LATTICE_TOLERANCE, Grid
from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.cell_values import has_fractions, values_note
from flexroad.catalog.text import edges
from flexroad.catalog.tile import HIGHEST_M, LOWEST_M
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.dsm_and_dtm import below_ground_note, offset_note
from flexroad.tasks.io.height_units import UNITS, absurd_note, remove_absurd, smaller_unit_fault
from flexroad.tasks.io.raster import RasterWindow, misalignment, resample_to
from flexroad.tasks.io.raster_grid import RasterGrid
from flexroad.tasks.load import Options
from flexroad.tasks.types import Bools, Floats, Source, TileData

rioxarray = lazy("rioxarray")

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = lazy("xarray")

TILE_ID = "arrays"
"""The tile id of data that come from no catalog."""
WITHOUT_ROAD = (
    "road_mask has no road cell on the grid of the dsm, so the surface is the terrain's; "
    "a road cell is True, not 0, or one of road_values"
)
"""Note on a mask without road cells."""


def load_arrays(
    dsm: xr.DataArray,
    dtm: xr.DataArray,
    road_mask: xr.DataArray | Source,
    options: Options,
    road_values: Sequence[int] = (),
) -> TileData:
    """Return the data of one tile, whose core is the grid of the DSM.

    - `dsm`, `dtm`: heights (m). NaN and the array's nodata value mean unknown.
    - `road_mask`: road where True or not 0, or roads as vectors.
    - `options`: the halo is NaN where the DTM and the mask do not reach beyond the DSM.
    - `road_values`: values of the mask that mean road; empty: every value but 0 and nodata.
    - result: the DTM and the mask are copied where their cells coincide with the DSM's cells. Otherwise they
      are resampled (heights bilinearly, the mask to the nearest cell), with a note. A mask without road
      cells, or whose values do not fit those that mean road, gives a note, too.
    """
    if options.road_height == "layer":
        raise TaskError("load.road_height is layer, but arrays have none; set it to auto")
    patches = {"dsm": _patch("dsm", dsm), "dtm": _patch("dtm", dtm)}
    roads = road_mask if isinstance(road_mask, Source) else None
    if not isinstance(road_mask, Source):
        patches["road_mask"] = _patch("road_mask", road_mask)
    cells, crs = patches["dsm"].lattice, in_plan(patches["dsm"].crs or "")
    core = Grid(crs, cells.west, cells.north, cells.dx, cells.width, cells.height)
    try:
        require_scale(
            "dsm", core.crs, core.bounds, "reproject it to metres, e.g. dsm.rio.reproject('{zone}')"
        )
    except CatalogError as error:
        raise TaskError(str(error)) from error
    grid = core.buffered(options.halo_m)
    notes: list[str | None] = [_absurd(patches[name]) for name in ("dsm", "dtm")]
    notes += [_misfit(patch, core) for name, patch in patches.items() if name != "dsm"]
    heights = {name: _onto(patches[name], grid, Resampling.bilinear) for name in ("dsm", "dtm")}
    window = grid.window(core)
    _check_valid("dsm", heights["dsm"][window], options.min_valid)
    _check_valid("dtm", heights["dtm"][window], 0.0)
    models = heights["dsm"], heights["dtm"]
    notes += [offset_note(*models) or below_ground_note(*models)]
    road = None
    if not roads:
        road, note = _road(patches["road_mask"], grid, road_values)
        notes += [note or (None if road[window].any() else WITHOUT_ROAD)]
    return TileData(
        TILE_ID,
        grid,
        core,
        heights["dsm"],
        heights["dtm"],
        road,
        roads=roads,
        notes=tuple(filter(None, notes)),
        # Arrays declare neither date nor vertical CRS.
        offset_dsm=options.road_height == "offset" and options.offset_undeclared,
    )


def _patch(name: str, array: xr.DataArray) -> RasterWindow:
    """Return an array's values, rows from the north, with their lattice and CRS."""
    array = _plane(name, array)
    crs = _crs(name, array)
    _check_unit(name, array, crs)
    lattice, west_first = _lattice(name, array)
    values = _values(name, array)
    values = values if west_first else values[:, ::-1]
    return RasterWindow(name, "", values[::-1] if lattice.northward else values, lattice, "", crs)


def _plane(name: str, array: xr.DataArray) -> xr.DataArray:
    """Return the array as ``(y, x)``; a band or time of length 1 is dropped."""
    without_axes = rioxarray.exceptions.MissingSpatialDimensionError  # the import gives arrays their .rio
    if not isinstance(array, xr.DataArray):
        raise TaskError(f"{name} is a {type(array).__name__}; give an xarray.DataArray with y, x and a CRS")
    array = array.squeeze(drop=True) if array.ndim > 2 else array
    try:
        x, y = array.rio.x_dim, array.rio.y_dim
    except without_axes:
        x = y = ""
    if {x, y} != set(array.dims):
        sizes = ", ".join(f"{dim}: {size}" for dim, size in array.sizes.items())
        raise TaskError(f"{name} has dimensions ({sizes}), not y and x alone; select with .isel or .rename")
    return array.transpose(y, x)


def _crs(name: str, array: xr.DataArray) -> str:
    if array.rio.crs is None:
        raise TaskError(f"{name} has no CRS; write it, e.g. {name}.rio.write_crs('EPSG:25832')")
    crs: str = array.rio.crs.to_wkt()
    remedy = f"reproject it to metres, e.g. {name}.rio.reproject({name}.rio.estimate_utm_crs())"
    if is_geographic(crs):
        raise TaskError(f"{name} is in {short(crs)}, a geographic CRS in degrees; {remedy}")
    unit, metres = plan_unit(crs)
    if not is_projected(crs) or not math.isclose(metres, 1.0):
        raise TaskError(f"{name} is in {short(crs)}, whose coordinates are in {unit}; {remedy}")
    return crs


def _check_unit(name: str, array: xr.DataArray, crs: str) -> None:
    """Raise an error if heights are declared in another unit than metres."""
    if name == "road_mask":
        return
    unit, metres = array.attrs.get("units"), 1.0
    if unit:
        factor = UNITS.get(str(unit).lower())
        if factor is None:
            raise TaskError(f"{name} has units {unit!r}; give metres and set {name}.attrs['units'] = 'm'")
        metres = factor
    else:
        unit, metres = height_unit(crs) or ("metre", 1.0)
    if not math.isclose(metres, 1.0):
        raise TaskError(
            f"{name} has heights in {unit}; multiply it by {metres:.10g} and set {name}.attrs['units'] = 'm'"
        )


def _lattice(name: str, array: xr.DataArray) -> tuple[RasterGrid, bool]:
    """Return the lattice of the cells, and whether the first column is in the west."""
    y, x = array.dims
    transform = array.rio.transform()
    if transform.b or transform.d:
        raise TaskError(f"{name} is rotated; turn it north up, e.g. {name}.rio.reproject({name}.rio.crs)")
    if min(array.shape) < 2:
        raise TaskError(f"{name} has {array.shape[0]} x {array.shape[1]} cells; give at least 2 x 2")
    if x in array.coords and y in array.coords:
        # Coordinates are preferred: a stored transform is out of date after an array was sliced.
        (west, dx), (south, dy) = _axis(name, array[x]), _axis(name, array[y])
    else:
        dx, dy = transform.a, transform.e
        west = min(transform.c, transform.c + array.shape[1] * dx)
        south = min(transform.f, transform.f + array.shape[0] * dy)
    if not math.isclose(abs(dx), abs(dy), rel_tol=1e-5):
        raise TaskError(
            f"{name} has pixels of {abs(dx):.6g} x {abs(dy):.6g} m; make them square, "
            f"e.g. {name}.rio.reproject({name}.rio.crs, resolution={max(abs(dx), abs(dy)):.6g})"
        )
    rows, columns = array.shape
    north = round(south + rows * abs(dy), 6)
    return RasterGrid(west, north, abs(dx), abs(dy), columns, rows, northward=dy > 0), dx > 0


def _axis(name: str, centres: xr.DataArray) -> tuple[float, float]:
    """Return the lower edge of an axis and its signed step (m), rounded to remove floating-point errors."""
    values = np.asarray(centres.values, dtype=np.float64)
    steps = np.diff(values)
    step = float(values[-1] - values[0]) / steps.size
    if not step or not np.allclose(steps, step, rtol=LATTICE_TOLERANCE, atol=0):
        raise TaskError(
            f"{name} has {centres.name} in steps of {steps.min():.6g} to {steps.max():.6g} m, not equal; "
            f"resample it, e.g. {name}.rio.reproject({name}.rio.crs)"
        )
    return round(float(values.min()) - abs(step) / 2, 6), round(step, 9)


def _values(name: str, array: xr.DataArray) -> Floats:
    scale, offset = array.attrs.get("scale_factor", 1.0), array.attrs.get("add_offset", 0.0)
    if (scale, offset) != (1.0, 0.0):
        raise TaskError(
            f"{name} has scale_factor {scale:g} and add_offset {offset:g}, not yet applied; "
            "open it with mask_and_scale=True"
        )
    raw: np.ndarray[Any, Any] = np.asarray(array.values)
    if raw.dtype.kind not in "buif":
        raise TaskError(f"{name} has {raw.dtype}, not numbers; convert it with .astype(float)")
    values = raw.astype(np.float64)
    # A comparison keeps the attribute of its raster, and rioxarray cannot convert 255 to bool.
    nodata = None if raw.dtype.kind == "b" else array.rio.nodata
    if nodata is not None:
        # Compare in the array's dtype: -3.4e38 is not the same number in float32 and float64.
        values[values == np.float64(np.asarray(nodata).astype(raw.dtype))] = np.nan
    return values


def _absurd(patch: RasterWindow) -> str:
    """Set heights outside the valid range to NaN, as `load` does; return a note, or "" if none is outside."""
    given = replace(patch, values=patch.values.copy())
    count = remove_absurd(patch.values)
    if count and np.isnan(patch.values).all():
        low, high = np.nanmin(given.values), np.nanmax(given.values)
        fault = smaller_unit_fault(given, "") or (
            f" has no height in {LOWEST_M:g} to {HIGHEST_M:g} m ({low:.0f} to {high:.0f}); give metres"
        )
        raise TaskError(f"{patch.name}{fault}")
    return absurd_note(patch.name, count) if count else ""


def _road(patch: RasterWindow, grid: Grid, road_values: Sequence[int]) -> tuple[Bools, str]:
    """Return the road cells of a mask, and a note if its values do not fit, else ""."""
    known = patch.values[~np.isnan(patch.values)]
    values = set(np.unique(known).tolist())
    note = values_note(values, road_values, known.size < patch.values.size, "road_values") if values else ""
    if note and not road_values and has_fractions(values):
        raise TaskError(f"road_mask: {note}")
    cells = np.nan_to_num(_onto(patch, grid, Resampling.nearest))
    road: Bools = np.isin(cells, tuple(road_values)) if road_values else cells != 0
    return road, f"road_mask: {note}" if note else ""


def _misfit(patch: RasterWindow, core: Grid) -> str:
    """Check that the CRS is the DSM's; return a note if the cells do not coincide with the DSM's, else ""."""
    if not same(patch.crs or "", core.crs):
        raise TaskError(
            f"{patch.name} is in {short(patch.crs or '')}, the dsm in {short(core.crs)}; "
            f"reproject it, e.g. {patch.name}.rio.reproject_match(dsm)"
        )
    reason = misalignment(patch.lattice, core).replace("the tile's", "the dsm's")
    return f"{patch.name} resampled to the grid of the dsm: {reason}" if reason else ""


def _onto(patch: RasterWindow, grid: Grid, resampling: Resampling) -> Floats:
    slices = patch.lattice.window_for(grid)
    if slices is None:
        bounds = edges(patch.lattice.bounds)
        raise TaskError(f"{patch.name} ({bounds}) does not overlap the dsm; give arrays of the same area")
    cut = RasterWindow(
        patch.name,
        "",
        patch.values[slices],
        patch.lattice.cut(*slices),
        "",
        patch.crs,
    )
    return resample_to(cut, grid, resampling)


def _check_valid(name: str, values: Floats, min_valid: float) -> None:
    share = 1 - np.isnan(values).mean()
    if share == 0:
        raise TaskError(f"{name} has only nodata on the grid of the dsm; give heights in metres")
    if share < min_valid:
        raise TaskError(
            f"{name} has {share:.1%} valid cells, below {min_valid:.0%}; "
            "cut the arrays to the survey, or lower load.min_valid in the configuration"
        )
