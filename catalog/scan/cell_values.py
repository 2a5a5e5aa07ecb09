"""Values of the cells of rasters: the share of a tile with heights, road masks, undeclared voids."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.windows import Window

from flexroad.catalog.crs import same, transformer
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Grid
from flexroad.catalog.guard.open_raster import ERRORS, kept_raster, open_raster
from flexroad.catalog.scan.rasters import georeference_fault, heights_fault, quiet, read_valid
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import some

LOWEST, HIGHEST = -9000.0, 1e6
"""Values outside are undeclared nodata (-9999, 3e38) in any unit; `load` knows the unit and is stricter."""
MAX_CELLS = 100_000_000
"""Largest number of cells that are read of one raster for one tile."""
AS_TEXT = (".xyz", ".gz", ".asc", ".txt")
"""Endings of formats that cannot be read in parts: their files are assumed to have no gaps."""


def height_share(grid: Grid, paths: Iterable[Location], crs: str | None = None) -> float | None:
    """Return the share (0 to 1) of a grid's cells whose centre has a height in one of the rasters.

    - `crs`: CRS of rasters without one; None: the grid's.
    - result: None if a raster cannot be read, or not in parts, or has far finer cells than the grid.
    """
    known = np.zeros(grid.shape, np.bool_)
    for path in paths:
        if Path(str(path)).suffix.lower() in AS_TEXT:
            return None
        try:
            # Neighbouring tiles lie on the same files.
            with quiet(), kept_raster(path) as raster:
                own_crs = crs_of(raster.crs.to_wkt() if raster.crs else None, crs, raster.bounds)
                if not _add(known, grid, raster, own_crs):
                    return None
        except (*ERRORS, CatalogError):
            return None
    return float(known.mean())


def _add(known: NDArray[Any], grid: Grid, raster: Any, crs: str | None) -> bool:
    """Set the cells of a grid that have a height in an open raster; return whether it could be read."""
    affine = raster.transform
    if georeference_fault(raster) or heights_fault(raster) or affine.b or affine.d:
        return False
    x, y = np.meshgrid(grid.eastings, grid.northings, sparse=True)
    if crs and not same(crs, grid.crs):
        x, y = transformer(grid.crs, crs).transform(*np.meshgrid(grid.eastings, grid.northings))
    columns, rows = np.floor((x - affine.c) / affine.a), np.floor((y - affine.f) / affine.e)
    inside = (columns >= 0) & (columns < raster.width) & (rows >= 0) & (rows < raster.height)
    if not inside.any():
        return True
    columns, rows = (np.broadcast_to(part, grid.shape)[inside].astype(np.int32) for part in (columns, rows))
    left, top = columns.min(), rows.min()
    window = Window(left, top, columns.max() - left + 1, rows.max() - top + 1)
    if window.width * window.height > MAX_CELLS:
        return False
    values = read_valid(raster, window=window)[rows - top, columns - left]
    heights = np.ma.filled(values * raster.scales[0] + raster.offsets[0], np.nan)
    with np.errstate(invalid="ignore"):
        known[inside] |= (heights > LOWEST) & (heights < HIGHEST)
    return True


MOST_MASKS = 8
"""Largest number of files of a mask that are read."""
SIDE = 1024
"""A file of at most this many cells along each axis is read completely."""
PARTS = 4
"""Of a larger file, this many squares along each axis are read, with as many cells in sum."""
MOST_SHOWN = 8
"""Largest number of values in a note."""


def mask_notes(root: Path, layer: str, names: Sequence[str], road_values: Sequence[int]) -> list[str]:
    """Return a note if the values of a mask do not fit the values that mean road; else empty.

    Parts of some files are read, so that the time does not depend on the size of the survey.
    """
    step = -(-len(names) // MOST_MASKS)
    values, has_nodata, read = set[float](), False, list[str]()
    for name in names[::step]:
        if Path(name).suffix.lower() in AS_TEXT:
            continue
        try:
            found, lacks_some = _values(root / name)
        except ERRORS:
            continue
        values |= found
        has_nodata |= lacks_some
        read.append(name)
    note = values_note(values, road_values, has_nodata, "--road-value") if values else ""
    return [f"{layer}: {note}, in the parts read of {some(read)}"] if note else []


def values_note(values: set[float], road_values: Sequence[int], has_nodata: bool, option: str) -> str:
    """Return why the values of a mask do not fit the values that mean road; empty if they may fit.

    - `values`: values of its cells without nodata, at least one.
    - `road_values`: values that mean road; empty: every value but 0 and nodata.
    - `option`: name of the option that has ``road_values``.
    """
    ordered = sorted(values)
    listed = ", ".join(f"{value:g}" for value in ordered[:MOST_SHOWN])
    listed += f" and {len(ordered) - MOST_SHOWN} more" if len(ordered) > MOST_SHOWN else ""
    if road_values:
        wanted = " or ".join(map(str, road_values))
        return "" if values & set(road_values) else f"no cell has {option} {wanted} but {listed}"
    if has_fractions(values):
        return f"values are {listed}, as of probabilities, and all but 0 count as road; give 0 and 1"
    if len(values - {0.0}) > 1:
        return f"values are {listed}, and all but 0 count as road; name the roads' with {option}"
    if 0.0 not in values and not has_nodata:
        return f"every cell counts as road, with the value {listed}; name the roads' with {option}"
    return ""


def has_fractions(values: set[float]) -> bool:
    """Return whether some values are not whole numbers, so that they are not classes."""
    return not all(value.is_integer() for value in values)


def _values(path: Path) -> tuple[set[float], bool]:
    """Return the values of the first band in parts of a raster, and whether cells of them are nodata."""
    values, has_nodata = set[float](), False
    with quiet(), open_raster(path) as raster:
        for window in windows(raster):
            cells = read_valid(raster, window=window)
            values |= set(np.unique(cells.compressed()).astype(float).tolist())
            has_nodata |= bool(np.ma.getmaskarray(cells).any())
    return values, has_nodata


def windows(raster: Any) -> Iterator[Window]:
    """Yield the window of a complete small raster, or squares spread over a large raster."""
    if max(raster.shape) <= SIDE:
        yield Window(0, 0, raster.width, raster.height)
        return
    size = SIDE // PARTS
    for row in range(PARTS):
        for column in range(PARTS):
            top = max(0, (raster.height - size) * row // (PARTS - 1))
            left = max(0, (raster.width - size) * column // (PARTS - 1))
            yield Window(left, top, min(size, raster.width), min(size, raster.height))


SHARE = 0.05
"""Smallest share of a file's cells that is noted."""
ALONE = 3
"""Whole numbers are noted if they are so many times as frequent as the next lower and higher number: heights
in whole units share values without voids."""
MOST_HEIGHTS = 16
"""Largest number of files of a layer of heights that are read."""
MAX_TEXT_BYTES = 32_000_000
"""Larger files of text are not read: their cells cannot be read in parts."""


