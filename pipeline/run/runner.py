"""Bring the tiles of a run up to date: check each tile, process those that need it, write the tables."""

from __future__ import annotations

import contextlib
import statistics
import time
from array import array
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial

from flexroad.catalog import Tile
from flexroad.catalog.storage.paths import (
    Location,
    absolute,
    exists,
    flush_names,
    parse_location,
    read,
    stat,
    write,
)
from flexroad.catalog.storage.scratch import remove_abandoned
from flexroad.catalog.text import access_reason
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor, Jobs
from flexroad.pipeline.graph.graph import TileGraph, own_files_missing
from flexroad.pipeline.run.collection import write_collection
from flexroad.pipeline.run.events import EventLog
from flexroad.pipeline.run.record import Run, check_inputs
from flexroad.pipeline.run.status import (
    has_marker,
    open_database,
    recorded,
    tile_files,
    tile_states,
    tile_statuses,
)
from flexroad.pipeline.run.summary import Summary, read_summary, summarise, write_summary
from flexroad.pipeline.store.database import RunDatabase
from flexroad.pipeline.store.records import (
    DONE,
    Failure,
    MeshDistances,
    MetricsRow,
    TileRecord,
    TileState,
    utc_now,
    with_distances,
)
from flexroad.pipeline.store.tables import METRICS, PREVIOUS, write_tables
from flexroad.pipeline.worker.shared_files import SharedFiles
from flexroad.pipeline.worker.tile import (
    TileJob,
    TileResult,
    failed_row,
    process_tile,
    record_failure,
    without_results,
)


@dataclass(frozen=True)
class Plan:
    """The tiles to process, and counts of changes since the last run (see `Summary`)."""

    todo: array[int]
    """Indices in the catalog of the tiles to process."""
    tile_s: float | None
    """Median computing time of the tiles that were done before (s), or None."""
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
    """Bring the run's tiles up to date, write the tables, mosaics and collection, then summary.json.

    - `only`: filter of the tiles to process; the tables contain all tiles.
    - `force`: stages to compute even if their results are in the store.
    - `watch`: receives every result when it is available, including results of cached tiles.
    - `verify`: compare all products with their checksums, process tiles with a difference again, and make the
      tables from the markers, not from the database.
    """
    check_inputs(run.config, run.catalog)
    remove_abandoned()
    with open_database(run, write=True) as database, EventLog(run.path) as log:
        log.note("run", tiles=len(run.catalog.tiles), config=run.config.name, versions=run.versions)
        close = partial(_close, run, database, log, utc_now(), time.perf_counter())
        plan = None
        try:
            plan = plan_run(run, database, only, force, watch, verify)
            jobs = Jobs(
                _jobs(run, plan, force), len(plan.todo), plan.tile_s, lambda line: log.note("work", text=line)
            )
            with contextlib.closing(_results(run, executor, database, jobs)) as results:
                for result in results:
                    database.record(result.entry)
                    log.tile(result)
                    watch(result)
        except BaseException as error:
            # The tables are written also after an error, with the tiles done so far.
            close(plan, error)
            raise
        return close(plan)


def plan_run(
    run: Run,
    database: RunDatabase,
    only: Callable[[Tile], bool],
    force: frozenset[str],
    watch: Callable[[TileResult], None],
    verify: bool,
) -> Plan:
    """Check every tile once, update the database and return the tiles to process."""
    todo, states, new, changed, times = array("L"), list[TileState](), 0, 0, array("f")
    incomplete, last_incomplete = 0, None
    for position, status in enumerate(tile_statuses(run, database, from_markers=verify)):
        if own_files_missing(status.graph):
            incomplete, last_incomplete = incomplete + 1, status.graph
        selected = only(run.catalog.tiles[position])
        if selected and verify and status.done and not run.folder(status.graph.tile.id).verified():
            status = replace(status, up_to_date=False)
        if status.last_record and status.last_record.state == "done":
            times.append(status.last_record.seconds)
        new += status.last_record is None
        # A tile that was computed without an unusable file is computed again, although its result is valid.
        changed += status.last_record is not None and not (status.up_to_date and status.sources_present)
        state: TileState = "done" if status.done else "failed" if status.failed else "pending"
        if status.last_record and status.from_marker:
            database.record(status.last_record)
        if status.last_record and selected and status.done and status.sources_present and not force:
            state = "cached"
            watch(TileResult(status.last_record, "cached"))
        elif selected:
            todo.append(position)
        states.append(state)
    refuse_incomplete(run, incomplete, last_incomplete)
    database.flush()
    ids = (tile.id for tile in run.catalog.tiles)
    lost = sum(database.get(tile) is not None for tile in run.catalog.lost)
    vanished = database.set_states(zip(ids, states, strict=True)) - lost
    return Plan(todo, statistics.median(times) if times else None, new, changed, vanished)


