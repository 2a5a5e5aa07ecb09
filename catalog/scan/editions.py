"""Files of one layer that cover the same ground, as two years of a sheet: the newest is used first."""

from __future__ import annotations

import re
from collections import defaultdict, deque
from collections.abc import Sequence
from datetime import timedelta
from heapq import heappop, heappush
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.enums import Resampling
from rasterio.windows import Window, from_bounds

from flexroad.catalog.errors import CatalogError
from flexroad.catalog.grid import Bounds
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.scan.rasters import RasterFile, quiet
from flexroad.catalog.text import count
from flexroad.catalog.tile import HEIGHTS

SAME_SHARE = 0.5
"""Two files cover the same ground if they share this part of the smaller one's extent."""
DATE = re.compile(
    r"(?<!\d)(19[5-9]\d|20\d\d)(?:[-_.]?(0[1-9]|1[0-2])(?:[-_.]?(0[1-9]|[12]\d|3[01]))?)?(?!\d)"
)
"""A year in a file's name, with month and day if it has them."""
DAY_FIRST = re.compile(r"(?<![\d.])(\d\d)\.(\d\d)\.(\d{4})(?!\d)")
"""A date as in ``31.12.2023``."""
APART = timedelta(days=1)
"""Least difference of the files' times that tells their age: an archive is unpacked in one go."""
MOST_COMPARED = 4
"""Number of pairs of files whose heights are compared."""
SIDE = 256
"""Largest number of cells along an axis that are compared of a pair."""
DIFFERENT_M = 0.05
"""Heights differ if more than `DIFFERENT_SHARE` of the cells differ by more than this (units of the file)."""
DIFFERENT_SHARE = 0.01


class _Pair(NamedTuple):
    """Two files that cover the same ground, by their numbers, and the rule that finds the newer file."""

    newer: int
    older: int
    rule: str


def newest_first(root: Path, layer: str, files: Sequence[RasterFile]) -> tuple[list[RasterFile], list[str]]:
    """Return the files of a layer with the newest before others of the same ground, and notes on that.

    The newer file is found by the dates in which the names differ, else by the dates in the tags, else by the
    times of the files, if they are a day apart. Other files keep their places.
    """
    pairs = [_aged(files, one, other) for one, other in _same_ground(files)]
    if not pairs:
        return list(files), []
    compared = {pair: _difference(root, files, pair) for pair in _some(pairs) if layer in HEIGHTS}
    for pair, difference in compared.items():
        if not pair.rule and difference and difference[1] > DIFFERENT_SHARE:
            raise CatalogError(
                f"{layer}: {files[pair.newer].name} and {files[pair.older].name} cover the same ground, "
                f"{difference[0]}, and no date in their names, tags or times tells which is newer; "
                "leave one out, or write the year into their names"
            )
    known = [pair for pair in pairs if pair.rule]
    order = _ordered(len(files), known)
    return [files[number] for number in order], _notes(layer, files, known, compared)


def _same_ground(files: Sequence[RasterFile]) -> list[tuple[int, int]]:
    """Return the pairs of files, first number first, that share `SAME_SHARE` of the smaller one's extent."""
    boxes = shapely.box(*np.array([file.bounds for file in files]).T)
    one, other = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    one, other = one[one < other], other[one < other]
    shared = shapely.area(shapely.intersection(boxes[one], boxes[other]))
    same = shared >= SAME_SHARE * np.minimum(shapely.area(boxes[one]), shapely.area(boxes[other]))
    pairs = sorted(zip(one[same].tolist(), other[same].tolist(), strict=True))
    return [(a, b) for a, b in pairs if files[a].crs == files[b].crs]


def _aged(files: Sequence[RasterFile], one: int, other: int) -> _Pair:
    """Return a pair with the newer file first, and the rule that says so; "" if none does."""
    a, b = files[one], files[other]
    dates_a, dates_b = _dates(a.name), _dates(b.name)
    own_a, own_b = max(dates_a - dates_b, default=""), max(dates_b - dates_a, default="")
    # A year and a day of the same year do not show which file is newer.
    if own_a and own_b and not own_a.startswith(own_b) and not own_b.startswith(own_a):
        return _Pair(one, other, "name") if own_a > own_b else _Pair(other, one, "name")
    if a.taken and b.taken and a.taken != b.taken:
        return _Pair(one, other, "tags") if a.taken > b.taken else _Pair(other, one, "tags")
    if abs(a.modified - b.modified) >= APART:
        return _Pair(one, other, "time") if a.modified > b.modified else _Pair(other, one, "time")
    return _Pair(one, other, "")


