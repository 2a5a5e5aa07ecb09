"""``flexroad run``, ``rerun``, ``status``, ``clean``: bring a run up to date, tell how it stands, tidy up."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexroad.pipeline.cli.lifecycle import ON_FAILURE, Outcome, format_summary, supervised, warn
from flexroad.pipeline.cli.stdio import patient
from flexroad.pipeline.errors import ClusterLost, ConfigError

if TYPE_CHECKING:
    from flexroad.catalog import Catalog, Tile
    from flexroad.catalog.storage.paths import Location
    from flexroad.pipeline.config.cluster import Cluster
    from flexroad.pipeline.config.models import Config
    from flexroad.pipeline.execute import Executor
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.worker.tile import TileResult

Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: one per core.")]
Scheduler = Annotated[str | None, typer.Option(help="Address of a running Dask scheduler.")]
ExecutorName = Annotated[str, typer.Option("--executor", help="dask, or serial: one process, to debug with.")]
Dashboard = Annotated[bool, typer.Option("--dashboard", help="Serve Dask's dashboard, and say where.")]
Verify = Annotated[
    bool, typer.Option("--verify", help="Compare the checksums of all products, not only their sizes.")
]
OnFailure = Annotated[
    str | None,
    typer.Option(
        metavar="CMD|URL",
        envvar=ON_FAILURE,
        help="Command, or address to POST to, that gets the summary if the exit code is not 0.",
    ),
]
Prometheus = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Text file for Prometheus (.prom), kept up to date.")
]


@patient()
def run(
    config: Annotated[str, typer.Option(help="Configuration: a YAML file or a shipped name (paper).")],
    catalog: Annotated[Path, typer.Option(help="Catalog of tiles.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Folder of the run; an old one is resumed.")],
    tile: Annotated[list[str] | None, typer.Option(help="Only these tiles.")] = None,
    bbox: Annotated[
        tuple[float, float, float, float] | None, typer.Option(metavar="W S E N", help="Only tiles here (m).")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    executor: ExecutorName = "dask",
    dashboard: Dashboard = False,
    store: Annotated[Path | None, typer.Option(help="Folder of artefacts shared by runs.")] = None,
    checksum: Annotated[
        bool, typer.Option(help="Notice changed sources by bytes, not size and time.")
    ] = False,
    allow: Annotated[
        list[str] | None,
        typer.Option(metavar="DIR|URL", help="Where files outside the catalog's folder may lie; repeatable."),
    ] = None,
    verify: Verify = False,
    on_failure: OnFailure = None,
    prometheus: Prometheus = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the graph, do nothing.")] = False,
) -> None:
    """Bring every tile up to date; the same command resumes after whatever stopped it."""
    from flexroad.catalog import Catalog
    from flexroad.catalog.allowlist import check_allowed
    from flexroad.catalog.storage.paths import absolute, normalise, parse_location
    from flexroad.pipeline.config.loading import load_config
    from flexroad.pipeline.graph.graph import layers_read
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.run.selection import merged_catalog, rerun_filter

    path, listed, root = (
        parse_location(out),
        parse_location(catalog),
        parse_location(store) if store else None,
    )
    # What its own folder holds is a catalog's to name.
    allowed = [str(absolute(listed).parent), *(normalise(text) for text in allow or ())]

    def wanted(chosen: Config) -> tuple[Catalog, Catalog]:
        whole = Catalog.read(listed)
        check_allowed(whole, listed.parent, allowed, layers_read(chosen))
        found = whole.select(tile or (), bbox)
        if not found.tiles:
            raise ConfigError(f"catalog {catalog} has no tiles")
        return whole, found

    if dry_run:
        from flexroad.pipeline.cli.dry_run import plan
        from flexroad.pipeline.graph.graph import tile_graphs

        chosen = load_config(config)
        graphs = tile_graphs(wanted(chosen)[1], chosen, checksum)
        for line in plan(graphs, root or path / "store", path):
            typer.echo(line)
        return
    with supervised(path, on_failure, prometheus) as ending:
        chosen = load_config(config)
        whole, tiles = wanted(chosen)
        some = bool(tile) or bbox is not None
        with _alone(path, make=True):
            about = merged_catalog(path, whole, tiles) if some else whole
            opened = Run.create(path, chosen, about, root, checksum, allowed)
            only = rerun_filter(opened, [tile.id for tile in tiles.tiles], failed=False)
            with_whom = partial(_executor, executor, workers, scheduler, chosen.cluster, dashboard)
            _carry_out(opened, with_whom, only, frozenset(), verify, ending)
    _leave(ending)


@patient()
def rerun(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    tile: Annotated[list[str] | None, typer.Option(help="These tiles.")] = None,
    failed: Annotated[bool, typer.Option("--failed", help="The tiles that failed.")] = False,
    from_stage: Annotated[
        str | None, typer.Option("--from", metavar="STAGE", help="Compute this stage and what follows anew.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    executor: ExecutorName = "dask",
    dashboard: Dashboard = False,
    verify: Verify = False,
    on_failure: OnFailure = None,
    prometheus: Prometheus = None,
) -> None:
    """Bring tiles of a run up to date: what changed in files or RUN/config.yaml, and what hangs on it."""
    from flexroad.catalog.allowlist import check_allowed
    from flexroad.catalog.storage.paths import parse_location
    from flexroad.pipeline.graph.graph import layers_read
    from flexroad.pipeline.graph.stages import STAGE_NAMES
    from flexroad.pipeline.run.record import Run
    from flexroad.pipeline.run.selection import rerun_filter

    where = parse_location(path)
    with supervised(where, on_failure, prometheus) as ending:
        if from_stage is not None and from_stage not in STAGE_NAMES:
            raise ConfigError(f"--from {from_stage}: no such stage; there are {', '.join(STAGE_NAMES)}")
        force = frozenset(STAGE_NAMES[STAGE_NAMES.index(from_stage) :]) if from_stage else frozenset()
        with _alone(where):
            opened = Run.open(where)
            if opened.allowed:
                # A run of old does not know.
                check_allowed(opened.catalog, where, opened.allowed, layers_read(opened.config))
            only = rerun_filter(opened, tile or (), failed)
            with_whom = partial(_executor, executor, workers, scheduler, opened.config.cluster, dashboard)
            _carry_out(opened, with_whom, only, force, verify, ending)
    _leave(ending)


@contextlib.contextmanager
def _alone(path: Location, make: bool = False) -> Iterator[None]:
    """Keep other runs out of the folder; ``make`` it if it is not there."""
    from flexroad.pipeline.run.lock import run_lock

    try:
        if make and isinstance(path, Path):
            path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write the run to {path}: {error}; choose another --out") from error
    with run_lock(path, lambda line: warn(line, "note")):
        yield


def _executor(
    name: str,
    workers: int | None,
    scheduler: str | None,
    cluster: Cluster,
    dashboard: bool,
    say: Callable[[str], None],
) -> Executor:
    from flexroad.pipeline.execute import DaskExecutor, SerialExecutor

    if name == "serial":
        return SerialExecutor()
    if name == "dask":
        return DaskExecutor(workers, scheduler, cluster, dashboard, say)
    raise ConfigError(f"--executor {name}: there are dask and serial")


def _carry_out(
    run: Run,
    with_whom: Callable[[Callable[[str], None]], Executor],
    only: Callable[[Tile], bool],
    force: frozenset[str],
    verify: bool,
    ending: Outcome,
) -> None:
    """Do the tiles, and fill in how that ended."""
    from rich.console import Console

    from flexroad.pipeline.monitor.progress import ProgressDisplay
    from flexroad.pipeline.run.runner import run_tiles

    folder = shlex.quote(str(run.path))
    console = Console(stderr=True)
    executor = with_whom(partial(console.print, markup=False, highlight=False, soft_wrap=True))
    watch = ProgressDisplay(sum(map(only, run.catalog.tiles)), console)
    if ending.textfile is not None:
        ending.textfile.total = len(run.catalog.tiles)

    def told(result: TileResult) -> None:
        watch(result)
        if ending.textfile is not None:
            ending.textfile(result)

    try:
        with watch:
            how = ending.how = run_tiles(run, executor, only, force, told, verify)
    except ClusterLost as error:
        ending.exit_code, ending.text = 1, f"{error}; the same command goes on from here"
        return
    except OSError as error:
        ending.exit_code = 1
        ending.text = f"{error}; make room or mend that, then `flexroad rerun {folder}` goes on from here"
        return
    finally:
        _draw(run)
    ending.exit_code, ending.text = how.exit_code, format_summary(how)
    typer.echo(f"{ending.text}; results in {run.path}")
    if set(watch.status) == {"cached"}:
        typer.echo("nothing had changed; `flexroad rerun RUN --from load` computes all anew")
    if how.failed:
        typer.echo(f"next: flexroad status {folder}, then flexroad rerun {folder} --failed")
    elif not how.exit_code:
        typer.echo(f"next: flexroad report {folder} --format html")


def _draw(run: Run) -> None:
    """Write the map of the tiles' states; a run without one is a run all the same."""
    from flexroad.pipeline.monitor.geojson import NAME, write_states

    try:
        write_states(run, run.path / NAME)
    except OSError as error:
        warn(f"no map of the tiles: {error}")


