"""Step A of the paper, geospatial data acquisition: the rasters R^DSM and R^DTM of one tile on one lattice.

Files may differ in extent, lattice, unit and nodata value. The result has heights in metres (float64), row 0
in the north and NaN where there is no value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.scan.rasters import quiet
from flexroad.catalog.tile import HEIGHTS, MIN_COVER
from flexroad.tasks import options
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.dsm_and_dtm import below_ground_note, offset_note, survey_difference
from flexroad.tasks.io.height_units import check_units
from flexroad.tasks.io.mosaic import Mosaic, read_mosaic
from flexroad.tasks.types import Bools, Floats, Source, TileData

VERSION = 3

CLASSES = ("road_mask", "reference_road")
READS = HEIGHTS + CLASSES
"""Layers that are read; of other layers the result has only the file names."""
NEEDS = ("dsm", "dtm")
"""Layers without which a tile fails."""

MAX_CELLS = 25_000_000
"""Largest number of cells of a tile with its halo: 0.2 GB for each of several layers."""


class Options(options.Options):
    """Options of `load`."""

    halo_m: float = Field(
        0.0,
        ge=0,
        le=500,
        description="ground read around the tile (m), for the filter, and for a fit without shared borders; "
        "0 in the paper. Catalogs of rasters and of prepared tiles list files up to 200 m around a tile",
    )
    min_valid: float = Field(
        MIN_COVER,
        ge=0,
        le=1,
        description="share of the tile's cells that need a DSM height, or the tile fails",
    )
    road_height: Literal["dsm", "auto", "layer", "offset"] = Field(
        "dsm",
        description="heights to which roads are fitted. dsm: the highest points; layer: the catalog's "
        "road_height; auto: road_height if the tile has it, else the DSM. offset: the DSM minus its height "
        "above the DTM on open road, if both declare the same date and vertical CRS",
    )
    offset_undeclared: bool = Field(
        False,
        description="with road_height: offset, assume that DSM and DTM are of one survey if they declare no "
        "date or no vertical CRS",
    )


def load(tile: Tile, options: Options) -> TileData:
    """Read a tile's DSM, DTM, masks and reference onto its lattice, grown by the halo.

    Cells that coincide are copied; others are resampled (heights bilinearly, classes to the nearest),
    with a note. Files in another CRS are warped if the layer says so (`Layer.reproject`). Where files
    overlap, the first file with a value is used. Files in the tile's CRS come before other files.

    Raises
    ------
    TaskError
        If the tile's entry in the catalog cannot be used (`Tile.fault`), a file that the tile needs cannot be
        used (`Unusable`), the layers differ in their unit of height, the tile has no DSM or DTM, or the DSM
        covers less than ``min_valid`` of it.
    """
    if tile.fault:
        raise TaskError(tile.fault)
    for name in NEEDS + (("road_height",) if options.road_height == "layer" else ()):
        if tile.layer(name) is None:
            option = name.replace("_", "-")
            raise TaskError(f"the tile has no {name}; give its files to `flexroad catalog` with --{option}")
    grid = tile.grid.buffered(options.halo_m)
    if grid.width * grid.height > MAX_CELLS:
        raise TaskError(
            f"the tile has {grid.width} x {grid.height} cells with its halo, more than {MAX_CELLS:,}; "
            "catalog smaller tiles (--tile-size)"
        )
    tile = tile.within(grid.bounds)
    with quiet():
        mosaics = {
            layer.name: read_mosaic(tile, layer, grid, tile.grid)
            for layer in tile.layers
            if _is_read(layer, options)
        }
        for mosaic in mosaics.values():
            mosaic.check_read(tile.grid)
    check_units([patch for name in HEIGHTS if name in mosaics for patch in mosaics[name].patches])
    with quiet():
        mosaics["dsm"].check_valid(tile, options.min_valid)
        mosaics["dtm"].check_valid(tile, 0.0)
    data, remarks = _data(tile, grid, tile.grid, mosaics, options)
    # Only the tile itself is checked: the sheets of its neighbours may have other heights.
    window = grid.window(tile.grid)
    if suspect := offset_note(data.dsm[window], data.dtm[window]) or below_ground_note(data.dsm, data.dtm):
        remarks = [*remarks, suspect]
    return replace(
        data,
        reference=_reference(mosaics),
        reference_road=_road(tile, "reference_road", mosaics),
        notes=(*(note for mosaic in mosaics.values() for note in mosaic.notes), *remarks),
    )


def load_border(ground: Tile, core: Grid, options: Options) -> TileData:
    """Read the ground around a corner or an edge of tiles; it may have no data in part or everywhere.

    Files that cannot be used (`Unusable`) are left out: they fail the tiles that they lie on.

    - `ground`: the ground, with the files that reach it (`Tile.around`).
    - `core`: the tile of the files: it is the position of a file without georeference.
    - `options`: the heights to which roads are fitted. The halo is not used.
    """
    grid = ground.grid
    with quiet():
        mosaics = {
            layer.name: read_mosaic(ground, layer, grid, core, around=True)
            for layer in ground.layers
            if _is_read(layer, options)
        }
    patches = [patch for name in HEIGHTS if name in mosaics for patch in mosaics[name].patches]
    if patches:
        check_units(patches)
    data, _ = _data(ground, grid, grid, mosaics, options)
    return replace(data, dop=_optional(data.dop), roads=_optional(data.roads))


def _data(
    tile: Tile, grid: Grid, core: Grid, mosaics: Mapping[str, Mosaic], options: Options
) -> tuple[TileData, list[str]]:
    """Return the common data of a tile and of the ground around a border, and a note on heights of roads."""
    values = {name: mosaic.values for name, mosaic in mosaics.items()}
    unknown = np.full(grid.shape, np.nan)
    offset_dsm, remarks = _offset(tile, options)
    data = TileData(
        tile_id=tile.id,
        grid=grid,
        core=core,
        dsm=values.get("dsm", unknown),
        dtm=values.get("dtm", unknown),
        road_height=values.get("road_height"),
        offset_dsm=offset_dsm,
        road_mask=_road(tile, "road_mask", mosaics),
        dop=layer_source(tile, "dop"),
        roads=layer_source(tile, "roads"),
        decks=values.get("bridges"),
    )
    return data, remarks


def _is_read(layer: Layer, options: Options) -> bool:
    return layer.name in READS and (layer.name != "road_height" or options.road_height in ("auto", "layer"))


def _offset(tile: Tile, options: Options) -> tuple[bool, list[str]]:
    """Return whether roads are fitted to the DSM minus an offset, and a note if that is not possible."""
    if options.road_height != "offset":
        return False, []
    differs, undeclared = survey_difference(tile)
    unchanged = "road_height: the DSM is used without an offset, because"
    if differs:
        return False, [f"{unchanged} the DTM differs in {differs}"]
    if undeclared and not options.offset_undeclared:
        remedy = "set load.offset_undeclared if they are of one survey"
        return False, [f"{unchanged} dsm and dtm do not declare {undeclared}; {remedy}"]
    return True, []


def layer_source(tile: Tile, name: str) -> Source | None:
    """Return a layer that another stage reads, or None if the tile does not have it.

    Missing files that do not reach the tile are left out.
    """
    layer = tile.layer(name)
    if layer is None:
        return None
    needed = (layer.reaching(tile.grid.bounds) or layer).files
    paths = zip(layer.files, tile.paths(layer), strict=True)
    files = tuple(path for file, path in paths if file in needed or not tile.lacks(path))
    return Source(
        name,
        files,
        layer.crs,
        reproject=layer.reproject,
        sublayer=layer.sublayer,
        missing=tile.missing,
    )


def _optional(source: Source | None) -> Source | None:
    return replace(source, optional=True) if source else None


def _reference(mosaics: Mapping[str, Mosaic]) -> Floats | None:
    """Return the layer ``reference``, else the paper's extended DTM (DTM and bridge decks), else None."""
    if "reference" in mosaics:
        return mosaics["reference"].values
    if "bridges" not in mosaics:
        return None
    decks = mosaics["bridges"].values
    return np.where(np.isfinite(decks), decks, mosaics["dtm"].values)


def _road(tile: Tile, name: str, mosaics: Mapping[str, Mosaic]) -> Bools | None:
    """Return the road cells of a mask, or None if the tile has no such layer."""
    layer = tile.layer(name)
    if layer is None:
        return None
    values = mosaics[name].values
    road: Bools = np.isin(values, layer.values) if layer.values else (values != 0) & ~np.isnan(values)
    return road
