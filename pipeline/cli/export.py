"""``flexroad export``: write the finished tiles of a run in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.errors import ConfigError

if TYPE_CHECKING:
    from flexroad.catalog.ellipsoidal import Datum


def export(
    path: options.Run,
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="NAME",
            help="Formats, separated by commas: 3dtiles, landxml, cityjson, obj, heightfield, step, 3dm.",
            rich_help_panel=options.OUTPUTS,
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", metavar="FOLDER", help="Output folder.", rich_help_panel=options.OUTPUTS
        ),
    ],
    compress: Annotated[
        bool, typer.Option("--gzip", help="Compress LandXML.", rich_help_panel=options.OUTPUTS)
    ] = False,
    vertical: Annotated[
        str | None,
        typer.Option(
            metavar="CRS",
            help="Vertical CRS of the run's heights, for 3dtiles.",
            rich_help_panel=options.INPUTS,
        ),
    ] = None,
    geoid: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Geoid of the heights (.gtx, .tif), instead.", rich_help_panel=options.INPUTS
        ),
    ] = None,
    height_offset: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Height of the vertical datum above the ellipsoid, instead.",
            rich_help_panel=options.INPUTS,
        ),
    ] = None,
    tile: options.TileIds = None,
    bbox: options.Box = None,
    allow: options.Allow = None,
    executor: options.Executor = "serial",
    workers: options.Workers = None,
) -> None:
    """Write finished tiles in the formats of other programs.

    The same command goes on after an interruption. FOLDER/export.json says what was written.
    """
    from rich.console import Console

    from flexroad.catalog.storage.paths import parse_location
    from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
    from flexroad.pipeline.export.driver import check_formats
    from flexroad.pipeline.export.driver import export as write
    from flexroad.pipeline.export.options import Options
    from flexroad.pipeline.export.source import select
    from flexroad.pipeline.monitor.progress import StepProgress

    chosen = Options(_datum(vertical, geoid, height_offset), compress)
    names = [name.strip() for name in formats.split(",") if name.strip()]
    check_formats(names, chosen)
    source = select(parse_location(path), tile or (), bbox, None, [str(place) for place in allow or ()])
    if source.left_out:
        echo(f"note: left out {count(len(source.left_out), 'tile')} that are not finished", err=True)
    runner = SerialExecutor() if executor == "serial" else DaskExecutor(workers)
    track = StepProgress(Console(stderr=True))
    manifest = write(source, parse_location(output), names, chosen, runner, track)
    for name, written in manifest["formats"].items():
        size = written["bytes"] / 1e6
        echo(f"{name}: {count(written['files'], 'file')}, {size:.1f} MB in {output / name}")


def _datum(vertical: str | None, geoid: Path | None, offset: float | None) -> Datum | None:
    from flexroad.catalog.ellipsoidal import Datum

    given = {
        "crs": vertical,
        "geoid": None if geoid is None else str(geoid),
        "offset": None if offset is None else f"{offset:g}",
    }
    chosen = {kind: value for kind, value in given.items() if value is not None}
    if len(chosen) > 1:
        raise ConfigError("give one of --vertical, --geoid and --height-offset")
    for kind, value in chosen.items():
        return Datum(kind, value)  # type: ignore[arg-type]
    return None
