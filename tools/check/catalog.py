"""Check of a catalog: layers per tile, what would fail, shift of the orthophoto against the heights."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from flexroad.catalog import LAYERS, Catalog, Tile
from flexroad.catalog.allowlist import check_allowed
from flexroad.catalog.crs import short
from flexroad.catalog.scan.plateaus import plateau_notes
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import count
from flexroad.catalog.tile import HEIGHTS
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.check.finding import Finding, evenly
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.layers import check_layers
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import coregistration
from flexroad.tools.check.decks import deck_findings

MAX_PHOTO_TILES = 12
"""Number of tiles whose photo is compared with the heights, spread evenly over the catalog."""


def check(catalog: Catalog, config: Config, path: Path, every_deck: bool = False) -> Iterator[Finding]:
    """Yield the contents of a catalog, what would fail in a run with a configuration, and unnamed decks.

    - `path`: file of the catalog: the map of decks is written beside it (`deck_findings`).
    - `every_deck`: whether to look for decks on all tiles of a large catalog.
    """
    check_allowed(catalog)
    tiles = catalog.usable
    sizes = Counter(f"{tile.grid.width}x{tile.grid.height} at {tile.grid.cell:g} m" for tile in tiles)
    systems = sorted({short(tile.grid.crs) for tile in tiles})
    yield Finding(f"{count(len(tiles), 'tile')} of {', '.join(sizes)}; {', '.join(systems)}")
    counts = {name: sum(tile.layer(name) is not None for tile in tiles) for name in LAYERS}
    yield Finding("tiles with " + ", ".join(f"{name}: {number}" for name, number in counts.items() if number))
    try:
        check_layers(config, catalog)
    except ConfigError as error:
        yield Finding(f"a run would not start: {error}", fault=True)
    yield from expected_failures(catalog.tiles, config, LAYERS)
    yield from _plateaus(tiles)
    yield from _photos([tile for tile in tiles if tile.layer("dop")])
    yield from deck_findings(tiles, config, path, every_deck)


def _plateaus(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Name the files of heights of which many cells have one exact value."""
    files: dict[str, dict[str, Location]] = defaultdict(dict)
    for tile in tiles:
        for layer in (layer for layer in tile.layers if layer.name in HEIGHTS):
            files[layer.name].update(zip(layer.files, tile.paths(layer), strict=True))
    for name in (name for name in HEIGHTS if name in files):
        for note in plateau_notes(name, files[name]):
            yield Finding(note)


def _photos(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Compare photos with heights on a sample of the tiles that have the most frequent cell size."""
    tiles = [tile for tile in tiles if coregistration.large_enough(tile.grid)]
    cells = Counter(tile.grid.cell for tile in tiles)
    tiles = [tile for tile in tiles if tile.grid.cell == cells.most_common(1)[0][0]]
    sample = evenly(tiles, MAX_PHOTO_TILES)
    pairs: list[coregistration.Pair] = []
    for tile in sample:
        try:
            pairs.append(_pair(tile))
        except TaskError as error:
            yield Finding(f"{tile.id}: {error}", fault=True)
    if pairs:
        yield _shift(pairs, sample[0].grid.cell)


def _pair(tile: Tile) -> coregistration.Pair:
    data = load.load(tile, load.Options(min_valid=0.0))
    assert data.dop is not None  # the caller selects tiles with a photo
    return coregistration.pair(data, read_photo(data.dop, data.grid))


def _shift(pairs: Sequence[coregistration.Pair], cell: float) -> Finding:
    shift = coregistration.shift(pairs)
    tile_shifts = [coregistration.shift([pair], shift.sun) for pair in pairs]
    scatter = median(
        ((tile.east_m - shift.east_m) ** 2 + (tile.north_m - shift.north_m) ** 2) ** 0.5
        for tile in tile_shifts
    )
    measured = (
        f"{shift} of the heights (over {count(len(pairs), 'tile')}, half of them within "
        f"{scatter:.1f} m of that; sun at {shift.sun[0]:.0f}°, {shift.sun[1]:.0f}° high; "
        f"confidence {shift.confidence:.2f})"
    )
    if not coregistration.matters(shift, cell, scatter):
        return Finding(f"dop: {measured}: no significant shift")
    if shift.confidence < coregistration.CLEAR:
        line = f"dop seems to lie {measured}: too unclear to move it; compare it with the heights in a GIS"
        return Finding(line, warning=True)
    return Finding(
        f"dop lies {measured}: move it, e.g. with gdal_translate -a_ullr, before it is used with them",
        fault=True,
    )
