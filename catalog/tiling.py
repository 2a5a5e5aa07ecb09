"""Cut the area that rasters cover into tiles on an absolute grid.

The files of a survey rarely match the tiles, so each tile lists every file within `REACH_M` of it.
"""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from flexroad.catalog.crs import bounds_in, in_plan, is_projected, plan_unit, same, scales, short
from flexroad.catalog.crs_checks import elsewhere, require_scale
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import FARTHEST, LATTICE_TOLERANCE, Bounds, Grid, is_whole, union
from flexroad.catalog.index import Catalog
from flexroad.catalog.scan.cell_values import height_share
from flexroad.catalog.scan.rasters import RasterFile, require_metric, zoned
from flexroad.catalog.skipped import Skipped, lines
from flexroad.catalog.text import count, some
from flexroad.catalog.tile import HEIGHTS, LAYERS, MIN_COVER, REACH_M, RECENT, Layer, Tile, by_cover

MASKS = ("road_mask", "reference_road")
MAX_CELL_RATIO = 50
"""DSM files whose cells are larger than most height files' by more than this factor are left out."""
CELLS = (1.0, 2.0, 2.5, 5.0)
"""Cell sizes of tiles whose DSM is reprojected (m): these numbers times powers of ten."""
MAX_TILE_M = 2000
"""Largest size of a tile that is proposed (m)."""
AT_ONCE = 10_000
"""Number of tiles whose neighbours are found at a time: polygons of tiles take much memory."""


@dataclass(frozen=True)
class Conversion:
    """How files in other CRSs and units are used."""

    reproject: bool = False
    """Whether files in another CRS are warped when they are read; else their tiles fail."""
    to_crs: str | None = None
    """CRS of the tiles; None: the CRS of most DSM files, which must be in metres."""
    height_unit: str | None = None
    """Unit of heights, a key of `to_metres.HEIGHT_UNITS`, of files that declare no unit."""

    def __post_init__(self) -> None:
        if self.to_crs and not self.reproject:
            raise CatalogError(f"--to-crs {self.to_crs} needs --reproject")
        if self.to_crs and not (is_projected(self.to_crs) and plan_unit(self.to_crs)[1] == 1):
            raise CatalogError(
                f"--to-crs {self.to_crs} is in {plan_unit(self.to_crs)[0]}; "
                "give a projected CRS in metres, such as EPSG:25832"
            )


NO_CONVERSION = Conversion()


@dataclass(frozen=True)
class TilingResult:
    """The tiles of a folder."""

    tiles: tuple[Tile, ...]
    """In the order of their ids."""
    notes: tuple[str, ...]
    """Notes on assumptions and on tiles that were left out, one line each."""
    skipped: tuple[Skipped, ...] = ()
    """The files and folders that cannot be used: the tiles lack their cells."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """The skipped files, one line per reason."""
        return tuple(lines(self.skipped))

    @property
    def catalog(self) -> Catalog:
        """The catalog of the tiles."""
        return Catalog(self.tiles, self.skipped)

    def after(self, notes: Sequence[str], skipped: Sequence[Skipped]) -> TilingResult:
        """Return the result with earlier notes and skipped files before its own."""
        return replace(self, notes=(*notes, *self.notes), skipped=(*skipped, *self.skipped))


class _PlacedFile(NamedTuple):
    file: RasterFile
    bounds: Bounds
    """In the tiles' CRS (m)."""


class _OnTile(NamedTuple):
    """The files of one layer that overlap one tile by more than `LATTICE_TOLERANCE`, in the order given."""

    files: list[RasterFile]
    shared: NDArray[np.float64]
    """Intersection of each file with the tile, ``(n, 4)``: west, south, east, north (m)."""


