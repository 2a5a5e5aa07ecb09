"""Expected failures of a run: unusable entries, missing layers and files, other CRSs, too few heights."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rasterio.windows import Window

from flexroad.catalog import Catalog, CatalogError, Layer, Tile
from flexroad.catalog.crs import in_plan, same, short
from flexroad.catalog.crs_checks import crs_of
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.guard.source_files import InputRejected, head
from flexroad.catalog.scan.cell_values import AS_TEXT, height_share
from flexroad.catalog.scan.rasters import heights_fault, quiet
from flexroad.catalog.storage.buckets import StatCache
from flexroad.catalog.storage.paths import Location
from flexroad.catalog.text import access_reason, count, some
from flexroad.catalog.tile import HEIGHTS
from flexroad.pipeline.check.trial import Finding, height_findings, trials
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.graph.layers import lacking, without_photo
from flexroad.tasks import load
from flexroad.tasks.io.raster_grid import header

MISSING, NO_FILE = "missing", "not a regular file"
REMEDIES = {MISSING: "restore it or build the catalog again", NO_FILE: "replace it by one"}
"""Remedies for files that are missing or not regular files."""
MAX_SHOWN = 5
"""Largest number of missing files, and of unusable entries, that are named."""


def expected_failures(tiles: Sequence[Tile], config: Config, layers: Collection[str]) -> Iterator[Finding]:
    """Yield the expected failures of a run of these tiles: the number and first examples for each reason.

    The reasons are entries that cannot be used, missing layers and files, rasters in another CRS than their
    tile, and a DSM that covers less of a tile than `load.min_valid`. Every raster is opened once, and the DSM
    is read. Some tiles, first the tiles with doubtful files, are read like in a run (`trials`), and their
    DSM and DTM are compared (`height_findings`).
    """
    unusable = [tile for tile in tiles if tile.fault]
    for tile in unusable[:MAX_SHOWN]:
        yield Finding(f"{tile.id}: {tile.fault}", fault=True, failing=frozenset({tile.id}))
    if more := frozenset(tile.id for tile in unusable[MAX_SHOWN:]):
        yield Finding(f"{len(more)} more entries cannot be used", fault=True, failing=more)
    usable = [tile for tile in tiles if not tile.fault]
    if note := Catalog(tuple(usable)).same_places():
        yield Finding(note)
    named = set[str]()
    for layer, stage, ids in lacking(usable, config):
        yield _would_fail(ids, usable, f"no {layer}, which {stage} needs")
    absent = _absent(usable, layers)
    yield from _missing(usable, layers, absent)
    by_reason, doubtful = _unfit(usable, config)
    for reason, ids in by_reason.items():
        named.update(ids)
        yield _would_fail(ids, usable, reason)
    if set(load.NEEDS) <= set(layers):
        read, faults = trials(usable, config, named, doubtful, {str(path) for path in absent})
        yield from faults
        yield from height_findings(read)
    if plain := without_photo(usable, config):
        yield Finding(
            f"{len(plain)} of {count(len(usable), 'tile')} would have no texture: no dop, which "
            f"export.texture needs: {some(plain)}"
        )


def _would_fail(ids: Sequence[str], tiles: Sequence[Tile], reason: str) -> Finding:
    line = f"{len(ids)} of {count(len(tiles), 'tile')} would fail: {reason}: {some(ids)}"
    return Finding(line, fault=True, failing=frozenset(ids))


def _absent(tiles: Sequence[Tile], layers: Collection[str]) -> dict[Location, str]:
    """Return the files that are missing or cannot be read, each with the reason."""
    stat = StatCache()
    files = dict.fromkeys(
        path
        for tile in tiles
        for layer in tile.all_layers
        if layer.name in layers
        for path in tile.paths(layer)
    )
    return {path: reason for path in files if (reason := _no_access(path, stat))}


def _missing(
    tiles: Sequence[Tile], layers: Collection[str], absent: Mapping[Location, str]
) -> Iterator[Finding]:
    """Name the files that are missing or cannot be read, each with the number of tiles that it lies on."""
    on_file: dict[Location, set[str]] = defaultdict(set)
    for tile in tiles if absent else ():
        for path in (path for layer in tile.layers_on(layers) for path in tile.paths(layer)):
            on_file[path].add(tile.id)
    by_reason: dict[str, list[Location]] = defaultdict(list)
    for path, reason in absent.items():
        by_reason[reason].append(path)
    for reason, paths in by_reason.items():
        remedy = f"; {REMEDIES[reason]}" if reason in REMEDIES else ""
        for path in paths[:MAX_SHOWN]:
            line = f"{reason}: {path} ({count(len(on_file[path]), 'tile')}){remedy}"
            yield Finding(line, fault=True, failing=frozenset(on_file[path]))
        if more := paths[MAX_SHOWN:]:
            failing = frozenset(tile for path in more for tile in on_file[path])
            yield Finding(f"{reason}: {len(more)} more files", fault=True, failing=failing)


def _no_access(path: Location, stat: StatCache) -> str | None:
    """Return why a file is missing or closed to this user; None if it can be read."""
    if not isinstance(path, Path):
        return MISSING if stat(path) is None else None
    try:
        head(path)
    except FileNotFoundError:
        return MISSING
    except InputRejected:
        return NO_FILE
    except OSError as error:
        return access_reason(error) or str(error)
    return None


@dataclass(frozen=True)
class _Header:
    """The properties of a raster, found by opening it once."""

    crs: str | None
    """Horizontal CRS, or the given one; None if both are missing or unusable."""
    unit: str = ""
    doubtful: bool = False
    """Whether it cannot be opened, has no usable position or heights, or lacks its last block."""


def _unfit(tiles: Sequence[Tile], config: Config) -> tuple[dict[str, list[str]], set[str]]:
    """Return the tiles that would fail, by reason, and the tiles with a doubtful file.

    The reasons are a raster in another CRS, and a DSM with too few heights.
    """
    min_valid = max(chain["load"].min_valid for chain in config.chains.values())
    known: dict[tuple[Location, str | None], _Header] = {}
    by_reason: dict[str, list[str]] = defaultdict(list)
    doubtful = set[str]()
    for tile in tiles:
        headers = _headers(tile, known)
        share = _share(tile)
        low = f"a DSM height in less than {min_valid:.0%} of the cells (load.min_valid)"
        if reason := _other_crs(tile, headers) or (low if share and share < min_valid else ""):
            by_reason[reason].append(tile.id)
        units = {found.unit for layer, found in headers if layer.name in HEIGHTS}
        # A file without any height may lie elsewhere, or be in another unit.
        if not share or len(units) > 1 or any(found.doubtful for _, found in headers):
            doubtful.add(tile.id)
    return by_reason, doubtful


def _headers(tile: Tile, known: dict[tuple[Location, str | None], _Header]) -> list[tuple[Layer, _Header]]:
    """Return the headers of the rasters on a tile; ``known`` has the headers that were read before."""
    found = []
    for layer in tile.layers_on(load.READS):
        for path in tile.paths(layer):
            key = path, layer.crs
            if key not in known:
                known[key] = _header(path, layer)
            found.append((layer, known[key]))
    return found


def _other_crs(tile: Tile, headers: Sequence[tuple[Layer, _Header]]) -> str:
    """Return why a tile would fail if a raster on it is in another CRS."""
    for layer, found in headers:
        if not layer.reproject and found.crs and not same(found.crs, tile.grid.crs):
            remedy = "reproject it, or make the catalog with --reproject"
            return f"{layer.name} is in {short(found.crs)}, not {short(tile.grid.crs)}; {remedy}"
    return ""


def _header(path: Location, layer: Layer) -> _Header:
    try:
        with quiet(), open_raster(path) as raster:
            crs = crs_of(raster.crs.to_wkt() if raster.crs else None, layer.crs, raster.bounds)
            fault = header(raster).fault or (heights_fault(raster) if layer.name in HEIGHTS else None)
            if Path(str(path)).suffix.lower() not in AS_TEXT:
                # A truncated file does not have its last block.
                raster.read(1, window=Window(raster.width - 1, raster.height - 1, 1, 1))
            return _Header(in_plan(crs) if crs else None, raster.units[0] or "", bool(fault))
    except (*ERRORS, CatalogError):
        return _Header(layer.crs, doubtful=True)


def _share(tile: Tile) -> float | None:
    """Return the share of a tile's cells that has a height in the DSM (0 to 1), None if it is not known."""
    dsm = next(iter(tile.layers_on(("dsm",))), None)
    return height_share(tile.grid, tile.paths(dsm), dsm.crs) if dsm else None
