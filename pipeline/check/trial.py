"""Read tiles of a catalog before a run, in the same way: errors here are the errors of the run.

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
"""Number of tiles that are read: first tiles with a doubtful file, then one tile of each set of files."""
MOST_ERRORS = 5
"""Number of errors that are reported."""


@dataclass(frozen=True)
class Finding:
    """One line about a catalog."""

    text: str
    fault: bool = False
    """Whether this should be corrected before a run."""
    warning: bool = False
    """Whether this is printed as a warning although it may be correct; a fault is always a warning."""
    failing: frozenset[str] = frozenset()
    """Ids of the tiles that would fail in a run."""


def evenly(tiles: Sequence[Tile], most: int) -> list[Tile]:
    """Return at most ``most`` of the tiles, spread evenly over them."""
    number = min(most, len(tiles))
    return [tiles[k * len(tiles) // number] for k in range(number)]


@dataclass(frozen=True)
class Trial:
    """The data that a run would read for one tile."""

    tile_id: str
    sheets: frozenset[str]
    """Files of DSM and DTM on the tile: ``dsm a.tif``."""
    offset: Offset | None
    note: str | None
    """The offset between DSM and DTM on the complete tile; None without an offset."""
    units: tuple[str, ...]
    """Notes on heights that were converted to metres."""
    road: Mapping[str, float]
    """Median of DSM minus DTM on the road, and share of the road off the DTM; empty without road."""


def trials(
    tiles: Sequence[Tile],
    config: Config,
    named: Collection[str],
    doubtful: Collection[str],
    absent: Collection[str],
) -> tuple[list[Trial], list[Finding]]:
    """Read some tiles as the stages of a run do, up to the road mask and the splines.

    - `tiles`: usable tiles; at most `MOST_TILES` of them are read.
    - `named`: tiles with other findings: they are left out.
    - `doubtful`: tiles with a file that may fail: they come first.
    - `absent`: files that are missing or closed; they are already reported.
    - `faults`: a line for each error, with the tiles that it would fail.
    """
    # Chains that read the same files with the same splines are tried once.
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
    """Return the data that the first stages read for a tile."""
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
"""Smallest change of the offset between tiles that means another vertical reference (m)."""
CALM_M = 0.1
"""Largest spread of a tile's offset (m); tiles with a larger spread are not compared."""
MOST_ROAD = 0.9
"""Share of road cells off the DTM from which a tile's complete road is taken as off the DTM."""


def height_findings(trials: Sequence[Trial]) -> Iterator[Finding]:
    """Yield findings of comparing DSM and DTM: a line on units, and a line on an offset or a step."""
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
    """Return whether nearly all road of a tile lies off the DTM by less than `FAR_M`, from its metrics.

    Then DSM or DTM may have another vertical reference; `load` notes an offset from `FAR_M` on.
    """
    return (row.get("off_dtm_road") or 0.0) >= MOST_ROAD and abs(row.get("off_dtm_m") or FAR_M) < FAR_M


def road_step(rows: Iterable[Mapping[str, Any]], tiles: int) -> Iterator[str]:
    """Yield a line if the complete road of some tiles lies above the DTM, and a line if it lies below.

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
    """Return a line if the offset changes between tiles: tiles are divided at the widest gap of offsets."""
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
    """Return the sheets that only this part of the tiles has, or its tiles if both have the same sheets."""
    sheets = {sheet for tile in part for sheet in tile.sheets}
    own = [sheet for sheet in sorted(sheets) if not any(sheet in tile.sheets for tile in other)]
    return some(own or [tile.tile_id for tile in part])
