"""DSM against DTM on tiles, before and after a run: units, vertical references, steps between sheets."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from statistics import median
from typing import Any

from flexroad.catalog.text import count, some
from flexroad.pipeline.check.trial import Finding, Trial
from flexroad.tasks.io.dsm_and_dtm import FAR_M, on_tiles

STEP_M = 0.3
"""Change of the offset between tiles that is taken for another vertical reference (m)."""
CALM_M = 0.1
"""Largest spread of the offset of a tile that is compared with those of others (m)."""
MOST_ROAD = 0.9
"""Share of a tile's road from which it lies off the DTM as a whole."""


def height_findings(trials: Sequence[Trial]) -> Iterator[Finding]:
    """Yield what DSM and DTM say of each other: a line on units, and one on an offset or a step.

    - `trials`: some tiles of a catalog.
    """
    converted = sorted({note for tile in trials for note in tile.units})
    yield from (Finding(f"{note}: if they are in metres, correct the unit") for note in converted)
    lines = on_tiles([tile.note for tile in trials if tile.note], len(trials))
    yield from (Finding(line, fault=True) for line in lines)
    if lines:
        return
    if step := _step(trials):
        yield Finding(step, fault=True)
        return
    roads = [tile.road for tile in trials if road_is_off(tile.road)]
    yield from map(Finding, road_step(roads, len(trials)))


def road_is_off(row: Mapping[str, Any]) -> bool:
    """Return whether nearly all road of a tile, by its metrics, lies off the DTM, and by less than `FAR_M`.

    Then DSM or DTM may have another vertical reference; `load` notes an offset from `FAR_M` on.
    """
    return (row.get("off_dtm_road") or 0.0) >= MOST_ROAD and abs(row.get("off_dtm_m") or FAR_M) < FAR_M


def road_step(rows: Iterable[Mapping[str, Any]], tiles: int) -> Iterator[str]:
    """Yield a line if the road of some tiles lies above the DTM as a whole, and one if it lies below.

    - `rows`: metrics of these tiles (`road_is_off`).
    - `tiles`: number of tiles of the run.
    """
    off = [row["off_dtm_m"] for row in rows]
    for side, metres in (("above", [m for m in off if m > 0]), ("below", [-m for m in off if m < 0])):
        if metres:
            yield (
                f"the road lies {median(metres):.2f} m {side} the DTM on {len(metres)} of "
                f"{count(tiles, 'tile')}: another vertical reference?"
            )


def _step(trials: Sequence[Trial]) -> str | None:
    """Return that the offset changes between tiles, by the widest gap in its values; None if it does not."""
    calm = [(tile.offset[0], tile) for tile in trials if tile.offset and tile.offset[1] <= CALM_M]
    calm.sort(key=lambda pair: pair[0])
    values = [value for value, _ in calm]
    gaps = [after - before for before, after in pairwise(values)]
    if not gaps or max(gaps) < STEP_M:
        return None
    cut = gaps.index(max(gaps)) + 1
    low, high = ([tile for _, tile in part] for part in (calm[:cut], calm[cut:]))
    parts = [
        f"{values[len(part) // 2 + start]:.2f} m on {count(len(part), 'tile')} ({_of(part, other)})"
        for part, other, start in ((low, high, 0), (high, low, cut))
    ]
    return f"DSM minus DTM is {' and '.join(parts)}: files of two vertical references?"


def _of(part: Sequence[Trial], other: Sequence[Trial]) -> str:
    """Return the sheets that only one part of the tiles has, or its tiles if they have the same sheets."""
    sheets = {sheet for tile in part for sheet in tile.sheets}
    own = [sheet for sheet in sorted(sheets) if not any(sheet in tile.sheets for tile in other)]
    return some(own or [tile.tile_id for tile in part])
