"""``flexroad report``: a report on a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from flexroad.catalog.storage.paths import parse_location, read
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo, echo_document
from flexroad.pipeline.config.options import INPUTS, OUTPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.progress import step_progress
from flexroad.pipeline.run.record import Run
from flexroad.tools.report import write_report

app = group()


@app.command(cls=Command)
def report(
    ctx: typer.Context,
    path: options.Run,
    form: Annotated[
        Literal["md", "csv", "html"],
        typer.Option("--format", help="html: one page with a map and pictures.", rich_help_panel=OUTPUTS),
    ] = "md",
    compared: Annotated[
        Path | None,
        typer.Option(
            "--compare",
            metavar="RUN",
            help="html: compare with another run over the same tiles.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    viewer: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="html: link tiles to this 3D viewer; default: RUN/viewer if it exists.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
) -> None:
    """Write a report on a run: failures, places, figures.

    The file is RUN/report.md, .csv or .html.
    """
    if form != "html" and (compared or viewer):
        given = "--compare" if compared else "--viewer"
        raise ConfigError(f"{given} is for --format html only; add that, or leave out {given}")
    others = (None if other is None else parse_location(other) for other in (viewer, compared))
    run = Run.open(path, options.allowed(ctx))
    written = write_report(run, form, step_progress(Console(stderr=True)), *others)
    if form != "html":
        echo_document(read(written).decode())
    echo(f"written to {written}", err=True)
