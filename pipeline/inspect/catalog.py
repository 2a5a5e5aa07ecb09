"""Look a catalog over: what its tiles have, what is missing, how far the photo lies off the heights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

from flexroad.catalog import LAYERS, Catalog, Tile
from flexroad.catalog.crs import short
from flexroad.catalog.storage.paths import Location, StatCache
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import coregistration

MOST = 12
"""Tiles whose photo is compared with the heights: spread evenly over the catalog."""
SHOWN = 5
"""Missing files that are named."""


@dataclass(frozen=True)
class Finding:
    """One line about a catalog."""

    text: str
    fault: bool = False
    """Whether something should be mended before a run."""


def check(catalog: Catalog) -> Iterator[Finding]:
    """Tell what a catalog has and what is amiss, the quick things first."""
    tiles = catalog.tiles
    sizes = Counter(f"{tile.grid.width}x{tile.grid.height} at {tile.grid.cell:g} m" for tile in tiles)
    systems = sorted({short(tile.grid.crs) for tile in tiles})
    yield Finding(f"{len(tiles)} tiles of {', '.join(sizes)}; {', '.join(systems)}")
    had = {name: sum(tile.layer(name) is not None for tile in tiles) for name in LAYERS}
    yield Finding("tiles with " + ", ".join(f"{name}: {count}" for name, count in had.items() if count))
    for name in ("dsm", "dtm"):
        if had[name] < len(tiles):
            yield Finding(f"{len(tiles) - had[name]} tiles have no {name}: they will fail", fault=True)
    yield from _missing(tiles)
    yield from _photos([tile for tile in tiles if tile.layer("dop")])


def _missing(tiles: Sequence[Tile]) -> Iterator[Finding]:
    wanted: Counter[Location] = Counter(
        path for tile in tiles for layer in tile.layers for path in tile.paths(layer)
    )
    look = StatCache()
    gone = [(path, count) for path, count in wanted.items() if look(path) is None]
    for path, count in gone[:SHOWN]:
        yield Finding(f"missing: {path} ({count} tile{'s' * (count != 1)})", fault=True)
    if len(gone) > SHOWN:
        yield Finding(f"missing: {len(gone) - SHOWN} files more", fault=True)


def _photos(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Compare photo and heights on some tiles, first by cell: only like lattices can be taken together."""
    tiles = [tile for tile in tiles if coregistration.large_enough(tile.grid)]
    cells = Counter(tile.grid.cell for tile in tiles)
    tiles = [tile for tile in tiles if tile.grid.cell == cells.most_common(1)[0][0]]
    some = [tiles[i * len(tiles) // min(MOST, len(tiles))] for i in range(min(MOST, len(tiles)))]
    pairs: list[coregistration.Pair] = []
    for tile in some:
        try:
            pairs.append(_pair(tile))
        except TaskError as error:
            yield Finding(f"{tile.id}: {error}", fault=True)
    if pairs:
        yield _shift(pairs, some[0].grid.cell)


def _pair(tile: Tile) -> coregistration.Pair:
    data = load.load(tile, load.Options(min_valid=0.0))
    assert data.dop is not None  # only tiles with a photo are asked
    return coregistration.pair(data, read_photo(data.dop, data.grid))


def _shift(pairs: Sequence[coregistration.Pair], cell: float) -> Finding:
    found = coregistration.shift(pairs)
    each = [coregistration.shift([pair], found.sun) for pair in pairs]
    scatter = median(
        ((one.east_m - found.east_m) ** 2 + (one.north_m - found.north_m) ** 2) ** 0.5 for one in each
    )
    measured = (
        f"{found} of the heights (over {len(pairs)} tile{'s' * (len(pairs) != 1)}, half of them within "
        f"{scatter:.1f} m of that; sun at {found.sun[0]:.0f}°, {found.sun[1]:.0f}° high; "
        f"confidence {found.confidence:.2f})"
    )
    if not coregistration.matters(found, cell, scatter):
        return Finding(f"dop: {measured}: not clearly off")
    return Finding(
        f"dop lies {measured}: move it, e.g. with gdal_translate -a_ullr, before it is used with them",
        fault=True,
    )
