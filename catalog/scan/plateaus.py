"""Heights that many cells of a file share exactly: voids, if the file does not declare them as nodata."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.scan.cover import AS_TEXT
from flexroad.catalog.scan.mask_values import windows
from flexroad.catalog.scan.rasters import quiet
from flexroad.catalog.scan.valid_cells import read_valid
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import some

SHARE = 0.05
"""Smallest share of a file's cells that is noted."""
ALONE = 3
"""Whole numbers are noted if they are so many times as frequent as the next lower and higher number: heights
in whole units share values without voids."""
MOST_FILES = 16
"""Largest number of files of a layer that are read."""
MAX_TEXT_BYTES = 32_000_000
"""Larger files of text are not read: their cells cannot be read in parts."""


def plateau_notes(layer: str, files: Mapping[str, Location]) -> list[str]:
    """Return a note on each exact height that many cells of a file have, with their share.

    Parts of some files are read, so that the time does not depend on the size of the survey.

    - `layer`: name of the layer, for messages.
    - `files`: the layer's files by name.
    """
    step = -(-len(files) // MOST_FILES) or 1
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
        # A file of one height, and no other, has no voids in it.
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