@dataclass(frozen=True, eq=False)
class _NearFiles:
    """The files of one layer near each tile, in a few arrays, because objects would take gigabytes."""

    files: Sequence[_PlacedFile]
    ends: NDArray[np.intp]
    """End of each tile's entries in the arrays below, after a zero, ``(tiles + 1,)``."""
    numbers: NDArray[np.int32]
    """Numbers of the files within `REACH_M`, by tile, in the order given, ``(m,)``."""
    in_core: NDArray[np.bool_]
    """Whether the file overlaps the tile itself by more than `LATTICE_TOLERANCE`, ``(m,)``."""
    shared: NDArray[np.float64]
    """Intersection of the file with the tile, ``(m, 4)``: west, south, east, north (m)."""

    def near(self, tile: int) -> tuple[int, ...]:
        """Return the numbers of the files near a tile."""
        return tuple(self.numbers[self.ends[tile] : self.ends[tile + 1]].tolist())

    def on(self, tile: int) -> _OnTile:
        """Return the files on a tile."""
        entries = slice(self.ends[tile], self.ends[tile + 1])
        core = self.in_core[entries]
        numbers = self.numbers[entries][core].tolist()
        return _OnTile([self.files[number].file for number in numbers], self.shared[entries][core])


def cut(
    root: Path,
    layer_files: Mapping[str, Sequence[RasterFile]],
    *,
    road_values: tuple[int, ...] = (),
    tile_size_m: float = 250,
    date: datetime | None = None,
    crs: str | None = None,
    min_cover: float = MIN_COVER,
    dataset: str = "",
    conversion: Conversion = NO_CONVERSION,
) -> TilingResult:
    """Cut the area that the DSM files cover into tiles.

    - `root`: the folder that the files' names are relative to, resolved.
    - `layer_files`: files by layer name (see `catalog.LAYERS`), at least one each; ``dsm`` is required. Where
      files overlap, the first one with a value is used.
    - `road_values`: cell values that mean road in the masks; empty: every value but 0 and nodata.
    - `tile_size_m`: edge of a tile (m); tiles lie on multiples of it in the DSM's CRS.
    - `min_cover`: tiles with a DSM height in less than this share (0 to 1) of their cells are left out, as
      `load.min_valid` would fail on them. 0 keeps all that files touch, and reads no heights.
    """
    dsm = layer_files["dsm"]
    grid_crs = Counter(file.crs for file in dsm).most_common(1)[0][0]
    if conversion.to_crs:
        grid_crs = in_plan(conversion.to_crs)
        area = bounds_in(grid_crs, dsm[0].crs, dsm[0].bounds)
        if np.isfinite(area).all():
            require_scale(f"--to-crs {conversion.to_crs}", grid_crs, area, "give --to-crs {zone}")
    else:
        require_metric(next(file for file in dsm if file.crs == grid_crs), "--reproject")
    placed, skipped = {}, list[Skipped]()
    for name in (name for name in LAYERS if name in layer_files):
        placed[name], lost = _place(root, name, layer_files[name], grid_crs)
        skipped += lost
    placed["dsm"], huge = _alike(root, placed)
    skipped += huge
    notes = [note for name, files in placed.items() for note in _other_crs(name, files, grid_crs, conversion)]

    grids = _cut(placed["dsm"], grid_crs, tile_size_m)
    grids, uncovered = _covered(root, grids, _near(grids, placed["dsm"]), min_cover, conversion.reproject)
    if not any(file.crs == grid_crs for file in dsm):
        notes.append(f"the tiles have cells of {next(iter(grids.values())).cell:g} m")
    near = {name: _near(grids, files) for name, files in placed.items()}
    for name, files in near.items():
        if not files.numbers.size:
            raise CatalogError(_far(name, placed[name], grids))
    # This is decided for the complete layer, so that all tiles describe it in the same way.
    bare = {name: None if all(p.file.has_crs for p in files) else crs for name, files in placed.items()}
    others = {name: any(not same(p.file.crs, grid_crs) for p in files) for name, files in placed.items()}
    values = dict.fromkeys(MASKS, road_values)
    layers = [
        (near[name], _layers(name, files, values.get(name, ()), bare[name], conversion, others[name]))
        for name, files in placed.items()
    ]
    tiles = []
    for position, (tile_id, grid) in enumerate(grids.items()):
        own = [layer(numbers) for files, layer in layers if (numbers := files.near(position))]
        covering, nearby = by_cover(own, grid)
        survey_date = taken(near["dsm"].on(position).files, date)
        tiles.append(Tile(tile_id, grid, covering, str(root), *survey_date, dataset=dataset, nearby=nearby))
    return TilingResult(tuple(tiles), (*notes, *uncovered, *assumed(tiles)), tuple(skipped))