def plateau_notes(layer: str, files: Mapping[str, Location]) -> list[str]:
    """Return a note on each exact height that many cells of a file have, with their share.

    Parts of some files are read, so that the time does not depend on the size of the survey.
    """
    step = -(-len(files) // MOST_HEIGHTS) or 1
    by_value: dict[tuple[float, float], list[str]] = defaultdict(list)
    for name in list(files)[::step]:
        for height, value, share in _plateaus(files[name]):
            by_value[height, value].append(f"{name} ({share:.1%})")
    # GDAL takes the value in the file, before its scale and offset, and all its digits.
    return [
        f"{layer}: many cells have the exact height {height:g}: {some(names)}; if they are voids, "
        f"declare it, e.g. gdal_translate -a_nodata {value:.17g} FILE NEW.tif"
        for (height, value), names in by_value.items()
    ]


def _plateaus(path: Location) -> Iterable[tuple[float, float, float]]:
    """Return heights that many cells of a raster have, the values in the file, and the shares (0 to 1)."""
    suffix = Path(str(path)).suffix.lower()
    try:
        if suffix == ".gz" or (suffix in AS_TEXT and Path(str(path)).stat().st_size > MAX_TEXT_BYTES):
            return []
        with quiet(), open_raster(path) as raster:
            parts = [read_valid(raster, window=window) for window in windows(raster)]
            scale, offset = raster.scales[0], raster.offsets[0]
    except ERRORS:
        return []
    values, counts = np.unique(np.concatenate([part.compressed() for part in parts]), return_counts=True)
    cells = sum(part.size for part in parts)
    if counts.max(initial=0) == cells:
        # A file whose cells all have one height has no voids.
        return []
    return [
        (float(values[n] * scale + offset), float(values[n]), float(counts[n] / cells))
        for n in np.flatnonzero((counts > SHARE * cells) & np.isfinite(values))
        if not np.issubdtype(values.dtype, np.integer) or _is_alone(values, counts, int(n))
    ]


def _is_alone(values: Any, counts: Any, n: int) -> bool:
    """Return whether a whole number is far more frequent than its two neighbours."""
    beside: Sequence[int] = [k for k in (n - 1, n + 1) if 0 <= k < len(values)]
    near = [counts[k] for k in beside if abs(int(values[k]) - int(values[n])) == 1]
    return not near or bool(counts[n] > ALONE * max(near))
