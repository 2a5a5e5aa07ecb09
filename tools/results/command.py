"""``flexroad query``: heights, normals and classes of a run at points or along lines."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.options import INPUTS, OUTPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.sampler import RunSampler, required_crs
from flexroad.tools.results.query import (
    LevelWanted,
    along_lines,
    at_points,
    beyond_survey,
    on_flagged,
    outside,
)
from flexroad.tools.results.query_files import parse_csv, read_lines, read_points

app = group()

STDIN = Path("-")


@app.command(cls=Command)
def query(
    ctx: typer.Context,
    path: options.Run,
    points: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Points: CSV (easting, northing in m), GeoPackage or GeoJSON, FILE|layername=NAME for one "
            "layer; - reads a CSV from standard input.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    line: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|'X Y, X Y'",
            help="Profile along the lines of a vector file, or along a line through these points.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    step: Annotated[
        float,
        typer.Option(min=0.001, metavar="METRES", help="Step along a line (m).", rich_help_panel=INPUTS),
    ] = 1.0,
    crs: Annotated[
        str | None,
        typer.Option(
            metavar="CRS",
            help="CRS of the points or the line, if it is not the run's: EPSG:4326 for degrees. First east, "
            "then north.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option(
            metavar="N|all",
            help="Level of roads above roads: 0 is the ground, all: a row per level; default: the highest.",
        ),
    ] = None,
    variant: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Variant of the surface; default: the exported one."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Write a .csv or .gpkg instead of printing CSV.",
            rich_help_panel=OUTPUTS,
        ),
    ] = None,
) -> None:
    """Print heights, classes and flags at points or along lines.

    The output is CSV: the columns of the points and height_m, nx, ny, nz, tile, class and flags; with --line
    also distance and grade.
    """
    if (points is None) == (line is None):
        raise ConfigError("give the points with --points FILE, or a line with --line")
    if output is not None and output.suffix.lower() not in (".csv", ".gpkg"):
        raise ConfigError(f"-o {output}: give a name that ends in .csv or .gpkg")
    wanted = _level(level)
    sampler = RunSampler.open(path, variant, options.allowed(ctx), earlier=True)
    if line is not None:
        result = along_lines(sampler, read_lines(line, crs, required_crs(sampler)), step, wanted)
    elif points == STDIN:
        result = at_points(sampler, parse_csv(sys.stdin.buffer.read(), "standard input", crs), wanted)
    else:
        assert points is not None
        result = at_points(sampler, read_points(points, crs), wanted)
    if output is not None and output.suffix.lower() == ".gpkg":
        result.write_geopackage(output)
    else:
        result.write_csv(output or sys.stdout)
    if number := len(result.answer.earlier):
        echo(
            f"note: sources or options of {count(number, 'tile')} have changed since; the values are of "
            f"the last finished state; next: flexroad rerun {shlex.quote(str(path))}",
            err=True,
        )
    for note in filter(
        None, (*result.notes, outside(result, sampler), beyond_survey(result), on_flagged(result))
    ):
        echo(f"note: {note}", err=True)


def _level(text: str | None) -> LevelWanted:
    if text is None:
        return None
    if text == "all":
        return "all"
    try:
        return int(text)
    except ValueError:
        raise ConfigError(f"--level {text}: give a whole number, such as 0, or all") from None