def _place(
    root: Path, layer: str, files: Sequence[RasterFile], crs: str
) -> tuple[list[_PlacedFile], list[Skipped]]:
    """Return the files with their bounds in the tiles' CRS, and those without a position in it."""
    kept, lost = list[_PlacedFile](), list[Skipped]()
    for file in files:
        bounds = file.bounds if same(file.crs, crs) else bounds_in(crs, file.crs, file.bounds)
        # The comparison is also false for NaN.
        if np.abs(bounds).max() <= FARTHEST:
            kept.append(_PlacedFile(file, bounds))
            continue
        reason = (
            f"in {short(file.crs)} it has no position in {short(crs)}, the CRS of the dsm; "
            "correct its CRS with `gdal_edit.py -a_srs`"
        )
        lost.append(Skipped(file.name, layer, reason, str(root)))
    if not kept:
        raise CatalogError(f"no usable file of the layer {layer}; {lines(lost)[0]}")
    return kept, lost


def _alike(
    root: Path, placed: Mapping[str, Sequence[_PlacedFile]]
) -> tuple[list[_PlacedFile], list[Skipped]]:
    """Return the DSM files without files of huge cells, which would be cut into millions of tiles."""
    usual = statistics.median_high(_cell_size(entry) for name in HEIGHTS for entry in placed.get(name, ()))
    kept, huge = list[_PlacedFile](), list[Skipped]()
    for entry in placed["dsm"]:
        if _cell_size(entry) <= MAX_CELL_RATIO * usual:
            kept.append(entry)
            continue
        reason = (
            f"it has cells of {_cell_size(entry):g} m, while most files of heights have {usual:g} m; "
            "correct its georeference, or resample it with gdalwarp -tr"
        )
        huge.append(Skipped(entry.file.name, "dsm", reason, str(root)))
    if not kept:
        raise CatalogError(f"no usable file of the layer dsm; {lines(huge)[0]}")
    return kept, huge


def _cell_size(placed: _PlacedFile) -> float:
    """Return the larger side of a file's cells in the tiles' CRS (m)."""
    west, south, east, north = placed.bounds
    return max((east - west) / placed.file.width, (north - south) / placed.file.height)


def _other_crs(layer: str, files: Sequence[_PlacedFile], crs: str, conversion: Conversion) -> Iterator[str]:
    """Yield notes on files in another CRS: they are reprojected, or the tiles that they overlap will fail."""
    others = [placed.file for placed in files if not same(placed.file.crs, crs)]
    if not others:
        return
    names = some([file.name for file in others])
    differs = f"{layer} is in {short(others[0].crs)}, not {short(crs)}, in {names}"
    if not conversion.reproject:
        yield f"{differs}: tiles there will fail; --reproject warps such files when they are read"
        return
    how = "to the nearest cell" if layer in MASKS else "bilinearly"
    yield f"{differs}: reprojected when it is read, {how}"
    unknown = [file for file in others if not file.height_unit and plan_unit(file.crs)[1] != 1]
    feet = [file for file in unknown if is_projected(file.crs)]
    if layer in HEIGHTS and feet and not conversion.height_unit:
        yield (
            f"{layer}: heights of {some([file.name for file in feet])} are assumed to be in "
            f"{plan_unit(feet[0].crs)[0]}, like x and y; if not, use --height-unit metre"
        )


