"""DSM against DTM on tiles of a catalog, before a run: units, vertical references, steps between sheets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from flexroad.catalog.text import count, some
from flexroad.pipeline.check.finding import Finding
from flexroad.pipeline.check.trial import Trial
from flexroad.tasks.io.height_offset import on_tiles

STEP_M = 0.3
"""Change of the offset between tiles that is taken for another vertical reference (m)."""
CALM_M = 0.1
"""Largest spread of the offset of a tile that is compared with those of others (m)."""


def height_findings(trials: Sequence[Trial]) -> Iterator[Finding]:
    """Yield what DSM and DTM say of each other: one line each on units, an offset, and a step between sheets.

    Parameters
    ----------
    trials : sequence of Trial
        Some tiles of a catalog.
    """
    converted = sorted({note for tile in trials for note in tile.units})
    yield from (Finding(f"{note}: if they are in metres, correct the unit") for note in converted)
    lines = on_tiles([tile.note for tile in trials if tile.note], len(trials))
    yield from (Finding(line, fault=True) for line in lines)
    if not lines and (step := _step(trials)):
        yield Finding(step, fault=True)


def _step(trials: Sequence[Trial]) -> str | None:
    """Return that the offset changes between tiles, by the widest gap in its values; None if it does not."""
    calm = [(tile.offset.median_m, tile) for tile in trials if tile.offset and tile.offset.spread_m <= CALM_M]
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
