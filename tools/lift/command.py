"""``flexroad lift``: road networks and features of other programs, with heights of a run."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo, end_for_steps
from flexroad.pipeline.config.options import INPUTS, OUTPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.sampler import LARGEST_STEP_M, STEP_REMEDY, RunSampler, length_text
from flexroad.tools.lift.driver import lift as lift_file
from flexroad.tools.lift.types import Options

app = group()


@app.command(cls=Command)
@options.with_options
def lift(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Road network or features without heights.")],
    path: options.Run,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="The copy with heights, in the same format.",
            rich_help_panel=OUTPUTS,
        ),
    ],
    *,
    crs: Annotated[
        str | None,
        typer.Option(metavar="CRS", help="CRS of FILE, if the file names none.", rich_help_panel=INPUTS),
    ] = None,
    offset: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="E N",
            help="Added to the coordinates of FILE (m), if the file has no offset.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a CSV with a row per road: distances, grades, lengths without heights.",
            rich_help_panel=OUTPUTS,
        ),
    ] = None,
    wanted: Options,
    allow_steps: Annotated[
        bool,
        typer.Option("--allow-steps", help="End with exit code 0 although the tiles below do not meet."),
    ] = False,
) -> None:
    """Write a road network or features with heights of a run.

    FILE is OpenDRIVE (.xodr), a network of SUMO (.net.xml), OSM or Lanelet2 (.osm), or a vector file
    (GeoPackage, GeoJSON, FlatGeobuf, Shapefile). Only its heights change.
    """
    grade, crossfall = (
        None if percent is None else percent / 100 for percent in (wanted.grade_limit, wanted.crossfall_limit)
    )
    if report is None and (grade, crossfall) != (None, None):
        raise ConfigError("places above limits are written beside the report; give --report FILE.csv")
    wanted = replace(wanted, grade_limit=grade, crossfall_limit=crossfall)
    ground = RunSampler.open(path, allow=options.allowed(ctx), earlier=True)
    result = lift_file(ground, file, output, wanted, crs, offset, report)
    echo(f"{output}: {result.summary}")
    if result.earlier:
        echo(
            f"note: sources or options of {count(result.earlier, 'tile')} have changed since; the heights "
            f"are of the last finished state; next: flexroad rerun {shlex.quote(str(path))}",
            err=True,
        )
    for note in result.notes:
        echo(f"note: {note}", err=True)
    if result.tile_step_m > LARGEST_STEP_M:
        by = length_text(result.tile_step_m)
        end_for_steps(
            [f"{file}: it lies on tiles that do not meet, by up to {by}; {STEP_REMEDY}"], allow_steps
        )
