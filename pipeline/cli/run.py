"""``flexroad run``, ``rerun`` and ``status``: bring a run up to date, show its state."""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterator
from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from flexroad.catalog.area import Area
from flexroad.catalog.storage.paths import parse_location
from flexroad.catalog.text import count
from flexroad.pipeline.check.reasons import why_pending
from flexroad.pipeline.check.trial import road_is_off, road_step
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.dry_run import plan
from flexroad.pipeline.cli.limits import remedy
from flexroad.pipeline.cli.signals import INTERRUPTED, signals_interrupt
from flexroad.pipeline.cli.stdio import echo, echo_document, ignore_write_errors
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.options import INPUTS, OUTPUTS, TILES, WORK
from flexroad.pipeline.errors import ClusterLost, ConfigError
from flexroad.pipeline.execute.dask import check_address
from flexroad.pipeline.run.api import EXECUTORS, Prepared, Selection, Workers, created, process, reopened
from flexroad.pipeline.run.collection import write_states
from flexroad.pipeline.run.events import Observer
from flexroad.pipeline.run.lock import describe_owner, exit_reason, owner
from flexroad.pipeline.run.progress import FIRST_S, ProgressDisplay, said_repeatedly
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, pending_tiles, progress, summary
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.records import MetricsRow, TileState
from flexroad.pipeline.worker.tile import TileResult
from flexroad.tasks.io.dsm_and_dtm import is_offset, on_tiles

app = group()

SHOWN = 5
"""Number of flagged tiles that ``status`` names; summary.json has all of them."""


def _known(value: str) -> str:
    """Return the value of ``--executor``; a wrong one is refused before the catalog is read."""
    if value not in EXECUTORS:
        try:
            check_address(value)
        except ConfigError as error:
            raise typer.BadParameter(f"{error}, or {', '.join(EXECUTORS)}") from error
    return value


Executor = Annotated[
    str,
    options.under(
        WORK,
        "auto: worker processes if they save more time than their start takes; dask: always; serial: never; "
        "tcp://host:8786 or tls://host:8786: a running Dask scheduler.",
        metavar="auto|dask|serial|ADDRESS",
        callback=_known,
    ),
]
REPAIR = "repair what was skipped, repeat the `flexroad catalog` command, then `flexroad run`"
MOST_PENDING = 100
"""Largest number of pending tiles whose reasons are looked up."""
StageName = Literal["load", "segment", "ecsrc", "fit", "sample", "evaluate", "assess", "export"]


@app.command(cls=Command)
@ignore_write_errors()
def run(
    ctx: typer.Context,
    catalog: Annotated[Path, options.under(INPUTS, "Catalog of tiles.", metavar="CATALOG")],
    out: Annotated[
        Path, options.under(OUTPUTS, "Folder of the run; an existing run is resumed.", metavar="RUN")
    ],
    config: Annotated[
        str,
        options.under(
            INPUTS, "Configuration: a shipped name, such as production, or a YAML file.", metavar="NAME|FILE"
        ),
    ] = "production",
    settings: options.Settings = None,
    checksum: Annotated[
        bool, options.under(INPUTS, "Detect changed sources by content, not by size and time.", "--checksum")
    ] = False,
    store: Annotated[
        Path | None,
        options.under(OUTPUTS, "Folder of stage results that several runs share.", metavar="FOLDER"),
    ] = None,
    verify: options.Verify = False,
    tile: options.TileIds = None,
    bbox: options.Box = None,
    area: options.Area = None,
    executor: Executor = "auto",
    workers: options.MostWorkers = None,
    dashboard: options.Dashboard = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print why each tile would be computed, and what would fail.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="With --dry-run: also the stages of each tile.")
    ] = False,
) -> None:
    """Bring every tile of a run up to date.

    After an interruption, the same command resumes the run.
    """
    path, source = parse_location(out), parse_location(catalog)
    root = parse_location(store) if store else None
    if dry_run:
        chosen = load_config(config, settings or ())
        selection = Selection(tile or (), bbox, Area.read(area) if area else None)
        tiles, selected = selection.of(path, source, options.allowed(ctx), chosen)
        planned = Run.planned(path, chosen, tiles, root, checksum)
        raise typer.Exit(plan(planned, selected.tiles, echo, workers, verbose))
    with _interruptible() as shown:
        chosen = load_config(config, settings or ())
        selection = Selection(tile or (), bbox, Area.read(area) if area else None)
        with created(
            path,
            source,
            chosen,
            selection,
            store=root,
            checksum=checksum,
            allow=options.allowed(ctx),
            workers=Workers(executor, workers, dashboard),
            observer=shown,
        ) as prepared:
            _process(prepared, verify, shown)
    _exit(shown)


