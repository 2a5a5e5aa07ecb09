"""``flexroad report``, ``tables``, ``figures``, ``query``: what came of a run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from flexroad.pipeline.errors import ConfigError


def report(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    form: Annotated[str, typer.Option("--format", help="md, csv or html.")] = "md",
) -> None:
    """Write RUN/report.<format>: the paper's main table over the run, worst tiles, steps, failures."""
    from flexroad.catalog.storage.paths import read
    from flexroad.pipeline.report import FORMATS, write_report
    from flexroad.pipeline.run.record import Run

    if form not in FORMATS:
        raise ConfigError(f"--format {form}: there are {', '.join(FORMATS)}")
    written = write_report(Run.open(path), form)
    if form != "html":
        typer.echo(read(written).decode())
    typer.echo(f"written to {written}", err=True)


def tables(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")],
    true: Annotated[
        Path | None, typer.Option(metavar="RUN", help="The same run classed by the true mask.")
    ] = None,
    dsc3d: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="A run for the rows of DSC3D: its scenes, or the stand-in's."),
    ] = None,
    dsc3d_true: Annotated[
        Path | None,
        typer.Option("--dsc3d-true", metavar="RUN", help="The same scenes with the true reference."),
    ] = None,
) -> None:
    """Write the paper's tables and claims with a run's figures beside them: Markdown, LaTeX, CSV, HTML."""
    from flexroad.pipeline.reproduce.tables import write_comparison
    from flexroad.pipeline.run.record import Run

    others = [Run.open(other) if other else None for other in (true, dsc3d, dsc3d_true)]
    for written in write_comparison(Run.open(path), others[0], output, *others[1:]):
        typer.echo(str(written))


def figures(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write.")],
    tile: Annotated[
        str | None, typer.Option(help="Tile of the maps; default: the one of median road L2.")
    ] = None,
) -> None:
    """Draw the paper's figures from a run, as PDF and PNG with a page of captions."""
    from flexroad.pipeline.reproduce.figures import write_figures
    from flexroad.pipeline.run.record import Run

    for note in write_figures(Run.open(path), output, tile):
        typer.echo(f"note: {note}", err=True)
    typer.echo(f"figures in {output / 'figures.md'}")


def query(
    path: Annotated[Path, typer.Argument(metavar="RUN")],
    points: Annotated[Path, typer.Option(help="CSV with columns easting and northing (m).")],
    variant: Annotated[str | None, typer.Option(help="Which surface; default: the exported one.")] = None,
) -> None:
    """Tell height, unit normal, tile and class of the ground under points, as CSV."""
    from flexroad.pipeline.inspect.points import query_csv

    missed = query_csv(path, points, variant, sys.stdout)
    if missed:
        typer.echo(f"note: {missed} points lie on no finished tile; their columns are empty", err=True)
