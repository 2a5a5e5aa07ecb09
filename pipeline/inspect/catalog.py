"""Check of a catalog: layers per tile, missing files, shift of the orthophoto against the heights."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

from flexroad.catalog import LAYERS, Catalog, Tile
from flexroad.catalog.allowlist import check_allowed
from flexroad.catalog.crs import short
from flexroad.catalog.storage.paths import Location, StatCache
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.roads import coregistration

MAX_PHOTO_TILES = 12
"""Number of tiles whose photo is compared with the heights, spread evenly over the catalog."""
MAX_SHOWN = 5
"""Number of missing files, and of entries that cannot be used, that are named."""


@dataclass(frozen=True)
class Finding:
    """One line about a catalog."""

    text: str
    fault: bool = False
    """Whether this should be corrected before a run."""


def check(catalog: Catalog) -> Iterator[Finding]:
    """Yield the contents and the faults of a catalog, the fast checks first.

    Raises
    ------
    CatalogError
        If a tile names a file that the catalog may not read (`Catalog.read`).
    """
    check_allowed(catalog)
    tiles = catalog.usable
    sizes = Counter(f"{tile.grid.width}x{tile.grid.height} at {tile.grid.cell:g} m" for tile in tiles)
    systems = sorted({short(tile.grid.crs) for tile in tiles})
    yield Finding(f"{len(tiles)} tiles of {', '.join(sizes)}; {', '.join(systems)}")
    counts = {name: sum(tile.layer(name) is not None for tile in tiles) for name in LAYERS}
    faults = [tile for tile in catalog.tiles if tile.fault]
    for tile in faults[:MAX_SHOWN]:
        yield Finding(f"{tile.id}: {tile.fault}", fault=True)
    if len(faults) > MAX_SHOWN:
        yield Finding(f"{len(faults) - MAX_SHOWN} more entries cannot be used", fault=True)
    yield Finding("tiles with " + ", ".join(f"{name}: {count}" for name, count in counts.items() if count))
    for name in ("dsm", "dtm"):
        if counts[name] < len(tiles):
            yield Finding(f"{len(tiles) - counts[name]} tiles have no {name}: they will fail", fault=True)
    yield from _missing(tiles)
    yield from _photos([tile for tile in tiles if tile.layer("dop")])


def _missing(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Name the missing files, each with the number of tiles that it lies on."""
    files: Counter[Location] = Counter()
    for tile in tiles:
        for layer in tile.all_layers:
            files.update(dict.fromkeys(tile.paths(layer), 0))
            on_tile = layer.reaching(tile.grid.bounds)
            files.update(tile.paths(on_tile) if on_tile else ())
    stat = StatCache()
    missing = [(path, count) for path, count in files.items() if stat(path) is None]
    for path, count in missing[:MAX_SHOWN]:
        yield Finding(f"missing: {path} ({count} tile{'s' * (count != 1)})", fault=True)
    if len(missing) > MAX_SHOWN:
        yield Finding(f"missing: {len(missing) - MAX_SHOWN} more files", fault=True)


def _photos(tiles: Sequence[Tile]) -> Iterator[Finding]:
    """Compare photos with heights on a sample of the tiles that have the most frequent cell size."""
    tiles = [tile for tile in tiles if coregistration.large_enough(tile.grid)]
    cells = Counter(tile.grid.cell for tile in tiles)
    tiles = [tile for tile in tiles if tile.grid.cell == cells.most_common(1)[0][0]]
    count = min(MAX_PHOTO_TILES, len(tiles))
    sample = [tiles[i * len(tiles) // count] for i in range(count)]
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
        f"{shift} of the heights (over {len(pairs)} tile{'s' * (len(pairs) != 1)}, half of them within "
        f"{scatter:.1f} m of that; sun at {shift.sun[0]:.0f}°, {shift.sun[1]:.0f}° high; "
        f"confidence {shift.confidence:.2f})"
    )
    if not coregistration.matters(shift, cell, scatter):
        return Finding(f"dop: {measured}: no significant shift")
    return Finding(
        f"dop lies {measured}: move it, e.g. with gdal_translate -a_ullr, before it is used with them",
        fault=True,
    )
