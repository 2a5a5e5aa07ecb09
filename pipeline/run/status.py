"""The state of a run's tiles: the database compared with the tiles' folders and source files.

Each tile takes one row of the database, one listing of its folder and one stat of each source file. A marker
is read only if it differs from the one in the database.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from flexroad.catalog import Tile
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.buckets import ListedFiles
from flexroad.catalog.storage.paths import FileStat, Location, entries, refresh
from flexroad.pipeline.graph.graph import TileGraph, any_file_missing
from flexroad.pipeline.graph.sources import Stat
from flexroad.pipeline.run.lock import Owner, owner
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.summary import Summary, read_summary, summarise
from flexroad.pipeline.store.database import NAME, Line, RunDatabase
from flexroad.pipeline.store.products import DAMAGED, TileProducts
from flexroad.pipeline.store.records import (
    DONE,
    FAILED,
    MarkerStat,
    TileRecord,
    TileState,
    from_failed,
    from_item,
)
from flexroad.pipeline.worker.tile import marker_stat

Track = Callable[[Iterable[Any], str, int], Iterable[Any]]
"""Takes items, name and number of items of a step; returns the items, and may show progress."""


def untracked(items: Iterable[Any], step: str, total: int) -> Iterable[Any]:
    """Return the items; a `Track` that shows nothing."""
    return items


@contextmanager
def ended(items: Iterable[Any]) -> Iterator[Iterable[Any]]:
    """Yield the items of a `Track`, and close it: after an error it would otherwise print further lines."""
    try:
        yield items
    finally:
        if isinstance(items, Generator):
            items.close()


@dataclass(frozen=True)
class TileStatus:
    """The current state of one tile."""

    graph: TileGraph
    """Graph of the current sources and options; missing sources have their recorded state."""
    last_record: TileRecord | None
    """Record of its last result, perhaps from other sources or options; None without a result."""
    up_to_date: bool
    """Whether the last result has the graph's fingerprint and its products exist."""
    sources_present: bool
    """Whether it is up to date, all its source files exist, and no file was left out."""
    from_marker: bool
    """Whether the record was read from the marker, because the database does not have it."""

    @property
    def done(self) -> bool:
        """Whether the tile has an up-to-date result."""
        return self.up_to_date and self.last_record is not None and self.last_record.state == "done"

    @property
    def failed(self) -> bool:
        """Whether the tile failed with the current sources and options."""
        return self.up_to_date and self.last_record is not None and self.last_record.state == "failed"

    @property
    def stale(self) -> bool:
        """Whether the tile has products from earlier sources or options."""
        return not self.done and self.last_record is not None and self.last_record.has_products


def tile_files(run: Location) -> Callable[[str], dict[str, FileStat]]:
    """Return a function from a tile's id to its files by name; in a bucket all tiles are listed at once."""
    if isinstance(run, Path):
        return lambda tile_id: TileProducts.of(run, tile_id).files()

    @cache
    def listed() -> ListedFiles:
        files = ListedFiles()
        parts = ((name.partition("/"), file) for name, file in entries(run / "tiles"))
        files.add((folder, name, file) for (folder, _, name), file in parts)
        return files

    return lambda tile_id: listed().files(safe_name(tile_id))


def peek_statuses(run: Run, tiles: Iterable[Tile]) -> Iterator[TileStatus]:
    """Yield the current state of tiles of a run; opens the database read-only."""
    with open_database(run) as database:
        yield from tile_statuses(run, database, tiles)


def tile_statuses(
    run: Run, database: RunDatabase, tiles: Iterable[Tile] | None = None, from_markers: bool = False
) -> Iterator[TileStatus]:
    """Yield the current state of tiles of a run, by default all tiles, in the catalog's order; read-only.

    With ``from_markers`` all markers are read, even if the database has their records.
    """
    files_of, stat_file = tile_files(run.path), run.stat_cache()
    for tile in run.catalog.tiles if tiles is None else tiles:
        entry = database.get(tile.id)
        # A failure on a full disk has no marker, only a database entry.
        known = None if from_markers and entry and entry.marker else entry
        yield _status(run, tile, known, files_of(tile.id), stat_file)


def _status(
    run: Run, tile: Tile, entry: TileRecord | None, files: dict[str, FileStat], stat_file: Stat
) -> TileStatus:
    """Return the state of a tile, from its entry in the database and the files in its folder."""
    record = last_record(run.folder(tile.id), entry, files)
    graph = run.graph(tile, stat_file)
    from_marker, renamed = record is not entry, record.renamed if record else {}
    made = graph.renamed(renamed)
    current = matches(record, made, files)
    if current:
        return TileStatus(made, record, True, not renamed, from_marker)
    if record is None or not any_file_missing(graph):
        return TileStatus(graph, record, False, False, from_marker)
    made = run.graph(tile, stat_file, record.sources).renamed(renamed)
    return TileStatus(made, record, matches(record, made, files), False, from_marker)


def last_record(
    folder: TileProducts, entry: TileRecord | None, files: dict[str, FileStat]
) -> TileRecord | None:
    """Return a tile's last record: from the database if it belongs to the current marker, else from this."""
    name = DONE if DONE in files else FAILED if FAILED in files else None
    if name is None:
        # A failure on a full disk has no marker, only a database entry.
        return entry if entry and entry.state == "failed" and entry.marker is None else None
    marker = (name, files[name].size, files[name].version)
    return entry if entry and entry.marker == marker else _from_marker(folder, marker)