def _cut(dsm: Sequence[_PlacedFile], crs: str, size_m: float) -> dict[str, Grid]:
    """Return the grids of the tiles that the DSM files touch, by id, with the most frequent cell size."""
    cells = Counter(p.file.cell for p in dsm if p.file.crs == crs)
    cell = cells.most_common(1)[0][0] if cells else _cell_m(dsm[0], crs)
    _check_cell(next((p.file.name for p in dsm if p.file.cell == cell), dsm[0].file.name), cell, size_m)
    grids: dict[str, Grid] = {}
    for file, bounds in dsm:
        if file.crs == crs and file.cell == cell:
            extent = Grid(crs, bounds[0], bounds[3], cell, file.width, file.height)
        else:
            extent = Grid.covering(crs, bounds, cell)
        grids.update(extent.tiles(size_m))
    return dict(sorted(grids.items()))


def _check_cell(name: str, cell: float, size_m: float) -> None:
    """Raise an error if the size of a tile is not a whole number of the cells of its DSM."""
    if not 0 < size_m < math.inf or size_m != int(size_m) or is_whole(size_m / cell):
        return
    rounded = _nearest_cell(cell)
    fault = f"a tile of {size_m:g} m has no whole number of the cells of {cell:g} m of {name}"
    sizes = (size for size in range(int(size_m) + 1, MAX_TILE_M) if is_whole(size / cell))
    larger = next(sizes, None)
    if math.isclose(cell, rounded, rel_tol=0.01) or larger is None:
        new = Path(name).stem + "_new.tif"
        remedy = f"round them: gdalwarp -tr {rounded:g} {rounded:g} -tap -r bilinear {name} {new}"
    else:
        remedy = f"use --tile-size {larger}"
    raise CatalogError(f"{fault}; {remedy}")


def _nearest_cell(true_m: float) -> float:
    """Return the nearest of `CELLS` (m)."""
    power = 10.0 ** math.floor(math.log10(true_m))
    return min((size * power for size in (*CELLS, 10.0)), key=lambda size: abs(math.log(size / true_m)))


def _cell_m(placed: _PlacedFile, crs: str) -> float:
    """Return the cell of tiles whose DSM is reprojected (m).

    It is the file's cell if that is in metres and nearly as large on the ground, else the nearest of `CELLS`.
    """
    file, (west, south, east, north) = placed
    across, along = scales(crs, file.crs, (west + east) / 2, (south + north) / 2)
    true_m = file.cell / max(across, along)
    is_metric = is_projected(file.crs) and plan_unit(file.crs)[1] == 1
    if is_metric and math.isclose(true_m, file.cell, rel_tol=0.01):
        return file.cell
    return _nearest_cell(true_m)


def _near(grids: Mapping[str, Grid], files: Sequence[_PlacedFile]) -> _NearFiles:
    """Return the files near each tile, in the order of the tiles."""
    edges = chain.from_iterable(grid.bounds for grid in grids.values())
    cores = np.fromiter(edges, np.float64, 4 * len(grids)).reshape(-1, 4)
    extents = np.array([placed.bounds for placed in files])
    tree = shapely.STRtree(shapely.box(*extents.T))
    pairs = []
    for begin in range(0, len(cores), AT_ONCE):
        around = cores[begin : begin + AT_ONCE] + REACH_M * np.array([-1, -1, 1, 1])
        tile, file = tree.query(shapely.box(*around.T))
        order = np.lexsort((file, tile))
        pairs.append((tile[order] + begin, file[order].astype(np.int32)))
    tile, file = (np.concatenate(column) for column in zip(*pairs, strict=True))
    shared = np.hstack(
        [np.maximum(cores[tile, :2], extents[file, :2]), np.minimum(cores[tile, 2:], extents[file, 2:])]
    )
    cell = next(iter(grids.values())).cell
    in_core = (shared[:, 2:] - shared[:, :2]).min(axis=1) > LATTICE_TOLERANCE * cell
    return _NearFiles(files, np.searchsorted(tile, np.arange(len(grids) + 1)), file, in_core, shared)


def _far(name: str, files: Sequence[_PlacedFile], grids: Mapping[str, Grid]) -> str:
    """Return the message that a layer reaches no tile, with the places of both."""
    first = files[0].file
    bounds = union(placed.file.bounds for placed in files if placed.file.crs == first.crs)
    target, ground = next(iter(grids.values())).crs, union(grid.bounds for grid in grids.values())
    names = some([placed.file.name for placed in files])
    return f"{name} reaches no tile: {names} {elsewhere(first.crs, bounds, target, ground, REACH_M)}"


