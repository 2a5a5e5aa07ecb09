"""A DSM that lies above or below the DTM as a whole: another vertical datum, or another unit of heights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from flexroad.tasks.types import Floats

FAR_M = 1.0
"""Offset from which two vertical references are suspected (m)."""
SMOOTH_M = 0.2
"""Change of the difference from a cell to its neighbours, up to which the cell may be open ground (m)."""
LOWEST = 10.0
"""Percentile of the difference over smooth cells that stands for the ground: roofs are smooth, too, and a
tile with less ground than this share is rare."""
CONSTANT_M = 0.2
"""Largest spread of an offset that is the same over the tile: relief gives more (m)."""
OPEN_M = 1.0
"""Open ground is smooth and within this of the lowest (m)."""
SMOOTH_SHARE, OPEN_SHARE = 0.05, 0.25
"""Least share of smooth cells in those with both heights, and of open ones in the smooth."""
UNITS = {"feet": 0.3048, "dm": 0.1, "cm": 0.01, "mm": 0.001}
"""Units that one of the models may be in, in metres."""
HIGH_M = 3 * FAR_M
"""Height of the ground from which a ratio of heights tells more than that both are near 0 (m)."""
ABOVE, RATIO = "the DSM lies ", "the heights of the DSM are "
"""Begin of notes on an offset, and on a ratio."""


@dataclass(frozen=True)
class Offset:
    """DSM minus DTM over the open cells of a tile (m)."""

    median_m: float
    spread_m: float
    """Standard deviation, by the median absolute deviation."""


def open_offset(dsm: Floats, dtm: Floats) -> Offset | None:
    """Return by how much a DSM lies above a DTM (m, same shape) on open ground.

    Open ground is where the difference is the same in neighbouring cells, and low: crowns of trees are rough,
    and roofs are higher. None if too few cells are so.
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
    return Offset(median, 1.4826 * float(np.median(np.abs(ground - median))))


def offset_note(dsm: Floats, dtm: Floats) -> str | None:
    """Return a note if hardly a cell of a DSM is near the DTM (m, same shape), and the offset is constant.

    Or if the heights of one are those of the other in another unit; else None.
    """
    most = LOWEST / 100
    # Every fourth row of most tiles has near cells enough for all of it.
    if np.count_nonzero(np.abs(dsm[::4] - dtm[::4]) <= FAR_M) > most * dsm.size:
        return None
    above = np.abs(dsm - dtm)
    near, known = np.count_nonzero(above <= FAR_M), np.count_nonzero(np.isfinite(above))
    if not known or near > most * known:
        return None
    offset = open_offset(dsm, dtm)
    for unit, metres in UNITS.items():
        for ratio, which, scaled in (
            (1 / metres, f"the DSM in {unit}, the DTM in metres?", (dsm * metres, dtm)),
            (metres, f"the DTM in {unit}, the DSM in metres?", (dsm, dtm * metres)),
        ):
            if _agree(*scaled, offset):
                return f"{RATIO}{ratio:.{2 if ratio > 0.05 else 3}f} times those of the DTM: {which}"
    if offset is None or abs(offset.median_m) < FAR_M or offset.spread_m > CONSTANT_M:
        return None
    if offset.median_m > 0:
        return f"{ABOVE}{offset.median_m:.1f} m above the DTM: ellipsoidal heights?"
    return f"{ABOVE}{-offset.median_m:.1f} m below the DTM: ellipsoidal heights, or are their files swapped?"


def _agree(dsm: Floats, dtm: Floats, unscaled: Offset | None) -> bool:
    """Return whether a DSM lies on a DTM after one of them was converted, and better than before."""
    found = open_offset(dsm, dtm)
    if not found or abs(found.median_m) > FAR_M or np.nanmedian(np.abs(dtm)) < HIGH_M:
        return False
    return not unscaled or found.spread_m <= unscaled.spread_m


def is_offset(note: str) -> bool:
    """Return whether a note of a tile is one of `offset_note`."""
    return note.startswith((ABOVE, RATIO))


def on_tiles(notes: Iterable[str], tiles: int) -> list[str]:
    """Return one line for each cause in notes of tiles by `offset_note`, with the number of tiles.

    - `notes`: one for each tile that has one; of each cause the first is shown.
    - `tiles`: number of tiles looked at.
    """
    first: dict[str, str] = {}
    number = Counter[str]()
    for note in notes:
        what, _, cause = note.partition(": ")
        first.setdefault(cause, what)
        number[cause] += 1
    total = f"{tiles} tile{'s' * (tiles != 1)}"
    return [f"{what} on {number[cause]} of {total}: {cause}" for cause, what in first.items()]
