"""DSM against DTM on tiles of a catalog, before a run: units, vertical references, steps between sheets."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

from flexroad.catalog import Tile
from flexroad.catalog.headers.refused import Refused, head
from flexroad.catalog.text import count, some
from flexroad.catalog.tile import HEIGHTS
from flexroad.pipeline.check.finding import Finding
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.height_offset import Offset, offset_note, on_tiles, open_offset
from flexroad.tasks.io.height_units import is_conversion

MOST_TILES = 48
"""Number of tiles whose heights are compared: one of each pair of sheets first, spread evenly."""
MOST_ERRORS = 5
"""Number of tiles that are named because their heights cannot be used together."""
STEP_M = 0.3
"""Change of the offset between tiles that is taken for another vertical reference (m)."""
CALM_M = 0.1
"""Largest spread of the offset of a tile that is compared with those of others (m)."""


@dataclass(frozen=True)
class _Compared:
    """One tile whose DSM was compared with its DTM."""

    tile_id: str
    sheets: frozenset[str]
    """Files of both layers on the tile: ``dsm a.tif``."""
    offset: Offset | None
    note: str | None
    units: tuple[str, ...]
    """Notes on heights that were converted to metres."""


def height_findings(
    tiles: Sequence[Tile], options: load.Options, named: Collection[str]
) -> Iterator[Finding]:
    """Yield what DSM and DTM say of each other: one line each on units, an offset, and a step between sheets.

    Parameters
    ----------
    tiles : sequence of Tile
        Usable tiles; some of them are read (`MOST_TILES`).
    options : Options
        How the run reads heights.
    named : collection of str
        Tiles of which something else was found: they are left out.
    """
    options = options.model_copy(update={"min_valid": 0.0, "halo_m": 0.0})
    found, errors = list[_Compared](), list[str]()
    for tile in _sample([tile for tile in tiles if tile.id not in named]):
        try:
            found.append(_compared(tile, options))
        except TaskError as error:
            # A file that is missing or closed has been named.
            if not error.file or _is_open(Path(error.file)):
                errors.append(f"{tile.id} would fail: {error}")
    yield from (Finding(text, fault=True) for text in errors[:MOST_ERRORS])
    if len(errors) > MOST_ERRORS:
        yield Finding(f"{len(errors) - MOST_ERRORS} more tiles would fail like that", fault=True)
    converted = sorted({note for tile in found for note in tile.units})
    yield from (Finding(f"{note}: if they are in metres, correct the unit") for note in converted)
    lines = on_tiles([tile.note for tile in found if tile.note], len(found))
    yield from (Finding(line, fault=True) for line in lines)
    if not lines and (step := _step(found)):
        yield Finding(step, fault=True)


def _is_open(path: Path) -> bool:
    try:
        head(path)
    except (OSError, Refused):
        return False
    return True


def _sample(tiles: Sequence[Tile]) -> list[Tile]:
    """Return tiles with DSM and DTM: the first of each pair of sheets, then others, spread evenly."""
    tiles = [tile for tile in tiles if tile.layer("dsm") and tile.layer("dtm")]
    first = {_sheets(tile): tile for tile in reversed(tiles)}
    chosen = _evenly(sorted(first.values(), key=lambda tile: tile.id), MOST_TILES)
    ids = {tile.id for tile in chosen}
    return chosen + _evenly([tile for tile in tiles if tile.id not in ids], MOST_TILES - len(chosen))


def _evenly(tiles: Sequence[Tile], most: int) -> list[Tile]:
    number = min(most, len(tiles))
    return [tiles[k * len(tiles) // number] for k in range(number)]


def _sheets(tile: Tile) -> frozenset[str]:
    """Return the files of heights that lie on a tile."""
    layers = [layer.reaching(tile.grid.bounds) for layer in tile.layers if layer.name in ("dsm", "dtm")]
    return frozenset(f"{layer.name} {Path(file).name}" for layer in layers if layer for file in layer.files)


def _compared(tile: Tile, options: load.Options) -> _Compared:
    layers = tuple(layer for layer in tile.layers if layer.name in HEIGHTS)
    data = load.load(replace(tile, layers=layers), options)
    return _Compared(
        tile.id,
        _sheets(tile),
        open_offset(data.dsm, data.dtm),
        offset_note(data.dsm, data.dtm),
        tuple(note for note in data.notes if is_conversion(note)),
    )


def _step(found: Sequence[_Compared]) -> str | None:
    """Return that the offset changes between tiles, by the widest gap in its values; None if it does not."""
    calm = [(tile.offset.median_m, tile) for tile in found if tile.offset and tile.offset.spread_m <= CALM_M]
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


def _of(part: Sequence[_Compared], other: Sequence[_Compared]) -> str:
    """Return the sheets that only one part of the tiles has, or its tiles if they have the same sheets."""
    sheets = {sheet for tile in part for sheet in tile.sheets}
    own = [sheet for sheet in sorted(sheets) if not any(sheet in tile.sheets for tile in other)]
    return some(own or [tile.tile_id for tile in part])
