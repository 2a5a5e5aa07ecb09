"""``flexroad lift``: road networks and features of other programs, with heights of a run."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Literal

import typer

from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.options import INPUTS, OUTPUTS
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.sampler import RunSampler
from flexroad.pipeline.run.tile_steps import LARGEST_M, REMEDY, length_text
from flexroad.tools.lift.driver import lift as lift_file
from flexroad.tools.lift.types import Options

app = group()


@app.command(cls=Command)
def lift(
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
    crs: Annotated[
        str | None,
        typer.Option(metavar="CRS", help="CRS of FILE, if it does not say it.", rich_help_panel=INPUTS),
    ] = None,
    offset: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="E N",
            help="Added to the coordinates of FILE (m), if it does not say it.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(min=0.0001, metavar="METRES", help="Largest distance of profiles from the surface (m)."),
    ] = 0.005,
    lateral: Annotated[
        Literal["superelevation", "none"],
        typer.Option(help="What roads of OpenDRIVE have across."),
    ] = "superelevation",
    beyond: Annotated[
        Literal["keep", "flat"],
        typer.Option(help="Heights where the run has no surface: as they are, or level from there on."),
    ] = "keep",
    vertices: Annotated[
        bool | None,
        typer.Option(
            "--vertices/--no-vertices",
            help="Add vertices where lines leave the surface; default: yes, but not to OSM files.",
        ),
    ] = None,
    columns: Annotated[
        bool,
        typer.Option(
            "--columns",
            help="Add the columns grade_max_percent, crossfall_max_percent and error_estimate_m to features.",
        ),
    ] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a CSV with a row per road: distances, grades, what has no heights.",
            rich_help_panel=OUTPUTS,
        ),
    ] = None,
    grade_limit: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="PERCENT",
            help="Write places with a steeper grade as points beside the report.",
            rich_help_panel=OUTPUTS,
        ),
    ] = None,
    crossfall_limit: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="PERCENT",
            help="Write places with a steeper crossfall as points beside the report.",
            rich_help_panel=OUTPUTS,
        ),
    ] = None,
    allow_steps: Annotated[
        bool,
        typer.Option("--allow-steps", help="End with exit code 0 although the tiles below do not meet."),
    ] = False,
    variant: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Variant of the surface; default: the exported one."),
    ] = None,
    allow: options.Allow = None,
) -> None:
    """Write a road network or features with heights of a run.

    FILE is OpenDRIVE (.xodr), a network of SUMO (.net.xml), OSM or Lanelet2 (.osm), or a vector file
    (GeoPackage, GeoJSON, FlatGeobuf, Shapefile). All else in it stays as it is.
    """
    if report is None and (grade_limit is not None or crossfall_limit is not None):
        raise ConfigError("places above limits are written beside the report; give --report FILE.csv")
    wanted = Options(
        tolerance_m=tolerance,
        lateral=lateral,
        flat_ends=beyond == "flat",
        add_vertices=vertices,
        columns=columns,
        grade_limit=None if grade_limit is None else grade_limit / 100,
        crossfall_limit=None if crossfall_limit is None else crossfall_limit / 100,
    )
    ground = RunSampler.open(path, variant, allow or (), earlier=True)
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
    if result.tile_step_m > LARGEST_M:
        by = length_text(result.tile_step_m)
        kind = "note" if allow_steps else "error"
        echo(f"{kind}: {file}: it lies on tiles that do not meet, by up to {by}; {REMEDY}", err=True)
    if result.tile_step_m > LARGEST_M and not allow_steps:
        echo("the file is written; --allow-steps takes it as it is", err=True)
        raise typer.Exit(1)
