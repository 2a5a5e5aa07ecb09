"""Tiles of a catalog read as a run reads them, before it: what fails here fails there, in the same words."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog import LAYERS, Tile
from flexroad.catalog.text import some
from flexroad.pipeline.config.models import Config
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.dsm_and_dtm import Offset, offset_note, open_offset
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
    - `config`: configuration of the run.
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
    layers = (layer.reaching(tile.grid.bounds) for layer in tile.layers if layer.name in names)
    return tuple((layer.name, layer.files) for layer in layers if layer)
