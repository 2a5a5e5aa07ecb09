"""``flexroad run``, ``rerun``, ``status``: bring the tiles of a run up to date and tell how they stand."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from catalog import Tile
    from pipeline.execute import Executor
    from pipeline.run import Run

Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: one per core.")]
Scheduler = Annotated[str | None, typer.Option(help="Address of a running Dask scheduler.")]
ExecutorName = Annotated[str, typer.Option("--executor", help="dask, or serial: one process, to debug with.")]


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
    store: Annotated[Path | None, typer.Option(help="Folder of artefacts shared by runs.")] = None,
    checksum: Annotated[
        bool, typer.Option(help="Notice changed sources by bytes, not size and time.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the graph, do nothing.")] = False,
) -> None:
    """Bring every tile up to date; the same command resumes after whatever stopped it."""
    from catalog import Catalog
    from pipeline.config import load_config
    from pipeline.run import Run, asked, select

    chosen, whole = load_config(config), Catalog.read(catalog)
    tiles = whole.select(tile or (), bbox)
    if not tiles.tiles:
        raise ConfigError(f"catalog {catalog} has no tiles")
    if dry_run:
        from pipeline.graph import tile_graphs
        from pipeline.plan import plan

        root = store or out / "store"
        for line in plan(tile_graphs(tiles, chosen, checksum), root, out):
            typer.echo(line)
        return
    some = bool(tile) or bbox is not None
    with _alone(out, make=True):
        opened = Run.create(out, chosen, asked(out, whole, tiles) if some else whole, store, checksum)
        only = select(opened, [tile.id for tile in tiles.tiles], failed=False)
        _carry_out(opened, _executor(executor, workers, scheduler), only)


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
) -> None:
    """Bring tiles of a run up to date: what changed in files or RUN/config.yaml, and what hangs on it."""
    from pipeline.graph import STAGE_NAMES
    from pipeline.run import Run, select

    if from_stage is not None and from_stage not in STAGE_NAMES:
        raise ConfigError(f"--from {from_stage}: no such stage; there are {', '.join(STAGE_NAMES)}")
    anew = frozenset(STAGE_NAMES[STAGE_NAMES.index(from_stage) :]) if from_stage else frozenset()
    with _alone(path):
        opened = Run.open(path)
        only = select(opened, tile or (), failed)
        _carry_out(opened, _executor(executor, workers, scheduler), only, anew)


@contextlib.contextmanager
def _alone(path: Path, make: bool = False) -> Iterator[None]:
    """Keep other runs out of the folder; ``make`` it if it is not there."""
    from pipeline.lock import held

    try:
        if make:
            path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write the run to {path}: {error}; choose another --out") from error
    with held(path, lambda line: typer.echo(f"note: {line}", err=True)):
        yield


def _executor(name: str, workers: int | None, scheduler: str | None) -> Executor:
    from pipeline.execute import DaskExecutor, SerialExecutor

    if name == "serial":
        return SerialExecutor()
    if name == "dask":
        return DaskExecutor(workers, scheduler)
    raise ConfigError(f"--executor {name}: there are dask and serial")


def _carry_out(
    run: Run,
    executor: Executor,
    only: Callable[[Tile], bool],
    anew: frozenset[str] = frozenset(),
) -> None:
    import signal

    from rich.console import Console

    from pipeline.progress import Watch
    from pipeline.run import execute

    # An operator's `kill` ends the run as Ctrl-C does: workers gone, tables written.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    total = sum(map(only, run.catalog.tiles))
    folder = shlex.quote(str(run.path))
    try:
        with Watch(total, Console(stderr=True)) as watch:
            how = execute(run, executor, only, anew, watch)
    except KeyboardInterrupt:
        typer.echo("interrupted; the same command goes on from here", err=True)
        raise typer.Exit(130) from None
    except OSError as error:
        typer.echo(f"error: {error}; make room, then `flexroad rerun {folder}` goes on from here", err=True)
        raise typer.Exit(1) from None
    typer.echo(
        f"{how.tiles} tiles: {how.done} done ({how.cached} cached), {how.failed} failed, "
        f"{how.pending} pending; results in {run.path}"
    )
    if set(watch.status) == {"cached"}:
        typer.echo("nothing had changed; `flexroad rerun RUN --from load` computes all anew")
    if how.failed:
        typer.echo(f"next: flexroad status {folder}, then flexroad rerun {folder} --failed")
        raise typer.Exit(1)
    typer.echo(f"next: flexroad report {folder} --format html")


def status(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
) -> None:
    """Tell how a run stands, and what failed why."""
    import json
    from dataclasses import asdict

    from pipeline.run import Run, summary

    how = summary(Run.open(path))
    if as_json:
        failures = [
            {key: value for key, value in asdict(failure).items() if key != "trace"}
            for failure in how.failures
        ]
        typer.echo(json.dumps(asdict(how) | {"failures": failures}, indent=1))
        return
    counts = f"{how.done} done ({how.cached} cached), {how.failed} failed, {how.pending} pending"
    typer.echo(f"{how.tiles} tiles: {counts}")
    for failure in how.failures:
        typer.echo(f"  {failure.notice}")
