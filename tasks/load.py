"""Step A of the paper, geospatial data acquisition: the rasters R^DSM and R^DTM of one tile on one lattice.

Files may differ in extent, lattice, unit and nodata value. The result has heights in metres (float64), row 0
in the north and NaN where there is no value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.cover import MIN_COVER
from flexroad.catalog.crs import Unit, height_unit, is_projected, plan_unit
from flexroad.catalog.storage.paths import Location, stat
from flexroad.catalog.text import count
from flexroad.catalog.tile import HEIGHTS
from flexroad.tasks import options
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats, Source, TileData

if TYPE_CHECKING:
    from flexroad.tasks.io.raster import RasterWindow, Unreadable

VERSION = 3

CLASSES = ("road_mask", "reference_road")
READS = HEIGHTS + CLASSES
"""Layers that are read; of other layers the result holds only the file names."""
NEEDS = ("dsm", "dtm")
"""Layers without which a tile fails."""

LOWEST_M, HIGHEST_M = -500.0, 9000.0
"""Heights outside this range are taken as undeclared nodata."""

MAX_CELLS = 25_000_000
"""Largest number of cells of a tile with its halo: 0.2 GB for each of several layers."""

METRE: Unit = ("metre", 1.0)

UNITS = {
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters"), 1.0),
    **dict.fromkeys(("ft", "foot", "feet", "international foot"), 0.3048),
    **dict.fromkeys(("us-ft", "us-foot", "ftus", "foot_us", "us survey foot", "us survey feet"), 1200 / 3937),
    **dict.fromkeys(("cm", "centimetre", "centimeter"), 0.01),
}
"""Size (m) of the units of height that bands declare; names in lower case."""


class Options(options.Options):
    """Options of `load`."""

    halo_m: float = Field(
        0.0,
        ge=0,
        le=500,
        description="ground read around the tile (m): for the filter, and for a fit without shared borders; "
        "0 in the paper; catalogs of rasters and of prepared tiles list the files up to 200 m around a tile",
    )
    min_valid: float = Field(
        MIN_COVER,
        ge=0,
        le=1,
        description="share of the tile's cells that need a DSM height, or the tile fails",
    )


@dataclass(frozen=True, eq=False)
class _Mosaic:
    """One layer on the tile's lattice."""

    values: Floats
    """``(H, W)``, heights in m or class values; NaN where no file has a value."""
    patches: tuple[RasterWindow, ...]
    """The parts read, in the order of the files."""
    notes: tuple[str, ...]
    broken: tuple[Unreadable, ...]
    """The errors of missing and broken files."""

    def reached(self, grid: Grid) -> Bools:
        """Return the cells of a grid within the bounds of a file that was read, ``(H, W)``."""
        cells = np.zeros(grid.shape, np.bool_)
        for patch in self.patches:
            cells |= patch.lattice.reached(grid)
        return cells


def load(tile: Tile, options: Options) -> TileData:
    """Read a tile's DSM, DTM, masks and reference onto its lattice, grown by the halo.

    Cells that coincide are copied; others are resampled (heights bilinearly, classes to the nearest),
    with a note. Files in another CRS are warped if the layer says so (`Layer.reproject`). Where files
    overlap, the first one with a value is used, those in the tile's CRS before others.

    Raises
    ------
    TaskError
        If the tile's entry in the catalog cannot be used (`Tile.fault`), a file that the tile needs is
        missing or broken, a file is in another CRS, the layers differ in
        their unit of height, the tile has no DSM or DTM, or the DSM covers less than ``min_valid`` of it.
    """
    if tile.fault:
        raise TaskError(tile.fault)
    for name in NEEDS:
        if tile.layer(name) is None:
            raise TaskError(f"the tile has no {name}; give its files to `flexroad catalog` with --{name}")
    from flexroad.catalog.headers.rasters import quiet

    grid = tile.grid.buffered(options.halo_m)
    if grid.width * grid.height > MAX_CELLS:
        raise TaskError(
            f"the tile has {grid.width} x {grid.height} cells with its halo, more than {MAX_CELLS:,}; "
            "catalog smaller tiles (--tile-size)"
        )
    tile = tile.within(grid.bounds)
    core = grid.window(tile.grid)
    with quiet():
        mosaics = {
            layer.name: _mosaic(tile, layer, grid, tile.grid) for layer in tile.layers if layer.name in READS
        }
    for layer in tile.layers:
        if layer.name in mosaics:
            _check_read(tile, layer, mosaics[layer.name], core, grid)
    _check_units([patch for name in HEIGHTS if name in mosaics for patch in mosaics[name].patches])
    _check_valid(mosaics["dsm"], core, options.min_valid)
    _check_valid(mosaics["dtm"], core, 0.0)
    return TileData(
        tile_id=tile.id,
        grid=grid,
        core=tile.grid,
        dsm=mosaics["dsm"].values,
        dtm=mosaics["dtm"].values,
        road_mask=_road(tile, "road_mask", mosaics),
        reference=_reference(mosaics),
        reference_road=_road(tile, "reference_road", mosaics),
        notes=tuple(note for mosaic in mosaics.values() for note in mosaic.notes),
        dop=layer_source(tile, "dop"),
        roads=layer_source(tile, "roads"),
    )