def _dates(name: str) -> set[str]:
    """Return the dates in a file's name as digits: ``2020``, ``202005`` or ``20200501``."""
    dated = DAY_FIRST.sub(r"\3-\2-\1", name)
    return {"".join(part or "" for part in parts) for parts in DATE.findall(dated)}


def _some(pairs: Sequence[_Pair]) -> list[_Pair]:
    """Return up to `MOST_COMPARED` pairs, those without a rule first, spread evenly."""
    ordered = sorted(pairs, key=lambda pair: bool(pair.rule))
    undecided = [pair for pair in ordered if not pair.rule]
    chosen = undecided or ordered
    step = -(-len(chosen) // MOST_COMPARED)
    return chosen[::step]


def _ordered(number: int, pairs: Sequence[_Pair]) -> list[int]:
    """Return the numbers of files in their order, but newer ones before older ones of the same ground."""
    older, blocked = defaultdict[int, set[int]](set), defaultdict[int, set[int]](set)
    for pair in pairs:
        older[pair.newer].add(pair.older)
        blocked[pair.older].add(pair.newer)
    moved = sorted(older.keys() | blocked)
    # A file is ready if all newer files are placed. Ready files and remaining files are sorted by name.
    free, left, order = [one for one in moved if not blocked[one]], deque(moved), dict[int, None]()
    while len(order) < len(moved):
        while left[0] in order:
            left.popleft()
        # If rules contradict each other in a circle, the first by name comes first.
        first = heappop(free) if free else left[0]
        if first in order:
            continue
        order[first] = None
        for one in older[first]:
            blocked[one].discard(first)
            if not blocked[one]:
                heappush(free, one)
    result = list(range(number))
    for place, file in zip(moved, order, strict=True):
        result[place] = file
    return result


def _notes(
    layer: str,
    files: Sequence[RasterFile],
    pairs: Sequence[_Pair],
    compared: dict[_Pair, tuple[str, float] | None],
) -> list[str]:
    """Return a note for each rule that was used, with one pair as an example."""
    notes = []
    for rule, where in (("name", "in their names"), ("tags", "in their tags"), ("time", "of the files")):
        own = [pair for pair in pairs if pair.rule == rule]
        if not own:
            continue
        shown = next((pair for pair in own if compared.get(pair)), own[0])
        difference = compared.get(shown)
        notes.append(
            f"{layer}: {count(len(own), 'pair')} of files cover the same ground; by the dates {where}, "
            f"{files[shown.newer].name} is used before {files[shown.older].name}"
            + (f", and {difference[0]}" if difference else "")
        )
    return notes


def _difference(root: Path, files: Sequence[RasterFile], pair: _Pair) -> tuple[str, float] | None:
    """Return newer minus older as a text, and the share of the cells that differ by `DIFFERENT_M`, or None.

    A sample of their common ground is compared.
    """
    a, b = files[pair.newer].bounds, files[pair.older].bounds
    shared = (max(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), min(a[3], b[3]))
    try:
        newer, older = (_heights(root / files[number].name, shared) for number in pair[:2])
    except ERRORS:
        return None
    rows, cols = (np.linspace(0, 1, min(sizes)) for sizes in zip(newer.shape, older.shape, strict=True))
    apart = _at(newer, rows, cols) - _at(older, rows, cols)
    apart = apart[np.isfinite(apart)]
    if not apart.size:
        return None
    share = float((np.abs(apart) > DIFFERENT_M).mean())
    by = f"by {np.median(apart):.2f} in the median, by more than {DIFFERENT_M:g} in {share:.0%} of the cells"
    return f"their heights differ {by}", share


def _heights(path: Path, bounds: Bounds) -> NDArray[np.float64]:
    """Return up to `SIDE` cells along each axis of the part of a raster within bounds, NaN for nodata."""
    with quiet(), open_raster(path) as raster:
        part = from_bounds(*bounds, raster.transform).round_offsets().round_lengths()
        window = part.intersection(Window(0, 0, raster.width, raster.height))
        shape = tuple(min(SIDE, max(1, int(size))) for size in (window.height, window.width))
        values = raster.read(1, window=window, out_shape=shape, masked=True, resampling=Resampling.nearest)
        scale, offset = float(raster.scales[0]), float(raster.offsets[0])
    heights: NDArray[np.float64] = values.astype(np.float64).filled(np.nan) * scale + offset
    return heights


def _at(heights: NDArray[np.float64], rows: NDArray[np.float64], cols: NDArray[np.float64]) -> Any:
    """Return the heights at rows and columns that are given as shares of the array's size (0 to 1)."""
    row, col = (
        np.rint(share * (size - 1)).astype(int)
        for share, size in zip((rows, cols), heights.shape, strict=True)
    )
    return heights[np.ix_(row, col)]
