"""The state of a run's tiles: the database compared with the tiles' folders and their sources.

Each tile costs one row of the database, one listing of its folder and one stat of each source file. A marker
is read only if it is not the one in the database.
"""

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property

from flexroad.catalog import Tile
from flexroad.catalog.storage.paths import FileStat, Location, is_remote, listing, read
from flexroad.pipeline.graph.graph import Stat, TileGraph, any_gone
from flexroad.pipeline.run.lock import Owner
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.summary import MOST_TOLD, Summary, read_summary, summarise
from flexroad.pipeline.store.database import NAME, RunDatabase
from flexroad.pipeline.store.products import TileProducts
from flexroad.pipeline.store.records import (
    DONE,
    FAILED,
    Failure,
    MarkerStat,
    TileRecord,
    from_failed,
    from_item,
)

DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError)


@dataclass(frozen=True)
class TileStatus:
    """How one tile stands."""

    graph: TileGraph
    """As its sources and the options are now; sources that are gone as they were when the tile was done."""
    last_record: TileRecord | None
    """Its last result, of whatever sources and options."""
    up_to_date: bool
    """Whether that result is of this graph, and its products are there."""
    sources_present: bool
    """Whether besides its sources are all there."""
    from_marker: bool
    """Whether the database does not have that result: it was read from the marker."""

    @property
    def done(self) -> bool:
        """Whether the tile has the result that is asked for."""
        return self.up_to_date and self.last_record is not None and self.last_record.state == "done"

    @property
    def failed(self) -> bool:
        """Whether it was tried as it is now, and failed."""
        return self.up_to_date and self.last_record is not None and self.last_record.state == "failed"


@dataclass(frozen=True)
class Folders:
    """The files of a run's tiles: folder by folder on disk, by one list of a bucket."""

    run: Location

    def __call__(self, tile_id: str) -> dict[str, FileStat]:
        """Return the files of a tile by name."""
        folder = TileProducts.of(self.run, tile_id).path
        return self._listed.get(folder.name, {}) if is_remote(self.run) else listing(folder)

    @cached_property
    def _listed(self) -> dict[str, dict[str, FileStat]]:
        found: defaultdict[str, dict[str, FileStat]] = defaultdict(dict)
        for name, seen in listing(self.run / "tiles").items():
            folder, _, file = name.partition("/")
            found[folder][file] = seen
        return dict(found)


def peek_statuses(run: Run, tiles: Iterable[Tile]) -> Iterator[TileStatus]:
    """Yield how tiles of a run stand now."""
    with RunDatabase.peek(run.path / NAME) as database:
        yield from tile_statuses(run, database, tiles)


def tile_statuses(
    run: Run, database: RunDatabase, tiles: Iterable[Tile] | None = None
) -> Iterator[TileStatus]:
    """Yield how tiles of a run stand now, all in the catalog's order if none are named; changes nothing."""
    folders, look = Folders(run.path), run.sightings()
    for tile in run.catalog.tiles if tiles is None else tiles:
        yield _stand(run, tile, database, folders(tile.id), look)


def _stand(run: Run, tile: Tile, database: RunDatabase, files: dict[str, FileStat], look: Stat) -> TileStatus:
    entry = database.get(tile.id)
    known = _last_result(run.folder(tile.id).path, entry, files)
    graph = run.graph(tile, look)
    current, unknown = _fits(known, graph, files), known is not entry
    if known is None or current or not any_gone(graph):
        return TileStatus(graph, known, current, current, unknown)
    graph = run.graph(tile, look, known.sources)
    return TileStatus(graph, known, _fits(known, graph, files), False, unknown)


def _last_result(folder: Location, entry: TileRecord | None, files: dict[str, FileStat]) -> TileRecord | None:
    """Return a tile's last result: by the database, if that is of the marker, else by the marker."""
    name = DONE if DONE in files else FAILED if FAILED in files else None
    if name is None:
        # A full disk leaves no marker, but what failed is known.
        return entry if entry and entry.state == "failed" and entry.marker is None else None
    marker = (name, files[name].size, files[name].version)
    return entry if entry and entry.marker == marker else _from_marker(folder, marker)


def _from_marker(folder: Location, marker: MarkerStat) -> TileRecord | None:
    try:
        found = json.loads(read(folder / marker[0]))
        return (from_item if marker[0] == DONE else from_failed)(found, marker)
    except DAMAGED:
        return None


def _fits(known: TileRecord | None, graph: TileGraph, files: dict[str, FileStat]) -> bool:
    if known is None or known.fingerprint != graph.fingerprint:
        return False
    return all(name in files and files[name].size == size for name, size in known.sizes.items())


def summary(run: Run) -> Summary:
    """Return how a run stands now: every tile, its sources and its products are looked at."""
    counts: Counter[str] = Counter()
    failures: list[Failure] = []
    with RunDatabase.peek(run.path / NAME) as database:
        for now in tile_statuses(run, database):
            counts["done"] += now.done
            counts["failed"] += now.failed
            counts["cached"] += now.done and database.standing(now.graph.tile.id) == "cached"
            if now.failed and now.last_record and len(failures) < MOST_TOLD:
                failures += now.last_record.failures
    tiles = len(run.catalog.tiles)
    left = tiles - counts["done"] - counts["failed"]
    found = Summary(tiles, counts["done"], counts["failed"], counts["cached"], left, failures=tuple(failures))
    last = read_summary(run.path)
    known = ("new", "changed", "vanished", "seconds", "interrupted", "refused")
    return replace(found, **{name: last[name] for name in known if name in last})


def progress(run: Run, who: Owner) -> tuple[Summary, str]:
    """Return how a run that a process is at work on stands, and how fast it goes, in words.

    By the database alone, so that it can be repeated every few seconds.
    """
    with RunDatabase.peek(run.path / NAME) as database:
        how, tried = summarise(len(run.catalog.tiles), database), database.tried_since(who.since)
    minutes = (time.time() - datetime.fromisoformat(who.since).timestamp()) / 60
    if not tried or minutes <= 0:
        return how, ""
    left = how.pending / (tried / minutes)
    return how, f", {tried / minutes:.1f} tiles a minute, about {left:.0f} min left"