def load_border(ground: Tile, core: Grid) -> TileData:
    """Read the ground around a corner or an edge of tiles; it may be without data in part or everywhere.

    Parameters
    ----------
    ground : Tile
        The ground, with the files that reach it (`Tile.around`).
    core : Grid
        The tile that the files are of: the position of a file without georeference.

    Raises
    ------
    TaskError
        If the layers differ in their unit of height.
    """
    from flexroad.catalog.headers.rasters import quiet

    grid = ground.grid
    with quiet():
        mosaics = {
            layer.name: _mosaic(ground, layer, grid, core, around=True)
            for layer in ground.layers
            if layer.name in READS
        }
    patches = [patch for name in HEIGHTS if name in mosaics for patch in mosaics[name].patches]
    if patches:
        _check_units(patches)
    unknown = np.full(grid.shape, np.nan)
    return TileData(
        tile_id=ground.id,
        grid=grid,
        core=grid,
        dsm=mosaics["dsm"].values if "dsm" in mosaics else unknown,
        dtm=mosaics["dtm"].values if "dtm" in mosaics else unknown,
        road_mask=_road(ground, "road_mask", mosaics),
        dop=_optional(layer_source(ground, "dop")),
        roads=_optional(layer_source(ground, "roads")),
    )


def layer_source(tile: Tile, name: str) -> Source | None:
    """Return a layer that another stage reads, or None if the tile has none.

    Missing files that do not reach the tile are left out.
    """
    layer = tile.layer(name)
    if layer is None:
        return None
    needed = (layer.reaching(tile.grid.bounds) or layer).files
    paths = zip(layer.files, tile.paths(layer), strict=True)
    files = tuple(path for file, path in paths if file in needed or stat(path))
    return Source(
        name, files, layer.crs, allowed=tile.allowed, reproject=layer.reproject, sublayer=layer.sublayer
    )


def _optional(source: Source | None) -> Source | None:
    return replace(source, optional=True) if source else None


def _reference(mosaics: Mapping[str, _Mosaic]) -> Floats | None:
    """Return the layer ``reference``, else the paper's extended DTM (DTM and bridge decks), else None."""
    if "reference" in mosaics:
        return mosaics["reference"].values
    if "bridges" not in mosaics:
        return None
    decks = mosaics["bridges"].values
    return np.where(np.isfinite(decks), decks, mosaics["dtm"].values)


def _mosaic(tile: Tile, layer: Layer, grid: Grid, core: Grid, around: bool = False) -> _Mosaic:
    """Return a layer on a grid; files that are missing or broken are left out.

    If the grid is ground ``around`` tiles, so are those in another CRS: they fail the tiles that they lie on.
    """
    from rasterio.enums import Resampling

    from flexroad.tasks.io.raster import Unreadable, fill_from, joined

    values = np.full(grid.shape, np.nan)
    warped: list[RasterWindow] = []
    broken: list[Unreadable] = []
    heights = layer.name in HEIGHTS
    resampling = Resampling.bilinear if heights else Resampling.nearest
    patches: list[RasterWindow] = []
    absurd_cells = 0
    for name, path in zip(layer.files, tile.paths(layer), strict=True):
        try:
            patch = _window(tile, layer, name, path, grid, core, around)
        except Unreadable as error:
            broken.append(error)
            continue
        if patch is None:
            continue
        if heights:
            patch, absurd = _metres(_with_unit(patch, layer))
            absurd_cells += absurd
        patches.append(patch)
        if patch.lattice.crs:
            warped.append(patch)
            continue
        fill_from(patch, grid, values, resampling)
        if not np.isnan(values).any():
            break
    # After the files in the tile's CRS, which lose nothing.
    for patch in joined(warped):
        fill_from(patch, grid, values, resampling)
    notes = _notes(layer, patches, grid)
    notes += [f"a file that the tile does not need was left out: {error}" for error in broken]
    if absurd_cells:
        notes.append(absurd_note(layer.name, absurd_cells))
    return _Mosaic(values, tuple(patches), tuple(notes), tuple(broken))


def _check_read(tile: Tile, layer: Layer, mosaic: _Mosaic, core: tuple[slice, slice], grid: Grid) -> None:
    """Raise an error if a layer is missing on the tile itself, or a file that it needs is broken."""
    # A tile also lists files around it: a broken file fails only the tiles that need it.
    if mosaic.broken and not mosaic.reached(grid)[core].all():
        raise TaskError(str(mosaic.broken[0]), mosaic.broken[0].file)
    if not mosaic.patches:
        bounds = " ".join(f"{edge:.10g}" for edge in grid.bounds)
        raise TaskError(
            f"no {layer.name} file overlaps the tile ({bounds}): {', '.join(layer.files[:3])}; "
            "build the catalog again",
            str(tile.paths(layer)[0]),
        )


