"""Checks of a DSM against a DTM, and of survey and vertical CRS in their files.

The files may be swapped, or come from two surveys. If the complete DSM lies above or below the DTM, it has
another vertical datum, or another unit of heights.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from flexroad.catalog import Tile
from flexroad.catalog.crs import vertical
from flexroad.catalog.guard.open_raster import kept_raster
from flexroad.catalog.scan.rasters import date_of, quiet
from flexroad.tasks.io.raster import Unreadable, read_raster
from flexroad.tasks.types import Floats

BELOW_M = 1.0
"""Least distance at which the surface is taken as below or above the ground (m)."""
SHARE, TIMES = 0.05, 4.0
"""Least share of cells below the ground for a note, and its least ratio to the share of cells above."""
FAR_M = 1.0
"""Offset from which two vertical references are suspected (m)."""
SMOOTH_M = 0.2
"""Change of the difference from a cell to its neighbours, up to which the cell may be open ground (m)."""
LOWEST = 10.0
"""Percentile of the difference over smooth cells that is taken as ground: roofs are smooth, too, and a tile
with less ground than this share is rare."""
CONSTANT_M = 0.2
"""Largest spread of a constant offset over the tile (m); relief gives a larger spread."""
OPEN_M = 1.0
"""Open ground is smooth, and at most this much above the lowest difference (m)."""
SMOOTH_SHARE, OPEN_SHARE = 0.05, 0.25
"""Least share of smooth cells in cells with both heights, and of open cells in smooth cells."""
SCALES = {"feet": 0.3048, "dm": 0.1, "cm": 0.01, "mm": 0.001}
"""Units that one of the models may be in, in metres."""
HIGH_M = 3 * FAR_M
"""Least height of the ground for a ratio of heights (m): near 0 a ratio has no meaning."""
ABOVE, RATIO = "the DSM lies ", "the heights of the DSM are "
"""Start of notes on an offset, and on a ratio."""

Offset = tuple[float, float]
"""DSM minus DTM over the open cells of a tile (m): median, and spread by the median absolute deviation."""


def below_ground_note(dsm: Floats, dtm: Floats) -> str | None:
    """Return a note if a DSM is below a DTM (m, same shape) in many cells and above it in few; else None.

    Noise, and ground that was removed between two surveys, puts some cells below. Buildings and trees put
    more cells above, unless the files are swapped.
    """
    above = dsm - dtm
    known = np.count_nonzero(np.isfinite(above))
    below = np.count_nonzero(above < -BELOW_M)
    if not below or below < SHARE * known:
        return None
    low, high = below / known, np.count_nonzero(above > BELOW_M) / known
    if low < TIMES * high:
        return None
    return (
        f"the DSM is more than {BELOW_M:g} m below the DTM in {low:.0%} of the cells and above it in "
        f"{high:.0%}: are their files swapped?"
    )


def survey_difference(tile: Tile) -> tuple[str, str]:
    """Return in which property DSM and DTM differ, and which property is not declared; else "".

    - `tile`: with the files to compare (`Tile.within`).
    """
    declared = [_declared(tile, name) for name in ("dsm", "dtm")]
    differs, missing = [], []
    for number, what in enumerate(("date", "vertical CRS")):
        dsm, dtm = ({file[number] for file in files} for files in declared)
        if dsm - {""} and dtm - {""} and dsm - {""} != dtm - {""}:
            differs.append(f"{what}: dsm {', '.join(sorted(dsm))}, dtm {', '.join(sorted(dtm))}")
        elif dsm | dtm != (dsm & dtm) - {""}:
            missing.append(what)
    return "; ".join(differs), " and ".join(missing)


def vertical_crs(tile: Tile) -> str | None:
    """Return the vertical CRS of the heights from `load`, in metres; None if it is not known.

    It is known if all files of DSM and DTM on the tile declare the same CRS.
    """
    tile = tile.within(tile.grid.bounds)
    found = {crs for name in ("dsm", "dtm") for _, crs in _declared(tile, name)}
    return found.pop() or None if len(found) == 1 else None


def _declared(tile: Tile, name: str) -> list[tuple[str, str]]:
    """Return date and vertical CRS of each file of a layer, "" where they are not declared.

    Only headers are read. Files that cannot be read are left out, as by `load`.
    """
    layer = tile.layer(name)

    def read(raster: Any) -> tuple[str | None, dict[str, str]]:
        tags = {**raster.tags(), **raster.tags(ns="IMAGERY")}
        return raster.crs.to_wkt() if raster.crs else None, tags

    found: list[tuple[str, str]] = []
    with quiet():
        for path in tile.paths(layer) if layer else ():
            try:
                crs, tags = read_raster(path, name, read, kept_raster, tile.missing)
            except Unreadable:
                continue
            taken, crs = date_of(tags), crs or (layer.crs if layer else None)
            found.append((f"{taken:%Y-%m-%d}" if taken else "", (vertical(crs) if crs else None) or ""))
    return found


def open_offset(dsm: Floats, dtm: Floats) -> Offset | None:
    """Return by how much a DSM lies above a DTM (m, same shape) on open ground.

    On open ground the difference is low and equal in neighbouring cells: crowns of trees are rough, and roofs
    are higher. The result is None with too few open cells.
    """
    above = dsm - dtm
    known = np.isfinite(above)
    smooth = known.copy()
    with np.errstate(invalid="ignore"):
        beside, below = np.abs(np.diff(above, axis=1)) <= SMOOTH_M, np.abs(np.diff(above, axis=0)) <= SMOOTH_M
    smooth[:, :-1] &= beside
    smooth[:, 1:] &= beside
    smooth[:-1] &= below
    smooth[1:] &= below
    cells = above[smooth]
    if not cells.size or cells.size < SMOOTH_SHARE * np.count_nonzero(known):
        return None
    ground = cells[np.abs(cells - np.percentile(cells, LOWEST)) <= OPEN_M]
    if ground.size < OPEN_SHARE * cells.size:
        return None
    median = float(np.median(ground))
    return median, 1.4826 * float(np.median(np.abs(ground - median)))


def offset_note(dsm: Floats, dtm: Floats) -> str | None:
    """Return a note if hardly a cell of a DSM is near the DTM (m, same shape), else None.

    The note says that the offset is constant, or that one model is in another unit.
    """
    most = LOWEST / 100
    # In most tiles, every fourth row already has enough near cells.
    if np.count_nonzero(np.abs(dsm[::4] - dtm[::4]) <= FAR_M) > most * dsm.size:
        return None
    above = np.abs(dsm - dtm)
    near, known = np.count_nonzero(above <= FAR_M), np.count_nonzero(np.isfinite(above))
    if not known or near > most * known:
        return None
    offset = open_offset(dsm, dtm)
    for unit, metres in SCALES.items():
        for ratio, which, scaled in (
            (1 / metres, f"the DSM in {unit}, the DTM in metres?", (dsm * metres, dtm)),
            (metres, f"the DTM in {unit}, the DSM in metres?", (dsm, dtm * metres)),
        ):
            if _agree(*scaled, offset):
                return f"{RATIO}{ratio:.{2 if ratio > 0.05 else 3}f} times the DTM heights: {which}"
    median_m, spread_m = offset or (0.0, 0.0)
    if abs(median_m) < FAR_M or spread_m > CONSTANT_M:
        return None
    if median_m > 0:
        return f"{ABOVE}{median_m:.1f} m above the DTM: ellipsoidal heights?"
    return f"{ABOVE}{-median_m:.1f} m below the DTM: ellipsoidal heights, or are their files swapped?"


def _agree(dsm: Floats, dtm: Floats, unscaled: Offset | None) -> bool:
    """Return whether a DSM lies on a DTM after a conversion, and better than before."""
    found = open_offset(dsm, dtm)
    if not found or abs(found[0]) > FAR_M or np.nanmedian(np.abs(dtm)) < HIGH_M:
        return False
    return not unscaled or found[1] <= unscaled[1]


def is_offset(note: str) -> bool:
    """Return whether a note of a tile comes from `offset_note`."""
    return note.startswith((ABOVE, RATIO))


def on_tiles(notes: Iterable[str], tiles: int) -> list[str]:
    """Return one line for each cause in notes of tiles by `offset_note`, with the number of tiles.

    - `notes`: the notes of tiles, at most one per tile; the first note of each cause is shown.
    - `tiles`: number of tiles that were examined.
    """
    first: dict[str, str] = {}
    number = Counter[str]()
    for note in notes:
        what, _, cause = note.partition(": ")
        first.setdefault(cause, what)
        number[cause] += 1
    total = f"{tiles} tile{'s' * (tiles != 1)}"
    return [f"{what} on {number[cause]} of {total}: {cause}" for cause, what in first.items()]
