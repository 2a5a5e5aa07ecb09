"""``flexroad report``, ``tables`` and ``figures``: results of a run."""

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
from flexroad.pipeline.run.progress import StepProgress
from flexroad.pipeline.run.record import Run
from flexroad.tools.report import write_report
from flexroad.tools.reproduce.figures import write_figures
from flexroad.tools.reproduce.tables import write_comparison

app = group()

Output = Annotated[
    Path,
    typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write.", rich_help_panel=OUTPUTS),
]


@app.command(cls=Command)
def report(
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
    allow: options.Allow = None,
) -> None:
    """Write a report on a run: failures, places, figures.

    The file is RUN/report.md, .csv or .html.
    """
    if form != "html" and (compared or viewer):
        given = "--compare" if compared else "--viewer"
        raise ConfigError(f"{given} is for --format html only; add that, or leave out {given}")
    others = (None if other is None else parse_location(other) for other in (viewer, compared))
    written = write_report(Run.open(path, allow or ()), form, StepProgress(Console(stderr=True)), *others)
    if form != "html":
        echo_document(read(written).decode())
    echo(f"written to {written}", err=True)


@app.command(cls=Command)
def tables(
    path: options.Run,
    output: Output,
    true: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN", help="The same tiles, run with the true road mask.", rich_help_panel=INPUTS
        ),
    ] = None,
    dsc3d: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="A run for the rows of DSC3D: of its scenes or of synthetic ones.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    dsc3d_true: Annotated[
        Path | None,
        typer.Option(
            "--dsc3d-true",
            metavar="RUN",
            help="The same scenes, run with the true reference.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    literal: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="The same tiles, or some, run with --config literal: a second column.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    dsm: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="The same tiles, run with --config ablation_dsm: road L2 against the DSM.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    allow: options.Allow = None,
) -> None:
    """Write the paper's tables and claims beside the values of a run.

    They are Markdown, LaTeX, CSV and HTML.
    """
    folders = (true, dsc3d, dsc3d_true, literal, dsm)
    runs = [Run.open(folder, allow or ()) if folder else None for folder in folders]
    for written in write_comparison(Run.open(path, allow or ()), runs[0], output, *runs[1:]):
        echo(str(written))


@app.command(cls=Command)
def figures(
    path: options.Run,
    output: Output,
    tile: Annotated[
        str | None,
        typer.Option(metavar="ID", help="Tile of the maps; default: the one with the median road L2."),
    ] = None,
    allow: options.Allow = None,
) -> None:
    """Draw the paper's figures from a run.

    They are PDF and PNG, small WebP pictures, and a page of captions.
    """
    for note in write_figures(Run.open(path, allow or ()), output, tile):
        echo(f"note: {note}", err=True)
    echo(f"figures in {output / 'figures.md'}")
