"""Bring the tiles of a run up to date: look at each, do what is to do, write the tables."""

from __future__ import annotations

import contextlib
import time
from array import array
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial

from flexroad.catalog import Tile
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.graph.graph import TileGraph, any_gone
from flexroad.pipeline.run.event_log import EventLog
from flexroad.pipeline.run.record import Run, check_models
from flexroad.pipeline.run.status import tile_statuses
from flexroad.pipeline.run.summary import Summary, summarise, write_summary
from flexroad.pipeline.store.artefacts import check_writable
from flexroad.pipeline.store.database import NAME as DATABASE
from flexroad.pipeline.store.database import RunDatabase, TileState
from flexroad.pipeline.store.records import Failure
from flexroad.pipeline.store.tables import write_tables
from flexroad.pipeline.worker.profiling import now
from flexroad.pipeline.worker.tile import TileJob, TileResult, failed_row, process_tile, record_failure


@dataclass(frozen=True)
class Plan:
    """What a run has to do, and what became of its tiles since the last one."""

    todo: array[int]
    """Where in the catalog the tiles to do are."""
    new: int
    changed: int
    vanished: int


def run_tiles(
    run: Run,
    executor: Executor,
    only: Callable[[Tile], bool] = lambda tile: True,
    force: frozenset[str] = frozenset(),
    watch: Callable[[TileResult], None] = lambda result: None,
    verify: bool = False,
) -> Summary:
    """Bring the run's tiles up to date, write the tables, then summary.json.

    Parameters
    ----------
    only : callable
        Which tiles; the tables are over all of them.
    anew : frozenset of str
        Stages to compute even if the store has them.
    watch : callable
        Told of every result as it comes, those found done included.
    verify : bool
        Read all products, and do again the tiles whose are not what was written.

    Raises
    ------
    ConfigError
        If a model is missing, or each of several tiles lacks a file.
    OSError
        If the database or the tables cannot be written, as on a full disk.
    """
    check_models(run.config)
    with RunDatabase.open(run.path / DATABASE) as database, EventLog(run.path) as journal:
        journal.note("run", tiles=len(run.catalog.tiles), config=run.config.name, versions=run.versions)
        close = partial(_close, run, database, journal, now(), time.perf_counter())
        stock = None
        try:
            stock = plan_run(run, database, only, force, watch, verify)
            with contextlib.closing(_results(run, executor, database, _jobs(run, stock, force))) as results:
                for result in results:
                    database.record(result.entry)
                    journal.tile(result)
                    watch(result)
        except BaseException as error:
            # What is done is in the tables.
            close(stock, error)
            raise
        return close(stock)


def plan_run(
    run: Run,
    database: RunDatabase,
    only: Callable[[Tile], bool],
    force: frozenset[str],
    watch: Callable[[TileResult], None],
    verify: bool,
) -> Plan:
    """Look at every tile once, bring the database up to date, and tell what there is to do.

    Raises
    ------
    ConfigError
        If each of several tiles lacks a file.
    """
    todo, standings, new, changed, gone = array("L"), list[TileState](), 0, 0, 0
    for position, found in enumerate(tile_statuses(run, database)):
        gone += any_gone(found.graph)
        wanted = only(found.graph.tile)
        if wanted and verify and found.done and not run.folder(found.graph.tile.id).verified():
            found = replace(found, up_to_date=False)
        new += found.last_record is None
        changed += found.last_record is not None and not found.up_to_date
        standing: TileState = "done" if found.done else "failed" if found.failed else "pending"
        if found.last_record and found.from_marker:
            database.record(found.last_record)
        if found.last_record and wanted and found.done and found.sources_present and not force:
            standing = "cached"
            watch(TileResult(found.last_record, "cached"))
        elif wanted:
            todo.append(position)
        standings.append(standing)
    if gone == len(run.catalog.tiles) > 1:
        # Not to be told by each tile, whose results would be lost by it.
        raise ConfigError(_nothing_there(run, found.graph))
    database.flush()
    names = (tile.id for tile in run.catalog.tiles)
    vanished = database.ask(zip(names, standings, strict=True))
    return Plan(todo, new, changed, vanished)


def _nothing_there(run: Run, graph: TileGraph) -> str:
    path = next(path for path, seen in graph.seen.items() if seen is None)
    return (
        f"each of the {len(run.catalog.tiles)} tiles lacks a file, as tile {graph.tile.id} does {path}; "
        "is the disk with the survey mounted?"
    )


def _jobs(run: Run, stock: Plan, force: frozenset[str]) -> Iterator[TileJob]:
    look = run.sightings()
    for position in stock.todo:
        # Made a second time: thousands kept since the stocktaking would fill the memory, and be old by now.
        yield run.job(run.graph(run.catalog.tiles[position], look), force)


def _results(
    run: Run, executor: Executor, database: RunDatabase, jobs: Iterator[TileJob]
) -> Generator[TileResult, None, None]:
    """Yield what tiles come to; at the end record those that got done although nobody heard of it."""
    flying: dict[str, Tile] = {}

    def noted() -> Iterator[TileJob]:
        for job in jobs:
            flying[job.graph.tile.id] = job.graph.tile
            yield job

    found = executor.map(process_tile, noted(), _lost, partial(check_writable, run.store))
    try:
        for result in found:
            flying.pop(result.tile_id)
            yield result
    finally:
        # Interrupted: first nobody works any more, then what lies there counts.
        found.close()
        for stand in tile_statuses(run, database, flying.values()):
            if stand.last_record and stand.from_marker:
                database.record(stand.last_record)


def _close(
    run: Run,
    database: RunDatabase,
    journal: EventLog,
    start: str,
    began: float,
    stock: Plan | None,
    error: BaseException | None = None,
) -> Summary:
    """Write the tables and the summary, as far as the run came."""
    refused = str(error) if isinstance(error, ConfigError) else ""
    interrupted = isinstance(error, KeyboardInterrupt)
    how = replace(summarise(len(run.catalog.tiles), database), interrupted=interrupted, refused=refused)
    if stock:
        how = replace(how, new=stock.new, changed=stock.changed, vanished=stock.vanished)
        write_tables(run.path, database.rows(), database.failures())
    how = replace(how, seconds=round(time.perf_counter() - began, 3))
    journal.note("end", **{name: value for name, value in asdict(how).items() if name != "failures"})
    about = {"start": start, "end": now(), "config": run.config.name, "origin": list(run.origin)}
    write_summary(run.path, how, **about)
    return how


def _lost(job: TileJob, why: str) -> TileResult:
    """Make the failed result of a tile whose worker died."""
    graph = job.graph
    failure = Failure(graph.tile.id, "worker", "WorkerDied", why)
    rows = [failed_row(graph, variant, failure.line) for variant in graph.variants]
    return TileResult(record_failure(job, rows, [failure]), "failed")
