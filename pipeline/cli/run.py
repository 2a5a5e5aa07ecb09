"""``flexroad run``, ``rerun`` and ``status``: bring a run up to date, show its state."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.lifecycle import Outcome, format_summary, report_outcome, warn
from flexroad.pipeline.cli.limits import remedy
from flexroad.pipeline.cli.stdio import echo, echo_document, ignore_write_errors
from flexroad.pipeline.errors import ClusterLost, ConfigError

if TYPE_CHECKING:
    from flexroad.catalog import Catalog, Tile
    from flexroad.catalog.storage.paths import Location
    from flexroad.pipeline.config.models import Config
    from flexroad.pipeline.execute import Executor
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.run.summary import Summary
    from flexroad.pipeline.worker.tile import TileResult

StageName = Literal["load", "segment", "ecsrc", "fit", "sample", "evaluate", "assess", "export"]


@ignore_write_errors()
def run(
    catalog: Annotated[
        Path, typer.Option(metavar="CATALOG", help="Catalog of tiles.", rich_help_panel=options.INPUTS)
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="RUN",
            help="Folder of the run; an existing run is resumed.",
            rich_help_panel=options.OUTPUTS,
        ),
    ],
    config: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE",
            help="Configuration: a shipped name, such as production, or a YAML file.",
            rich_help_panel=options.INPUTS,
        ),
    ] = "production",
    settings: options.Settings = None,
    allow: options.Allow = None,
    checksum: Annotated[
        bool,
        typer.Option(
            "--checksum",
            help="Detect changed sources by content, not by size and time.",
            rich_help_panel=options.INPUTS,
        ),
    ] = False,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder of stage results that several runs share.",
            rich_help_panel=options.OUTPUTS,
        ),
    ] = None,
    verify: options.Verify = False,
    tile: options.TileIds = None,
    bbox: options.Box = None,
    area: options.Area = None,
    area_layer: options.AreaLayer = None,
    executor: options.RunExecutor = "auto",
    workers: options.MostWorkers = None,
    scheduler: options.Scheduler = None,
    dashboard: options.Dashboard = False,
    on_failure: options.OnFailure = None,
    prometheus: options.Prometheus = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Print why each tile would be computed, and what would fail."),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="With --dry-run: also the stages of each tile.")
    ] = False,
) -> None:
    """Bring every tile of a run up to date.

    After an interruption, the same command resumes the run.
    """
    from flexroad.catalog import Catalog
    from flexroad.catalog.allowlist import check_allowed
    from flexroad.catalog.storage.paths import parse_location
    from flexroad.pipeline.config.loading import load_config
    from flexroad.pipeline.graph.graph import layers_read
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.run.selection import merged_catalog, rerun_filter

    path, catalog_path = parse_location(out), parse_location(catalog)
    root = parse_location(store) if store else None

    def read_catalog(chosen: Config) -> tuple[Catalog, Catalog]:
        """Return the whole catalog and its selected tiles."""
        whole = Catalog.read(catalog_path, allow or ())
        check_allowed(whole, layers_read(chosen))
        selected = whole.select(tile or (), bbox, options.read_area(area, area_layer))
        if not selected.tiles:
            raise ConfigError(f"catalog {catalog} has no tiles")
        return whole, selected

    def of_run(whole: Catalog, selected: Catalog) -> Catalog:
        """Return the tiles of the run, also those of earlier partial runs."""
        return merged_catalog(path, whole, selected) if tile or bbox is not None or area else whole

    if dry_run:
        from flexroad.pipeline.cli.dry_run import plan

        chosen = load_config(config, settings or ())
        whole, selected = read_catalog(chosen)
        planned = Run.planned(path, chosen, of_run(whole, selected), root, checksum)
        for line in plan(planned, selected.tiles, verbose, workers):
            echo(line)
        return
    with report_outcome(path, on_failure, prometheus) as outcome:
        chosen = load_config(config, settings or ())
        with _named(f"reading {catalog}"):
            whole, selected = read_catalog(chosen)
        with _locked(path, create=True) as died:
            with _named(f"preparing {out}"):
                opened = Run.create(path, chosen, of_run(whole, selected), root, checksum)
            only = rerun_filter(opened, [tile.id for tile in selected.tiles], failed=False)
            make_executor = partial(_executor, executor, died, workers, scheduler, chosen, dashboard, path)
            _run_tiles(opened, make_executor, only, frozenset(), verify, outcome)
    _exit(outcome)


@ignore_write_errors()
def rerun(
    path: options.Run,
    tile: Annotated[
        list[str] | None,
        typer.Option(metavar="ID", help="These tiles: --tile ID ID ...", rich_help_panel=options.TILES),
    ] = None,
    failed: Annotated[
        bool, typer.Option("--failed", help="The tiles that failed.", rich_help_panel=options.TILES)
    ] = False,
    from_stage: Annotated[
        StageName | None,
        typer.Option(
            "--from",
            help="Recompute this stage and all later ones; export: only write the products again.",
            rich_help_panel=options.TILES,
        ),
    ] = None,
    settings: options.WorkerSettings = None,
    allow: options.Allow = None,
    verify: options.Verify = False,
    executor: options.RunExecutor = "auto",
    workers: options.MostWorkers = None,
    scheduler: options.Scheduler = None,
    dashboard: options.Dashboard = False,
    on_failure: options.OnFailure = None,
    prometheus: options.Prometheus = None,
) -> None:
    """Bring tiles of a run up to date again.

    For changes of source files or of RUN/config.yaml, and for failed tiles.
    """
    from flexroad.catalog.allowlist import check_allowed
    from flexroad.catalog.storage.paths import parse_location
    from flexroad.pipeline.graph.borders import STAGE as BORDER
    from flexroad.pipeline.graph.graph import layers_read
    from flexroad.pipeline.graph.stages import STAGE_NAMES
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.run.selection import rerun_filter
    from flexroad.pipeline.run.workers import with_workers

    location = parse_location(path)
    with report_outcome(location, on_failure, prometheus) as outcome:
        steps = (*STAGE_NAMES, "export")
        force = frozenset(steps[steps.index(from_stage) :]) if from_stage else frozenset()
        # The control points of a border are part of the fit.
        force |= {BORDER} if "fit" in force else frozenset()
        with _locked(location) as died:
            with _named(f"reading {path}"):
                opened = with_workers(Run.open(location, allow or ()), settings or ())
                check_allowed(opened.catalog, layers_read(opened.config))
            only = rerun_filter(opened, tile or (), failed)
            config = opened.config
            make_executor = partial(
                _executor, executor, died, workers, scheduler, config, dashboard, location
            )
            _run_tiles(opened, make_executor, only, force, verify, outcome)
    _exit(outcome)


@contextlib.contextmanager
def _named(work: str) -> Iterator[None]:
    """Name the work of the block if it takes long, as with catalogs of thousands of tiles."""
    from flexroad.pipeline.monitor.progress import FIRST_S, said_repeatedly

    def line(spent_s: float) -> str:
        return f"{work}, {spent_s:.0f} s spent"

    with said_repeatedly(line, lambda text: echo(text, err=True), FIRST_S):
        yield


@contextlib.contextmanager
def _locked(path: Location, create: bool = False) -> Iterator[bool]:
    """Hold the lock of a run folder; with ``create`` a missing one is made, and removed if it stays empty.

    A folder with files of others is then refused, before anything is written.

    Yields whether the process that held the lock before has died: one of the tiles may have ended it.
    """
    from flexroad.catalog.storage.outputs import made_folder
    from flexroad.pipeline.run.folder import check_folder, check_links
    from flexroad.pipeline.run.lock import run_lock

    taken_over: list[str] = []

    def notify(line: str) -> None:
        taken_over.append(line)
        warn(line, "note")

    with contextlib.ExitStack() as stack:
        if create:
            check_folder(path)
            if isinstance(path, Path):
                try:
                    stack.enter_context(made_folder(path))
                except OSError as error:
                    raise ConfigError(
                        f"cannot write the run to {path}: {error}; choose another --out"
                    ) from error
        else:
            check_links(path)
        stack.enter_context(run_lock(path, notify))
        yield bool(taken_over)


def _executor(
    name: str,
    died: bool,
    workers: int | None,
    scheduler: str | None,
    config: Config,
    dashboard: bool,
    path: Location,
    say: Callable[[str], None],
) -> Executor:
    from flexroad.pipeline.execute import AdaptiveExecutor, DaskExecutor, SerialExecutor

    if name == "serial":
        return SerialExecutor()
    cluster = config.cluster
    logs = path.resolve() / "logs" if isinstance(path, Path) else None
    parallel = DaskExecutor(workers, scheduler, cluster, dashboard, say, logs)
    if name == "dask" or died or scheduler or dashboard or cluster.needs_workers:
        return parallel
    return AdaptiveExecutor(workers or cluster.workers, parallel, say)


def _run_tiles(
    run: Run,
    make_executor: Callable[[Callable[[str], None]], Executor],
    only: Callable[[Tile], bool],
    force: frozenset[str],
    verify: bool,
    outcome: Outcome,
) -> None:
    """Run the tiles and fill in the outcome."""
    from rich.console import Console

    from flexroad.pipeline.monitor.progress import ProgressDisplay
    from flexroad.pipeline.run.runner import run_tiles

    folder = shlex.quote(str(run.path))
    console = Console(stderr=True)
    display = ProgressDisplay(sum(map(only, run.catalog.tiles)), console)
    executor = make_executor(display.say)
    if outcome.textfile is not None:
        outcome.textfile.total = len(run.catalog.tiles)

    def watch(result: TileResult) -> None:
        display(result)
        if outcome.textfile is not None:
            outcome.textfile(result)

    try:
        with display:
            summary = outcome.summary = run_tiles(run, executor, only, force, watch, verify)
    except ClusterLost as error:
        outcome.exit_code, outcome.text = 1, f"{error}; the same command goes on from here"
        return
    except OSError as error:
        outcome.exit_code = 1
        outcome.text = f"{error}; {remedy(error)}, then run `flexroad rerun {folder}`"
        return
    finally:
        _write_map(run)
    outcome.exit_code, outcome.text = summary.exit_code, format_summary(summary)
    echo(f"{outcome.text}; results in {run.path}")
    if set(display.status) == {"cached"}:
        echo("nothing had changed; `flexroad rerun RUN --from load` recomputes everything")
    if summary.done and summary.without_roads == summary.done:
        warn(
            "no tile of this run has a road that the filter keeps; if there are roads, check the road source "
            "of the catalog and the options of segment and ecsrc"
        )
    _echo_next(summary, folder)


def _echo_next(summary: Summary, folder: str) -> None:
    if summary.failed:
        echo(f"next: flexroad status {folder}, then flexroad rerun {folder} --failed")
    elif summary.pending:
        # The exit code is 1 although the selected tiles are done.
        tiles, have = count(summary.pending, "tile"), "has" if summary.pending == 1 else "have"
        echo(f"{tiles} {have} no result of the present files and options; next: flexroad rerun {folder}")
    elif not summary.exit_code:
        echo(f"next: flexroad report {folder} --format html")


def _write_map(run: Run) -> None:
    """Write the map of tile states; only warn if that fails."""
    from flexroad.pipeline.monitor.geojson import NAME, write_states

    try:
        write_states(run, run.path / NAME)
    except OSError as error:
        warn(f"cannot write the map of the tiles: {error}")


def _exit(outcome: Outcome) -> None:
    """End the command with its exit code; print the reason if no summary was printed."""
    if outcome.exit_code and outcome.summary is None:
        echo(outcome.text if outcome.exit_code == 130 else f"error: {outcome.text}", err=True)
    raise typer.Exit(outcome.exit_code)


def status(
    path: options.Run,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
    geojson: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a map of the tile states, for QGIS.")
    ] = None,
    allow: options.Allow = None,
) -> None:
    """Show the state of a run and the failures of its tiles."""
    from flexroad.catalog.storage.paths import parse_location
    from flexroad.pipeline.run.record import Run

    opened = Run.open(parse_location(path), allow or ())
    if geojson is not None:
        from flexroad.pipeline.monitor.geojson import write_states

        write_states(opened, parse_location(geojson))
        echo(str(geojson))
        return
    _print_status(opened, as_json)


def _print_status(run: Run, as_json: bool) -> None:
    import json
    from dataclasses import asdict

    from flexroad.pipeline.run.lock import describe_owner, exit_reason, owner
    from flexroad.pipeline.run.status import progress, summary

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
    state, pace = progress(run, alive) if alive else (summary(run), "")
    echo(format_summary(state))
    if lock_owner:
        echo(describe_owner(lock_owner) + pace)
    for failure in state.failures:
        echo(f"  {failure.notice}")
