"""``flexroad report``, ``tables``, ``figures`` and ``query``: results of a run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from flexroad.pipeline.cli.command import Allow
from flexroad.pipeline.cli.stdio import echo, echo_document
from flexroad.pipeline.errors import ConfigError


def report(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    form: Annotated[str, typer.Option("--format", help="md, csv or html.")] = "md",
    allow: Allow = None,
) -> None:
    """Write RUN/report.<format>: the paper's main table for this run, worst tiles, height steps, failures."""
    from flexroad.catalog.storage.paths import read
    from flexroad.pipeline.report import FORMATS, write_report
    from flexroad.pipeline.run.record import Run

    if form not in FORMATS:
        raise ConfigError(f"--format {form}: there are {', '.join(FORMATS)}")
    written = write_report(Run.open(path, allow or ()), form)
    if form != "html":
        echo_document(read(written).decode())
    echo(f"written to {written}", err=True)


def tables(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    true: Annotated[
        Path | None, typer.Option(metavar="RUN", help="The same tiles, run with the true road mask.")
    ] = None,
    dsc3d: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A run for the rows of DSC3D: of its scenes or of synthetic ones."),
    ] = None,
    dsc3d_true: Annotated[
        Path | None,
        typer.Option("--dsc3d-true", metavar="RUN", help="The same scenes, run with the true reference."),
    ] = None,
    allow: Allow = None,
) -> None:
    """Write the paper's tables and claims next to the values of a run: Markdown, LaTeX, CSV, HTML."""
    from flexroad.pipeline.reproduce.tables import write_comparison
    from flexroad.pipeline.run.record import Run

    folders = (true, dsc3d, dsc3d_true)
    runs = [Run.open(folder, allow or ()) if folder else None for folder in folders]
    for written in write_comparison(Run.open(path, allow or ()), runs[0], output, *runs[1:]):
        echo(str(written))


def figures(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write.")],
    tile: Annotated[
        str | None, typer.Option(help="Tile of the maps; default: the one with the median road L2.")
    ] = None,
    allow: Allow = None,
) -> None:
    """Draw the paper's figures from a run, as PDF and PNG with a page of captions."""
    from flexroad.pipeline.reproduce.figures import write_figures
    from flexroad.pipeline.run.record import Run

    for note in write_figures(Run.open(path, allow or ()), output, tile):
        echo(f"note: {note}", err=True)
    echo(f"figures in {output / 'figures.md'}")


def query(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    points: Annotated[Path, typer.Option(help="CSV with columns easting and northing (m).")],
    variant: Annotated[
        str | None, typer.Option(help="Variant of the surface; default: the exported one.")
    ] = None,
    allow: Allow = None,
) -> None:
    """Print height, unit normal, tile and class at points, as CSV."""
    from flexroad.pipeline.inspect.points import query_csv

    outside = query_csv(path, points, variant, sys.stdout, allow or ())
    if outside:
        echo(f"note: {outside} points lie on no finished tile; their columns are empty", err=True)