def refuse_incomplete(run: Run, number: int, last: TileGraph | None) -> None:
    """Check that not each of several tiles lacks a file.

    This is one error of the run. If each tile failed by itself, all existing results would be lost.

    - `number`: number of tiles that lack a file.
    - `last`: the last of these tiles.
    """
    tiles = len(run.catalog.usable)
    if last is None or number != tiles or tiles < 2:
        return
    path = own_files_missing(last)[0]
    file = parse_location(path)
    try:
        if stat(file):
            remedy = "it cannot be read; make it readable"
        elif exists(file):
            remedy = "it is not a regular file; replace it by one"
        else:
            remedy = "is the disk with the survey mounted?"
    except OSError as error:
        remedy = f"it {access_reason(error)}; make it readable"
    raise ConfigError(
        f"each of the {tiles} tiles lacks a file, for example tile {last.tile.id}: {path}; {remedy}"
    )


def _jobs(run: Run, plan: Plan, force: frozenset[str]) -> Iterator[TileJob]:
    stat_file = run.stat_cache()
    for position in plan.todo:
        # The graph is made again: thousands of graphs from the planning would need much memory, and could be
        # out of date.
        yield run.job(run.graph(run.catalog.tiles[position], stat_file), force)


def _results(
    run: Run, executor: Executor, database: RunDatabase, jobs: Jobs[TileJob]
) -> Generator[TileResult, None, None]:
    """Yield the results of the jobs; at the end, record finished tiles whose result was lost."""
    in_progress: set[str] = set()

    def submitted() -> Iterator[TileJob]:
        for job in jobs:
            in_progress.add(job.graph.tile.id)
            yield job

    tracked = replace(jobs, source=submitted())
    probe = SharedFiles((str(absolute(run.path)), str(absolute(run.store))))
    results = executor.map(process_tile, tracked, _lost, probe)
    try:
        for result in results:
            in_progress.remove(result.tile_id)
            yield _with_marker(run, result)
    finally:
        # After an interruption: stop all workers first, then read the markers they have written.
        results.close()
        unknown = [tile for tile in run.catalog.tiles if tile.id in in_progress]
        for status in tile_statuses(run, database, unknown):
            if status.last_record and status.from_marker:
                database.record(status.last_record)


def _with_marker(run: Run, result: TileResult) -> TileResult:
    """Return the result of a tile; failed if the tile is done but its marker is missing."""
    reason = ""
    try:
        if result.status != "done" or has_marker(run, result.entry):
            return result
    except OSError as error:
        reason = f" ({error.strerror or error})"
    text = f"missing{reason}: the folder was deleted, or {result.host} writes to another disk"
    return replace(result, entry=_vanished(run, result.entry, text), status="failed")


def _vanished(run: Run, record: TileRecord, text: str) -> TileRecord:
    """Return the record of a tile that was done but whose marker is missing."""
    file = str(run.folder(record.tile_id).path / DONE)
    message = f"its results are {text}; run the same command again"
    return without_results(record, Failure(record.tile_id, "export", "ResultsMissing", message, file))


