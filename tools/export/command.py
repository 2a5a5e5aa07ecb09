"""``flexroad export``: write the finished tiles of a run in the formats of other programs."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import typer
from rich.console import Console

from flexroad.catalog.area import Area
from flexroad.catalog.storage.paths import Location, parse_location
from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.signals import INTERRUPTED
from flexroad.pipeline.cli.stdio import echo, end_for_steps
from flexroad.pipeline.config.options import INPUTS, OUTPUTS
from flexroad.pipeline.errors import ClusterLost
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.run.progress import step_progress
from flexroad.pipeline.run.sampler import STEP_REMEDY
from flexroad.tools.export.driver import check_formats
from flexroad.tools.export.driver import export as write
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select

app = group()


@app.command(cls=Command)
@options.with_options
def export(
    ctx: typer.Context,
    path: options.Run,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="Formats, separated by commas: 3dtiles, landxml, cityjson, obj, step, crg, xodr, "
            "lines, mosaic.",
            rich_help_panel=OUTPUTS,
        ),
    ],
    output: options.OutputFolder,
    *,
    vertical: Annotated[
        str | None,
        typer.Option(
            metavar="CRS|FILE|METRES",
            help="Vertical datum of the run's heights, for 3dtiles: its CRS, its geoid (.gtx, .tif), or its "
            "height above the ellipsoid in m.",
            rich_help_panel=INPUTS,
        ),
    ] = None,
    chosen: Options,
    allow_steps: Annotated[
        bool,
        typer.Option(
            "--allow-steps", help="End with exit code 0 although roads lie on tiles that do not meet."
        ),
    ] = False,
    tile: options.TileIds = None,
    bbox: options.Box = None,
    area: options.Area = None,
    workers: options.Parallel = 1,
) -> None:
    """Write finished tiles in the formats of other programs.

    The same command continues after an interruption. FOLDER/export.json lists the written files.
    """
    chosen = replace(chosen, datum=None if vertical is None else Datum.of(vertical))
    folder = parse_location(output)
    names = [name.strip() for name in formats.split(",") if name.strip()]
    check_formats(names, chosen)
    track = step_progress(Console(stderr=True))
    runner = SerialExecutor() if workers == 1 else DaskExecutor(workers)
    try:
        source = select(
            parse_location(path),
            tile or (),
            bbox,
            allow=options.allowed(ctx),
            area=Area.read(area) if area else None,
            track=track,
        )
        if source.left_out:
            _note(f"left out {count(len(source.left_out), 'unfinished tile')}")
        manifest = write(source, folder, names, chosen, runner, track, _note)
    except KeyboardInterrupt:
        echo("interrupted; the same command goes on from here", err=True)
        raise typer.Exit(INTERRUPTED) from None
    except ClusterLost as error:
        echo(f"error: {error}; the same command goes on from here", err=True)
        raise typer.Exit(1) from None
    written = {name: manifest["formats"][name] for name in names}
    for name in names:
        _say(name, written[name], folder / name)
    faults = [f"{name}: {line}; {STEP_REMEDY}" for name in names for line in written[name].get("faults", ())]
    end_for_steps(faults, allow_steps)


def _say(name: str, written: dict[str, Any], folder: Location) -> None:
    """Print what the manifest says of a format."""
    echo(f"{name}: {count(written['files'], 'file')}, {written['bytes'] / 1e6:.1f} MB in {folder}")
    if summary := written.get("summary"):
        echo(f"  {summary}")
    for note in written["notes"]:
        _note(f"{name}: {note}")


def _note(line: str) -> None:
    echo(f"note: {line}", err=True)
