"""Tiles of a catalog read as a run reads them, before it: what fails here fails there, in the same words.

The DSM and DTM of these tiles are compared: units, vertical references, steps between sheets.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from flexroad.catalog import LAYERS, Tile
from flexroad.catalog.text import count, some
from flexroad.pipeline.config.models import Config
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.dsm_and_dtm import FAR_M, Offset, offset_note, on_tiles, open_offset
from flexroad.tasks.io.height_units import is_conversion
from flexroad.tasks.options import stage_function, stage_module
from flexroad.tasks.types import Bools, Floats

MOST_TILES = 48
"""Number of tiles that are read: those with a doubtful file first, then one of each set of files."""
MOST_ERRORS = 5
"""Number of errors that are told."""


@dataclass(frozen=True)
class Finding:
    """One line about a catalog."""

    text: str
    fault: bool = False
    """Whether this should be corrected before a run."""
    warning: bool = False
    """Whether this is said as a warning though it may be right; a fault always is."""
    failing: frozenset[str] = frozenset()
    """Ids of the tiles that would fail in a run."""


def evenly(tiles: Sequence[Tile], most: int) -> list[Tile]:
    """Return so many of the tiles at most, spread evenly over them."""
    number = min(most, len(tiles))
    return [tiles[k * len(tiles) // number] for k in range(number)]


@dataclass(frozen=True)
class Trial:
    """What a run would read of one tile."""

    tile_id: str
    sheets: frozenset[str]
    """Files of DSM and DTM on the tile: ``dsm a.tif``."""
    offset: Offset | None
    note: str | None
    """That the DSM lies off the DTM as a whole; None if it does not."""
    units: tuple[str, ...]
    """Notes on heights that were converted to metres."""
    road: Mapping[str, float]
    """Median of DSM minus DTM on the road, and share of it off the DTM, as in metrics; empty if none."""


def trials(
    tiles: Sequence[Tile],
    config: Config,
    named: Collection[str],
    doubtful: Collection[str],
    absent: Collection[str],
) -> tuple[list[Trial], list[Finding]]:
    """Read some tiles as the stages of a run do, up to the road mask and the splines.

    - `tiles`: usable tiles; some of them are read (`MOST_TILES`).
    - `named`: tiles of which something else was found: they are left out.
    - `doubtful`: tiles with a file that may fail: they come first.
    - `absent`: files that are missing or closed, which have been named.
    - `faults`: a line for each error, with the tiles that it would fail.
    """
    # Chains that read the same with the same splines are one.
    chains = {
        repr([chain[name] for name in ("load", "segment", "fit")]): chain for chain in config.chains.values()
    }
    read, errors = list[Trial](), defaultdict[str, list[str]](list)
    for tile in _sample([tile for tile in tiles if tile.id not in named], doubtful):
        try:
            found = [_trial(tile, chain) for chain in chains.values()]
        except TaskError as error:
            if error.file not in absent:
                errors[str(error)].append(tile.id)
        else:
            read.append(found[0])
    findings = [
        Finding(f"{some(ids)} would fail: {error}", fault=True, failing=frozenset(ids))
        for error, ids in errors.items()
    ]
    if more := frozenset(tile for ids in list(errors.values())[MOST_ERRORS:] for tile in ids):
        line = f"{len(more)} more tiles would fail like that"
        findings = [*findings[:MOST_ERRORS], Finding(line, fault=True, failing=more)]
    return read, findings


def _trial(tile: Tile, chain: Mapping[str, Any]) -> Trial:
    """Return what the first stages read of a tile."""
    data = load.load(tile, chain["load"])
    road = data.road_mask
    if "roads" in getattr(stage_module(chain["segment"]), "READS", ()):
        road = stage_function("segment", chain["segment"])(data, chain["segment"]).mask
    if space_of := getattr(stage_module(chain["fit"]), "space_of", None):
        space_of(data, chain["fit"])
    core = data.grid.window(data.core)
    models = data.dsm[core], data.dtm[core]
    units = tuple(filter(is_conversion, data.notes))
    return Trial(
        tile.id,
        frozenset(f"{layer} {Path(f).name}" for layer, files in _files(tile, load.NEEDS) for f in files),
        open_offset(*models),
        offset_note(*models),
        units,
        {}
        if road is None
        else _on_road(models[0] - models[1], road[core], chain["assess"].dsm_dtm_tolerance_m),
    )


def _on_road(above: Floats, road: Bools, dsm_dtm_tolerance_m: float) -> dict[str, float]:
    """Return how far the DSM is above the DTM on the road, as in metrics; empty without road."""
    cells = above[road & np.isfinite(above)]
    if not cells.size:
        return {}
    return {
        "off_dtm_m": float(np.median(cells)),
        "off_dtm_road": float(np.mean(np.abs(cells) > dsm_dtm_tolerance_m)),
    }


def _sample(tiles: Sequence[Tile], doubtful: Collection[str]) -> list[Tile]:
    """Return doubtful tiles, the first of each set of files, then others; each spread evenly."""
    tiles = [tile for tile in tiles if all(map(tile.layer, load.NEEDS))]
    first = {_files(tile, LAYERS): tile for tile in reversed(tiles)}
    kinds = [
        [tile for tile in tiles if tile.id in doubtful],
        sorted(first.values(), key=lambda tile: tile.id),
        tiles,
    ]
    chosen: dict[str, Tile] = {}
    for kind in kinds:
        left = [tile for tile in kind if tile.id not in chosen]
        chosen |= {tile.id: tile for tile in evenly(left, MOST_TILES - len(chosen))}
    return list(chosen.values())


def _files(tile: Tile, names: Collection[str]) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return the files of some layers that lie on a tile, with the name of the layer."""
    return tuple((layer.name, layer.files) for layer in tile.layers_on(names))


STEP_M = 0.3
"""Change of the offset between tiles that is taken for another vertical reference (m)."""
CALM_M = 0.1
"""Largest spread of the offset of a tile that is compared with those of others (m)."""
MOST_ROAD = 0.9
"""Share of a tile's road from which it lies off the DTM as a whole."""


def height_findings(trials: Sequence[Trial]) -> Iterator[Finding]:
    """Yield what DSM and DTM say of each other: a line on units, and one on an offset or a step."""
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