@app.command(cls=Command)
@ignore_write_errors()
def rerun(
    ctx: typer.Context,
    path: options.Run,
    tile: Annotated[
        list[str] | None, options.under(TILES, "These tiles: --tile ID ID ...", metavar="ID")
    ] = None,
    failed: Annotated[bool, options.under(TILES, "The tiles that failed.", "--failed")] = False,
    from_stage: Annotated[
        StageName | None,
        options.under(
            TILES, "Recompute this stage and all later ones; export: only write the products again.", "--from"
        ),
    ] = None,
    settings: options.WorkerSettings = None,
    executor: Executor = "auto",
) -> None:
    """Bring tiles of a run up to date again.

    For changes of source files or of RUN/config.yaml, and for failed tiles.
    """
    location = parse_location(path)
    with (
        _interruptible() as shown,
        reopened(
            location,
            tile or (),
            failed=failed,
            from_stage=from_stage,
            settings=settings or (),
            allow=options.allowed(ctx),
            workers=Workers(executor),
            observer=shown,
        ) as prepared,
    ):
        _process(prepared, False, shown)
    _exit(shown)


class Shown(Observer):
    """Shows the events of a run on standard error, and keeps its result; a context manager."""

    def __init__(self) -> None:
        self.exit_code = 0
        self.text = ""
        """The result of the command in one line."""
        self.summary: Summary | None = None
        """The state of the run; None if no tile was processed."""
        self.display: ProgressDisplay | None = None
        """Progress of the tiles, from the first one on until the block ends."""
        self.offsets: list[str] = []
        """Notes of tiles whose complete DSM lies off the DTM."""
        self.rows: list[MetricsRow] = []
        """Metrics of tiles whose complete road lies off the DTM, in any variant."""
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Shown:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @contextlib.contextmanager
    def working(self, work: str) -> Iterator[None]:
        """Print the name of the block's work if it takes long, as for catalogs of thousands of tiles."""

        def line(spent_s: float) -> str:
            return f"{work}, {spent_s:.0f} s spent"

        with said_repeatedly(line, lambda text: echo(text, err=True), FIRST_S):
            yield

    def note(self, text: str) -> None:
        """Print a note."""
        echo(f"note: {text}", err=True)

    def warning(self, text: str) -> None:
        """Print a warning."""
        echo(f"warning: {text}", err=True)

    def start(self, tiles: int, selected: int) -> None:
        """Show the progress."""
        self.display = self._stack.enter_context(ProgressDisplay(selected, Console(stderr=True)))

    def line(self, text: str) -> None:
        """Print a line above the progress."""
        if self.display:
            self.display.say(text)

    def tile(self, result: TileResult) -> None:
        """Add a tile to the progress."""
        self.offsets += filter(is_offset, result.notes)
        self.rows += filter(road_is_off, result.rows)
        if self.display:
            self.display(result)


@contextlib.contextmanager
def _interruptible() -> Iterator[Shown]:
    """Yield an observer for the block; it records an interruption, which is not raised again."""
    shown = Shown()
    try:
        with signals_interrupt():
            yield shown
    except KeyboardInterrupt:
        shown.exit_code, shown.text = INTERRUPTED, "interrupted; the same command goes on from here"


def _process(prepared: Prepared, verify: bool, shown: Shown) -> None:
    """Process the tiles and print the result."""
    folder = shlex.quote(str(prepared.run.path))
    try:
        with shown:
            summary = shown.summary = process(prepared, verify)
    except ClusterLost as error:
        shown.exit_code, shown.text = 1, f"{error}; the same command goes on from here"
        return
    except OSError as error:
        shown.exit_code = 1
        shown.text = f"{error}; {remedy(error)}, then run `flexroad rerun {folder}`"
        return
    shown.exit_code, shown.text = summary.exit_code, format_summary(summary)
    echo(f"{shown.text}; results in {prepared.run.path}")
    if shown.display and set(shown.display.status) == {"cached"}:
        echo("nothing had changed; `flexroad rerun RUN --from load` recomputes everything")
    for line in summary.left_out:
        shown.warning(line)
    for line in on_tiles(shown.offsets, summary.tiles):
        shown.warning(f"{line} `flexroad catalog check` compares them")
    main = prepared.run.config.export.variants[0]
    for line in road_step([row for row in shown.rows if row["variant"] == main], summary.tiles):
        shown.note(f"{line} `flexroad catalog check` compares them")
    if summary.done and summary.without_roads == summary.done and not shown.offsets:
        shown.warning(
            "no tile of this run has a road that the filter keeps; if there are roads, check the road source "
            "of the catalog and the options of segment and ecsrc"
        )
    _echo_next(summary, folder, prepared.run)