def _from_marker(folder: TileProducts, marker: MarkerStat) -> TileRecord | None:
    content = folder.marker(marker[0])
    if content is None:
        return None
    try:
        return (from_item if marker[0] == DONE else from_failed)(content, marker)
    except DAMAGED:
        return None


def matches(record: TileRecord | None, graph: TileGraph, files: dict[str, FileStat]) -> bool:
    """Return whether a record has the graph's fingerprint and all its products exist in their full size."""
    if record is None or record.fingerprint != graph.fingerprint:
        return False
    return all(name in files and files[name].size == size for name, size in record.sizes.items())


def has_marker(run: Run, record: TileRecord) -> bool:
    """Return whether the folder of a tile has the marker of this record."""
    folder = run.folder(record.tile_id)
    for _ in range(2):
        marker = marker_stat(folder, record.state)
        if marker is not None and marker == record.marker:
            return True
        # Some storages change the time of a file after the worker has read it.
        found = _from_marker(folder, marker) if marker else None
        if found and (found.fingerprint, found.finished) == (record.fingerprint, record.finished):
            return True
        refresh(folder.path.parent, folder.path)
    return False


def open_database(run: Run, write: bool = False) -> RunDatabase:
    """Open the run's database."""
    return RunDatabase(run.path / NAME, write)


def known_record(run: Run, database: RunDatabase, tile_id: str) -> TileRecord | None:
    """Return the record of a tile from the database, else from its marker."""
    folder = run.folder(tile_id)
    return database.get(tile_id) or last_record(folder, None, folder.files())


def tile_states(
    run: Run, database: RunDatabase, since: str | None = None
) -> Iterator[tuple[TileStatus, TileState]]:
    """Yield the status and the state of every tile; checks every tile, its sources and its products.

    A done tile is ``cached`` if the database says so. If the database is damaged, it is ``cached`` if it was
    finished before ``since``, by default the start of the last run.
    """
    last: dict[str, TileState] = {}
    if database.lists(tile.id for tile in run.catalog.tiles):
        last = {tile: state for tile, state, _ in database.entries()}
    since = last_start(run) if since is None else since
    for status in tile_statuses(run, database):
        if not status.done or status.last_record is None:
            yield status, "failed" if status.failed else "pending"
            continue
        tile_id, finished = status.last_record.tile_id, status.last_record.finished
        cached = last[tile_id] == "cached" if last else finished < since
        yield status, "cached" if cached else "done"


def last_start(run: Run) -> str:
    """Return the start time of the active or last run (ISO 8601, UTC); empty if unknown."""
    holder = owner(run.path)
    start = holder.since if holder else read_summary(run.path).get("start")
    return start if isinstance(start, str) else ""


def recorded(run: Run, database: RunDatabase, since: str | None = None) -> Iterator[Line]:
    """Yield id, state and record of every tile: from the database, or by `tile_states` if it is damaged."""
    if database.lists(tile.id for tile in run.catalog.tiles):
        yield from database.entries()
        return
    for status, state in tile_states(run, database, since):
        yield status.graph.tile.id, state, status.last_record


def pending_tiles(run: Run) -> Iterator[TileStatus]:
    """Yield the current state of each tile that the last execution left pending."""
    with open_database(run) as database:
        states = {tile for tile, state, _ in recorded(run, database) if state == "pending"}
        yield from tile_statuses(run, database, (tile for tile in run.catalog.tiles if tile.id in states))


def summary(
    run: Run, track: Track = untracked, each: Callable[[TileStatus, TileState], object] = lambda *_: None
) -> Summary:
    """Return the current summary of a run; checks every tile, its sources and its products.

    ``each`` receives status and state of every tile, in the catalog's order.
    """

    def checked(states: Iterable[tuple[TileStatus, TileState]]) -> Iterator[Line]:
        for status, state in states:
            each(status, state)
            yield status.graph.tile.id, state, status.last_record

    with open_database(run) as database:
        states = track(tile_states(run, database), "checking tiles", len(run.catalog.tiles))
        current = summarise(run.catalog, checked(states), run.config.export.variants[0])
    last = read_summary(run.path)
    names = ("new", "changed", "vanished", "seconds", "interrupted", "refused")
    return replace(current, **{name: last[name] for name in names if name in last})


def progress(run: Run, owner: Owner) -> tuple[Summary, str]:
    """Return the summary of an active run and its rate as text, ``""`` if no tile is finished yet.

    Only the database is read, so it can be repeated every few seconds; every tile is checked only if the
    database is damaged or does not have the catalog's tiles yet. ``owner`` is the process that runs it.
    """
    finished = 0

    def counted(lines: Iterable[Line]) -> Iterator[Line]:
        nonlocal finished
        for line in lines:
            finished += line[2] is not None and line[2].finished >= owner.since
            yield line

    with open_database(run) as database:
        lines = counted(recorded(run, database, owner.since))
        summary = summarise(run.catalog, lines, run.config.export.variants[0])
    minutes = (time.time() - datetime.fromisoformat(owner.since).timestamp()) / 60
    if not finished or minutes <= 0:
        return summary, ""
    left = summary.pending / (finished / minutes)
    return summary, f", {finished / minutes:.1f} tiles a minute, about {left:.0f} min left"