def _window(
    tile: Tile, layer: Layer, name: str, path: Location, grid: Grid, core: Grid, around: bool
) -> RasterWindow | None:
    """Return the part of a file that covers a grid, None if there is none; see `_mosaic`."""
    from rasterio.enums import Resampling

    from flexroad.tasks.io.raster import OtherCrs, read_window

    heights = layer.name in HEIGHTS
    together = Resampling.average if heights else Resampling.mode
    title = f"{layer.name} {name}"
    try:
        return read_window(
            path, title, grid, core, layer.crs, together, tile.allowed, heights, layer.reproject
        )
    except OtherCrs as error:
        if around:
            return None
        raise TaskError(str(error), error.file) from error


def _notes(layer: Layer, patches: Sequence[RasterWindow], grid: Grid) -> list[str]:
    """Return notes on patches that were resampled or reprojected, and on units that were assumed."""
    from flexroad.tasks.io.raster import misalignment

    notes = []
    for patch in patches:
        if reason := misalignment(patch.file_lattice, grid):
            how = "reprojected" if patch.lattice.crs else "resampled"
            notes.append(f"{layer.name} {how}: {reason}")
        if patch.unit_assumed:
            notes.append(f"{layer.name}: heights taken to be in {patch.unit}, as the file declares no unit")
    return list(dict.fromkeys(notes))


def _with_unit(patch: RasterWindow, layer: Layer) -> RasterWindow:
    """Return a patch of heights with the unit that the catalog or the CRS gives if none is declared."""
    if patch.unit or patch.crs is None or height_unit(patch.crs):
        return patch
    unit, metres = plan_unit(patch.crs)
    implied = unit if patch.lattice.crs and is_projected(patch.crs) and metres != 1 else ""
    unit = layer.height_unit or implied
    return replace(patch, unit=unit, unit_assumed=bool(unit))


def _metres(patch: RasterWindow) -> tuple[RasterWindow, int]:
    """Return the patch with heights in metres, and the number of cells outside the range of heights."""
    values = patch.values * _unit(patch)[1]
    return replace(patch, values=values), remove_absurd(values)


def remove_absurd(heights: Floats) -> int:
    """Set heights (m) outside `LOWEST_M` to `HIGHEST_M` to NaN, in place; return their number."""
    absurd = (heights < LOWEST_M) | (heights > HIGHEST_M)
    heights[absurd] = np.nan
    return int(np.count_nonzero(absurd))


def absurd_note(layer: str, removed: int) -> str:
    """Return the note on heights that `remove_absurd` removed from a layer."""
    return f"{layer}: {count(removed, 'cell')} outside {LOWEST_M:g}..{HIGHEST_M:g} m taken as nodata"


def _unit(patch: RasterWindow) -> Unit:
    """Return the unit of heights declared by the band, else by the CRS, else metres."""
    if not patch.unit:
        return (height_unit(patch.crs) if patch.crs else None) or METRE
    metres = UNITS.get(patch.unit.lower())
    if metres is None:
        raise TaskError(
            f"{patch.name} has the unit {patch.unit!r}, which is not a supported unit of height; "
            "convert it, or correct the unit with gdal_edit.py -units m",
            patch.file,
        )
    return patch.unit, metres


def _check_units(patches: Sequence[RasterWindow]) -> None:
    """Raise an error if layers differ in their unit of height: probably a missing tag, not a mixed survey.

    Files in different CRSs may differ if both declare their unit.
    """
    first = patches[0]
    for patch in patches[1:]:
        (a, a_metres), (b, b_metres) = _unit(first), _unit(patch)
        if (first.lattice.crs or patch.lattice.crs) and _declares_unit(first) and _declares_unit(patch):
            continue
        if not math.isclose(a_metres, b_metres, rel_tol=1e-4):
            raise TaskError(
                f"{first.name} has heights in {a}, {patch.name} in {b}; "
                "convert one, or correct its unit with gdal_edit.py -units",
                patch.file,
            )


def _declares_unit(patch: RasterWindow) -> bool:
    declared = patch.unit and not patch.unit_assumed
    return bool(declared or (patch.crs and height_unit(patch.crs)))


def _check_valid(mosaic: _Mosaic, core: tuple[slice, slice], min_valid: float) -> None:
    first = mosaic.patches[0]
    share = 1 - np.isnan(mosaic.values[core]).mean()
    if share == 0:
        raise TaskError(f"{first.name} has only nodata on this tile; leave the tile out", first.file)
    if share < min_valid:
        raise TaskError(
            f"{first.name} has {share:.1%} valid cells on this tile, below {min_valid:.0%}; "
            "lower load.min_valid to keep such tiles",
            first.file,
        )


def _road(tile: Tile, name: str, mosaics: Mapping[str, _Mosaic]) -> Bools | None:
    """Return the road cells of a mask, or None if the tile has no such layer."""
    layer = tile.layer(name)
    if layer is None:
        return None
    values = mosaics[name].values
    road: Bools = np.isin(values, layer.values) if layer.values else np.nan_to_num(values) != 0
    return road