def _covered(
    root: Path, grids: Mapping[str, Grid], near: _NearFiles, min_cover: float, reproject: bool
) -> tuple[dict[str, Grid], list[str]]:
    """Return the tiles with a DSM on at least ``min_cover`` of their cells, and notes on the other tiles."""
    kept, thin, empty, risky = dict[str, Grid](), list[str](), list[str](), list[str]()
    for position, (tile_id, grid) in enumerate(grids.items()):
        dsm = near.on(position)
        cover = _cover(root, grid, dsm, min_cover, reproject)
        if cover >= max(min_cover, 1e-9):
            kept[tile_id] = grid
            risky += [tile_id] if min_cover and cover < MIN_COVER else []
        elif cover:
            thin.append(tile_id)
        elif dsm.files:
            empty.append(tile_id)
    note = (
        f"left out {count(len(thin), 'tile')} with a DSM height in less than {min_cover:.0%} of the cells "
        f"(--min-cover 0 keeps them): {some(thin)}"
    )
    void = f"left out {count(len(empty), 'tile')} where the DSM has only nodata: {some(empty)}"
    notes = [note] * bool(thin or not empty) + [void] * bool(empty)
    if not kept:
        raise CatalogError(f"no tile is left: {'; '.join(notes)}")
    below = (
        f"{count(len(risky), 'tile')} with a DSM height in less than {MIN_COVER:.0%} of the cells will fail, "
        f"unless the configuration sets load: {{min_valid: {min_cover:g}}}: {some(risky)}"
    )
    return kept, [note] * bool(thin) + [void] * bool(empty) + [below] * bool(risky)


def _cover(root: Path, grid: Grid, dsm: _OnTile, min_cover: float, reproject: bool) -> float:
    """Return the share of a tile that the DSM covers: by heights, or by the extents of the files."""
    covered_m2 = float(shapely.union_all(shapely.box(*dsm.shared.T)).area)
    by_extents = covered_m2 / (grid.width * grid.cell) ** 2
    others = [file for file in dsm.files if not same(file.crs, grid.crs)]
    if not min_cover or by_extents < min_cover or (others and not reproject):
        return by_extents
    bare = next((file.crs for file in dsm.files if not file.has_crs), None)
    by_heights = height_share(grid, [root / file.name for file in dsm.files], crs=bare)
    return by_extents if by_heights is None else by_heights


def _layers(
    name: str,
    files: Sequence[_PlacedFile],
    values: tuple[int, ...],
    crs: str | None,
    conversion: Conversion,
    has_others: bool,
) -> Callable[[tuple[int, ...]], Layer]:
    """Return the function that makes a layer of files given by their numbers; neighbouring tiles share it.

    ``has_others`` is whether files of the layer are in another CRS than the tiles.
    """
    unit = conversion.height_unit if name in HEIGHTS else None
    reproject = conversion.reproject and has_others

    @lru_cache(RECENT)
    def layer(numbers: tuple[int, ...]) -> Layer:
        names = tuple(files[number].file.name for number in numbers)
        extents = tuple(files[number].bounds for number in numbers)
        return Layer(name, names, values, crs, extents, reproject, height_unit=unit)

    return layer


def taken(dsm: Sequence[RasterFile], date: datetime | None = None) -> tuple[datetime, bool]:
    """Return the date of a tile's DSM (``date`` overrides its files), and whether it is only assumed."""
    known = date or next((file.taken for file in dsm if file.taken), None)
    return (zoned(known), False) if known else (dsm[0].modified, True)


def assumed(tiles: Sequence[Tile]) -> list[str]:
    """Return a note on the tiles whose date is only assumed; empty without such tiles."""
    undated = [tile.id for tile in tiles if tile.datetime_assumed]
    note = f"no date in the dsm of {count(len(undated), 'tile')}: the files' times are used instead"
    return [f"{note} (--date sets it)"] * bool(undated)