def _leave(ending: Outcome) -> None:
    """End the command with its exit code; what went wrong as a whole is said in one line."""
    if ending.exit_code and ending.how is None:
        typer.echo(ending.text if ending.exit_code == 130 else f"error: {ending.text}", err=True)
    raise typer.Exit(ending.exit_code)


def next_run(catalog: Path) -> str:
    """Return the command that runs a catalog, with leave for all that it reads."""
    from flexroad.catalog import Catalog
    from flexroad.catalog.allowlist import needed
    from flexroad.pipeline.config.loading import load_config
    from flexroad.pipeline.graph.graph import layers_read

    read = layers_read(load_config("paper"))
    folders = needed(Catalog.read(catalog), catalog.parent, read)
    allowed = "".join(f" --allow {shlex.quote(folder)}" for folder in folders)
    return f"flexroad run --config paper --catalog {shlex.quote(str(catalog))} --out RUN{allowed}"


def status(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    geojson: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a map of the tiles' states, for QGIS.")
    ] = None,
) -> None:
    """Tell how a run stands, and what failed why."""
    from flexroad.catalog.storage.paths import parse_location
    from flexroad.pipeline.run.record import Run

    opened = Run.open(parse_location(path))
    if geojson is not None:
        from flexroad.pipeline.monitor.geojson import write_states

        write_states(opened, parse_location(geojson))
        typer.echo(str(geojson))
        return
    _tell(opened, as_json)


def _tell(run: Run, as_json: bool) -> None:
    import json
    from dataclasses import asdict

    from flexroad.pipeline.run.lock import describe_owner, exit_reason, owner
    from flexroad.pipeline.run.status import progress, summary

    who = owner(run.path)
    alive = who if who and not exit_reason(who) else None
    if as_json:
        found = asdict(summary(run))
        found["failures"] = [{k: v for k, v in one.items() if k != "trace"} for one in found["failures"]]
        found["at_work"] = {"host": alive.host, "pid": alive.pid, "since": alive.since} if alive else None
        typer.echo(json.dumps(found, indent=1))
        return
    how, pace = progress(run, alive) if alive else (summary(run), "")
    typer.echo(format_summary(how))
    if who:
        typer.echo(describe_owner(who) + pace)
    for failure in how.failures:
        typer.echo(f"  {failure.notice}")
