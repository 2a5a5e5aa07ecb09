"""``flexroad tables`` and ``figures``: the paper's tables and figures beside the values of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.options import INPUTS, OUTPUTS
from flexroad.pipeline.run.record import Run
from flexroad.tools.reproduce.figures import write_figures
from flexroad.tools.reproduce.tables import write_comparison

app = group()

Output = Annotated[
    Path,
    typer.Option("-o", "--output", metavar="FOLDER", help="Folder to write.", rich_help_panel=OUTPUTS),
]


@app.command(cls=Command)
def tables(
    ctx: typer.Context,
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
            help="A run for the rows of DSC3D: of its scenes or of synthetic scenes.",
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
) -> None:
    """Write the paper's tables and claims beside the values of a run.

    They are Markdown, LaTeX, CSV and HTML.
    """
    folders = (true, dsc3d, dsc3d_true, literal, dsm)
    runs = [Run.open(folder, options.allowed(ctx)) if folder else None for folder in folders]
    for written in write_comparison(Run.open(path, options.allowed(ctx)), runs[0], output, *runs[1:]):
        echo(str(written))


@app.command(cls=Command)
def figures(
    ctx: typer.Context,
    path: options.Run,
    output: Output,
    tile: Annotated[
        str | None,
        typer.Option(metavar="ID", help="Tile of the maps; default: the tile with the median road L2."),
    ] = None,
) -> None:
    """Draw the paper's figures from a run.

    They are PDF and PNG, small WebP pictures, and a page of captions.
    """
    for note in write_figures(Run.open(path, options.allowed(ctx)), output, tile):
        echo(f"note: {note}", err=True)
    echo(f"figures in {output / 'figures.md'}")
