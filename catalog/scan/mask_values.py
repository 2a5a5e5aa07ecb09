"""Values of road masks, compared with those that mean road: a wrong number gives a run without roads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.windows import Window

from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.scan.cover import AS_TEXT
from flexroad.catalog.scan.rasters import quiet
from flexroad.catalog.scan.valid_cells import read_valid
from flexroad.catalog.text import some

MOST_FILES = 8
"""Largest number of files of a layer that are read."""
SIDE = 1024
"""A file of at most this many cells along each axis is read as a whole."""
PARTS = 4
"""Of a larger one, this many squares along each axis are read, with as many cells in all."""
MOST_SHOWN = 8
"""Largest number of values in a note."""


def mask_notes(root: Path, layer: str, names: Sequence[str], road_values: Sequence[int]) -> list[str]:
    """Return a note if the values of a mask do not fit those that mean road; empty if they may.

    Parts of some files are read, so that the time does not depend on the size of the survey.

    - `root`: folder that the names are relative to.
    - `layer`: name of the layer, for messages.
    - `names`: the mask's files.
    - `road_values`: values that mean road; empty: every value but 0 and nodata.
    """
    step = -(-len(names) // MOST_FILES)
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
    """Return how the values of a mask do not fit those that mean road; empty if they may.

    - `values`: values of its cells, at least one; nodata is none of them.
    - `road_values`: values that mean road; empty: every value but 0 and nodata.
    - `has_nodata`: whether cells are nodata.
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
    """Return whether values are no classes, as some are not whole."""
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
    """Yield all of a small raster, or squares spread over a large one."""
    if max(raster.shape) <= SIDE:
        yield Window(0, 0, raster.width, raster.height)
        return
    size = SIDE // PARTS
    for row in range(PARTS):
        for column in range(PARTS):
            top = max(0, (raster.height - size) * row // (PARTS - 1))
            left = max(0, (raster.width - size) * column // (PARTS - 1))
            yield Window(left, top, min(size, raster.width), min(size, raster.height))
