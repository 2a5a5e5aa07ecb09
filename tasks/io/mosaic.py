"""One layer on a grid: a mosaic of the files that a tile lists for the layer.

A tile also lists files around it. A file that cannot be used is left out, and fails only tiles that need it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.crs import bounds_in, in_plan, same, short
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.grid import FARTHEST, Bounds, overlap
from flexroad.catalog.guard.open_raster import kept_raster
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import edges
from flexroad.catalog.tile import HEIGHTS, TOUCH_M
from flexroad.tasks.errors import TaskError, Unusable, leave_out
from flexroad.tasks.io.height_units import (
    absurd_note,
    converted_note,
    in_metres,
    smaller_unit_fault,
    with_unit,
)
from flexroad.tasks.io.raster import RasterWindow, misalignment, read_raster, read_window
from flexroad.tasks.io.raster_grid import header
from flexroad.tasks.io.sheets import covered, lay_classes, lay_heights, reach_m, shared_m2
from flexroad.tasks.types import Bools, Floats


@dataclass(frozen=True)
class SourceFile:
    """One file of a layer, as the catalog lists it."""

    title: str
    """Name of the file in messages: ``dsm a.tif``."""
    path: Location
    extent: Bounds | None
    """West, south, east and north in the catalog (m, in the tile's CRS), None if they are unknown."""

    def may_lie_on(self, grid: Grid) -> bool:
        """Return whether the file may lie on a grid, by its extent in the catalog."""
        return self.extent is None or overlap(self.extent, grid.bounds, TOUCH_M)


@dataclass(frozen=True, eq=False)
class Mosaic:
    """One layer on the tile's lattice."""

    values: Floats
    """``(H, W)``, heights in m or class values; NaN where no file has a value."""
    grid: Grid
    """The lattice."""
    layer: Layer
    files: tuple[SourceFile, ...]
    """All files of the layer, also files that are not read."""
    patches: tuple[RasterWindow, ...]
    """The parts read, in the order of the files."""
    notes: tuple[str, ...]
    left_out: tuple[tuple[SourceFile, Unusable], ...]
    """Files that cannot be used completely or in part."""

    def reached(self, core: Grid) -> Bools:
        """Return the cells of a tile within the bounds of a file that was read there, ``(h, w)``."""
        cells = np.zeros(core.shape, np.bool_)
        for patch in self.patches:
            cells |= patch.reached(core)
        return cells

    def main_file(self, core: Grid) -> SourceFile:
        """Return the file that covers most of a tile, by its extent in the catalog, else by its read part."""
        read = {patch.file: patch.lattice.bounds for patch in self.patches if not patch.lattice.crs}
        return max(
            self.files, key=lambda file: shared_m2(file.extent or read.get(str(file.path)), core.bounds)
        )

    def check_read(self, core: Grid) -> None:
        """Raise an error if the tile itself has no file of the layer, or needs a file that is left out."""
        main = self.main_file(core) if self.left_out else None
        left_out = sorted(self.left_out, key=lambda pair: pair[0] != main)
        needed = [error for file, error in left_out if file.may_lie_on(core)]
        if needed and not self.reached(core).all():
            raise TaskError(str(needed[0]), needed[0].file)
        if not self.patches:
            raise TaskError(
                f"no {self.layer.name} file overlaps the tile ({edges(self.grid.bounds)}): "
                f"{', '.join(self.layer.files[:3])}; build the catalog again",
                str(self.files[0].path),
            )

    def check_valid(self, tile: Tile, min_valid: float) -> None:
        """Raise an error if the layer has no heights on the tile, or in less than a share of its cells."""
        share = 1 - np.isnan(self.values[self.grid.window(tile.grid)]).mean()
        if share > 0 and share >= min_valid:
            return
        main = self.main_file(tile.grid)
        for file, error in self.left_out:
            if file == main:
                raise TaskError(str(error), error.file)
        if share > 0:
            fault = (
                f" has {share:.1%} valid cells on this tile, below {min_valid:.0%}; "
                "lower load.min_valid to keep such tiles"
            )
        else:
            patch = _window(tile, self.layer, main, tile.grid, tile.grid)
            declare = ", or declare that unit with gdal_edit.py -units"
            smaller = smaller_unit_fault(with_unit(patch, self.layer), declare) if patch else None
            fault = smaller or " has only nodata on this tile; leave the tile out"
        raise TaskError(f"{main.title}{fault}", str(main.path))


def read_mosaic(tile: Tile, layer: Layer, grid: Grid, core: Grid, around: bool = False) -> Mosaic:
    """Return a layer on a grid; files that cannot be used are left out.

    - `tile`: with the files to read (`Tile.within`, `Tile.around`).
    - `core`: the tile of the files: it is the position of a file without georeference and of unknown extent.
    - `around`: whether the grid is ground around tiles: then no check whether files have moved.
    """
    files = _files(tile, layer)
    read, left_out, absurd_cells = _read(tile, layer, files, grid, core, around)
    patches = [patch for _, patch in read]
    if layer.name not in HEIGHTS:
        values = lay_classes(patches, grid)
    elif around or (margin_m := reach_m(patches, grid) - (core.west - grid.west)) <= 0:
        values = lay_heights(patches, grid)
    else:
        wide = grid.buffered(margin_m)
        more, beyond, _ = _read(tile, layer, files, wide, core, around=True)
        values = lay_heights([patch for _, patch in more], wide)[wide.window(grid)]
        _notes_left_out(more, beyond)
    notes = _notes(layer, patches, grid)
    notes += _notes_left_out(read, left_out)
    in_part = [(file, patch.fault) for file, patch in read if patch.fault]
    if absurd_cells:
        notes.append(absurd_note(layer.name, absurd_cells))
    return Mosaic(values, grid, layer, files, tuple(patches), tuple(notes), (*left_out, *in_part))


def _read(
    tile: Tile, layer: Layer, files: Sequence[SourceFile], grid: Grid, core: Grid, around: bool
) -> tuple[list[tuple[SourceFile, RasterWindow]], list[tuple[SourceFile, Unusable]], int]:
    """Return parts of files until the grid is covered, files left out, and the number of absurd heights.

    The other parameters are as in `read_mosaic`.
    """
    read: list[tuple[SourceFile, RasterWindow]] = []
    left_out: list[tuple[SourceFile, Unusable]] = []
    absurd_cells, area_m2 = 0, 0.0
    missing, unchecked = np.ones(grid.shape, np.bool_), list[RasterWindow]()
    for file in files:
        try:
            patch = _window(tile, layer, file, grid, core)
            if not around:
                _check_place(tile, layer, file, patch)
            if patch and layer.name in HEIGHTS:
                patch, absurd = in_metres(with_unit(patch, layer))
                absurd_cells += absurd
        except Unusable as error:
            left_out.append((file, error))
            continue
        if patch is None:
            continue
        read.append((file, patch))
        if patch.lattice.crs:
            continue
        unchecked.append(patch)
        area_m2 += shared_m2(patch.lattice.bounds, grid.bounds)
        # Cells are compared only if the areas of the files are large enough.
        if file is not files[-1] and area_m2 / grid.cell**2 >= 0.999 * missing.size:
            while unchecked:
                missing &= ~covered(unchecked.pop(), grid)
            if not missing.any():
                break
    return read, left_out, absurd_cells


def _notes_left_out(
    read: Iterable[tuple[SourceFile, RasterWindow]], left_out: Iterable[tuple[SourceFile, Unusable]]
) -> list[str]:
    """Record the files that are left out completely or in part; return a note on each."""
    return [
        *(leave_out(error) for _, error in left_out),
        *(leave_out(patch.fault, patch.unreadable) for _, patch in read if patch.fault),
    ]


def _files(tile: Tile, layer: Layer) -> tuple[SourceFile, ...]:
    extents: Iterable[Bounds | None] = layer.extents or [None] * len(layer.files)
    return tuple(
        SourceFile(f"{layer.name} {name}", path, extent)
        for name, path, extent in zip(layer.files, tile.paths(layer), extents, strict=True)
    )


def _window(tile: Tile, layer: Layer, file: SourceFile, grid: Grid, core: Grid) -> RasterWindow | None:
    """Return the part of a file that covers a grid, or None; see `read_window`."""
    heights = layer.name in HEIGHTS
    if file.extent and max(map(abs, file.extent)) <= FARTHEST:
        # A file without georeference has the same position for all tiles.
        core = Grid.covering(core.crs, file.extent, core.cell)
    return read_window(file.path, file.title, grid, core, layer.crs, heights, layer.reproject, tile.missing)


def _check_place(tile: Tile, layer: Layer, file: SourceFile, patch: RasterWindow | None) -> None:
    """Raise an error if a file lies on the tile by the catalog, but not by its present position.

    Its bounds are compared with the catalog, because an extent in another CRS is larger than the file.
    """
    core = tile.grid
    # Files of neighbouring tiles only touch the tile.
    if not (file.extent and shared_m2(file.extent, core.bounds)):
        return
    lattice = patch.lattice if patch else None
    if lattice and (lattice.reached(core).any() if lattice.crs else shared_m2(lattice.bounds, core.bounds)):
        return
    found = read_raster(file.path, file.title, header, kept_raster, tile.missing)
    if found.lattice is None:
        return
    bounds = found.lattice.bounds
    crs = in_plan(crs_of(found.crs, layer.crs, bounds) or core.crs)
    now = bounds if same(crs, core.crs) else bounds_in(core.crs, crs, bounds)
    if all(abs(a - b) <= core.cell for a, b in zip(now, file.extent, strict=True)):
        return
    raise Unusable(
        f"{file.title} does not reach the tile now: it lies at {edges(bounds)} in {short(crs)}, "
        "elsewhere than the catalog says; build the catalog again",
        str(file.path),
    )


def _notes(layer: Layer, patches: Sequence[RasterWindow], grid: Grid) -> list[str]:
    """Return notes on patches that were resampled or reprojected, and on units that were assumed."""
    notes = []
    for patch in patches:
        if reason := misalignment(patch.file_lattice, grid):
            how = "reprojected" if patch.lattice.crs else "resampled"
            notes.append(f"{layer.name} {how}: {reason}")
        if patch.unit_assumed:
            notes.append(f"{layer.name}: heights taken to be in {patch.unit}, as the file declares no unit")
        if layer.name in HEIGHTS and (converted := converted_note(layer.name, patch)):
            notes.append(converted)
    return list(dict.fromkeys(notes))
