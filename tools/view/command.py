"""``flexroad view``: a run in the browser, as a map and in 3D."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flexroad.catalog.storage.paths import is_remote, parse_location
from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.signals import signals_interrupt
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.options import OUTPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.run.progress import step_progress
from flexroad.pipeline.run.record import Run
from flexroad.tools.view.driver import server, write_viewer

app = group()

FOLDER = "viewer"
MOST_NOTES = 5


@app.command(cls=Command)
def view(
    ctx: typer.Context,
    path: options.Run,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FOLDER",
            help="Output folder; default: viewer in the run's folder.",
            rich_help_panel=OUTPUTS,
        ),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option(
            "--serve",
            help="Then serve the folder, only to this computer, until Ctrl-C.",
            rich_help_panel=OUTPUTS,
        ),
    ] = False,
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, metavar="N", help="Port of --serve; 0: any.", rich_help_panel=OUTPUTS),
    ] = 0,
    tile: options.TileIds = None,
    bbox: options.Box = None,
    workers: options.Parallel = 1,
) -> None:
    """Write a run as a page for browsers: map and surface in 3D.

    The page opens without a server and without network. The same command continues after an interruption, and
    writes only tiles that have changed.
    """
    if port and not serve:
        raise ConfigError(f"--port {port} is for --serve; add that, or leave out --port")
    run = Run.open(parse_location(path), options.allowed(ctx))
    folder = parse_location(output) if output else run.path / FOLDER
    if serve and is_remote(folder):
        raise ConfigError(f"--serve needs a folder on disk, not {folder}; give one with -o")
    runner = SerialExecutor() if workers == 1 else DaskExecutor(workers)
    track = step_progress(Console(stderr=True))
    written = write_viewer(run, folder, runner, tile or (), bbox, track)
    for note in written.notes[:MOST_NOTES]:
        echo(f"note: {note}", err=True)
    if len(written.notes) > MOST_NOTES:
        echo(f"note: and {count(len(written.notes) - MOST_NOTES, 'more note')}", err=True)
    others = f", {written.others} more on the map only" if written.others else ""
    echo(f"{count(written.tiles, 'tile')} in 3D{others}: {written.page}")
    if serve and isinstance(folder, Path):
        _serve(folder, port)


def _serve(folder: Path, port: int) -> None:
    try:
        web = server(folder, port)
    except OSError as error:
        why = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be served: {error.strerror}"
        raise ConfigError(f"port {port} {why}; choose another with --port, or leave it out") from error
    with web:
        echo(f"http://127.0.0.1:{web.server_address[1]}/  (Ctrl-C stops)")
        try:
            with signals_interrupt():
                web.serve_forever()
        except KeyboardInterrupt:
            echo("stopped")