def _close(
    run: Run,
    database: RunDatabase,
    log: EventLog,
    start: str,
    start_s: float,
    plan: Plan | None,
    error: BaseException | None = None,
) -> Summary:
    """Write tables, mosaics, collection, the event ``end`` and the summary; also after an error.

    These files have the results up to now. ``start`` is the start time (ISO 8601), ``start_s`` the value of
    `time.perf_counter` at the start.
    """
    refused = str(error) if isinstance(error, ConfigError) else ""
    interrupted = isinstance(error, KeyboardInterrupt)
    distances = MeshDistances()
    summary = _final_summary(run, database, start, plan, interrupted)
    summary = replace(summary, interrupted=interrupted, refused=refused)
    if plan:
        summary = replace(summary, new=plan.new, changed=plan.changed, vanished=plan.vanished)
        if plan.todo:
            _keep_previous(run.path, run.config.cluster.flush)
        rows = with_distances(_rows(database), distances)
        write_tables(run.path, rows, _failures(database), run.config.cluster.flush)
        write_collection(run, list(_done(run, database)))
    summary = replace(summary, seconds=round(time.perf_counter() - start_s, 3))
    lists = ("failures", "flagged")
    log.note("end", **{name: value for name, value in asdict(summary).items() if name not in lists})
    about = {
        "start": start,
        "end": utc_now(),
        "config": run.config.name,
        "origin": list(run.origin),
        "mesh_distances": distances,
    }
    write_summary(run.path, summary, run.config.cluster.flush, **about)
    if run.config.cluster.flush:
        flush_names(run.path)
    return summary


def _rows(database: RunDatabase) -> Iterator[MetricsRow]:
    """Yield the metrics rows of all tiles that are not pending, in the catalog's order."""
    for _, state, record in database.entries():
        yield from record.rows if record and state != "pending" else ()


def _failures(database: RunDatabase) -> Iterator[Failure]:
    """Yield the failures of all failed tiles, in the catalog's order."""
    for _, state, record in database.entries():
        yield from record.failures if record and state == "failed" else ()


def _done(run: Run, database: RunDatabase) -> Iterator[Tile]:
    """Yield the done tiles."""
    for tile, (_, state, _) in zip(run.catalog.tiles, database.entries(), strict=True):
        if state in ("done", "cached"):
            yield tile


def _keep_previous(run: Location, flushed: bool) -> None:
    """Keep metrics.parquet as metrics.previous.parquet, if the last execution was complete.

    After an interrupted or refused execution, the table is incomplete, so the previous table stays.
    """
    last, table = read_summary(run), run / METRICS
    complete = last.get("pending") == 0 and not last.get("interrupted") and not last.get("refused")
    if complete and exists(table):
        write(run / PREVIOUS, read(table), flushed)


def _final_summary(
    run: Run, database: RunDatabase, start: str, plan: Plan | None, interrupted: bool
) -> Summary:
    """Return the summary at the end of a run that started at the time ``start``."""
    if plan:
        _repair(run, database, start)
        if plan.todo and not interrupted:
            # If no tile had to be processed, the markers have just been checked.
            _check_markers(run, database)
    elif interrupted and not database.lists(tile.id for tile in run.catalog.tiles):
        # An interrupted run should end soon. Checking the tiles would take as long as the interrupted start.
        return summarise(run.catalog, (), "")
    return summarise(run.catalog, recorded(run, database, start), run.config.export.variants[0])


def _repair(run: Run, database: RunDatabase, start: str) -> None:
    """Write the list of tiles again if it was damaged during the run."""
    if database.load() and database.lists(tile.id for tile in run.catalog.tiles):
        return
    database.set_states(())
    states: list[tuple[str, TileState]] = []
    for status, state in tile_states(run, database, start):
        if status.last_record and status.from_marker:
            database.record(status.last_record)
        states.append((status.graph.tile.id, state))
    database.flush()
    database.set_states(states)


def _check_markers(run: Run, database: RunDatabase) -> None:
    """Record done tiles as failed if their marker was removed during the run."""
    files_of = tile_files(run.path)
    for tile in [tile for tile in _done(run, database) if DONE not in files_of(tile.id)]:
        record = database.get(tile.id)
        if record:
            database.record(_vanished(run, record, "missing: its folder was deleted while the run worked"))


def _lost(job: TileJob, reason: str) -> TileResult:
    """Return the failed result of a tile whose worker died."""
    graph = job.graph
    failure = Failure(graph.tile.id, "worker", "WorkerDied", reason)
    rows = [failed_row(graph, variant, failure.line) for variant in graph.variants]
    return TileResult(record_failure(job, rows, [failure]), "failed")