def format_summary(summary: Summary) -> str:
    """Return the state of a run in one line."""
    without = f", {summary.without_roads} without roads" if summary.without_roads else ""
    states = (
        f"{summary.done} done ({summary.cached} cached{without}), {summary.failed} failed, "
        f"{summary.pending} pending"
    )
    changes = f"{summary.new} new, {summary.changed} changed, {summary.vanished} vanished"
    lost = f", {count(summary.lost, 'tile')} lost" if summary.skipped and summary.lost else ""
    seconds = f"{summary.seconds:.0f} s{summary.to_look_at}"
    return f"{count(summary.tiles, 'tile')}: {states}; {changes}{summary.files_skipped}{lost}; {seconds}"


def _echo_next(summary: Summary, folder: str, run: Run) -> None:
    if summary.failed:
        echo(f"next: flexroad status {folder}, then flexroad rerun {folder} --failed")
    elif summary.pending:
        # The exit code is 1 although the selected tiles are done.
        for line in why_pending(run, islice(pending_tiles(run), MOST_PENDING)):
            echo(f"  {line}")
        tiles, have = count(summary.pending, "tile"), "has" if summary.pending == 1 else "have"
        echo(f"{tiles} {have} no result of the present files and options; next: flexroad rerun {folder}")
    if summary.skipped:
        echo(f"the catalog lacks {count(summary.skipped, 'file')}; next: {REPAIR}")
    elif not summary.exit_code:
        echo(f"next: flexroad report {folder} --format html")


def _exit(shown: Shown) -> None:
    """End the command with its exit code; print the reason if no summary was printed."""
    if shown.exit_code and shown.summary is None:
        echo(shown.text if shown.exit_code == INTERRUPTED else f"error: {shown.text}", err=True)
    raise typer.Exit(shown.exit_code)


@app.command(cls=Command)
def status(
    ctx: typer.Context,
    path: options.Run,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
    geojson: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a map of the tile states, for QGIS.")
    ] = None,
) -> None:
    """Show the state of a run and the failures of its tiles."""
    opened = Run.open(parse_location(path), options.allowed(ctx))
    if geojson is not None:
        write_states(opened, parse_location(geojson))
        echo(str(geojson))
        return
    _print_status(opened, as_json)


def _print_status(run: Run, as_json: bool) -> None:
    lock_owner = owner(run.path)
    alive = lock_owner if lock_owner and not exit_reason(lock_owner) else None
    if as_json:
        values = asdict(summary(run))
        values["failures"] = [
            {key: value for key, value in failure.items() if key != "trace"} for failure in values["failures"]
        ]
        values["at_work"] = {"host": alive.host, "pid": alive.pid, "since": alive.since} if alive else None
        echo_document(json.dumps(values, indent=1))
        return
    pending: list[TileStatus] = []

    def keep(status: TileStatus, state: TileState) -> None:
        if state == "pending" and len(pending) < MOST_PENDING:
            pending.append(status)

    state, pace = progress(run, alive) if alive else (summary(run, each=keep), "")
    echo(format_summary(state))
    if lock_owner:
        echo(describe_owner(lock_owner) + pace)
    for failure in state.failures:
        echo(f"  {failure.notice}")
    for line in why_pending(run, pending):
        echo(f"  {line}; `flexroad rerun {shlex.quote(str(run.path))}` computes it")
    for line in state.left_out:
        echo(f"  {line}; {REPAIR}")
    if state.flagged:
        rest = len(state.flagged) - SHOWN
        more = f" and {count(rest, 'other')}" if rest > 0 else ""
        echo(f"to look at: {', '.join(state.flagged[:SHOWN])}{more}")
        echo(f"next: flexroad report {shlex.quote(str(run.path))} --format html")
