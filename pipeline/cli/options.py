"""Options that several commands share, and the headings under which help pages list options."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

INPUTS, OUTPUTS, TILES = "Inputs", "Outputs", "Tiles"
METHOD, VALIDATION = "Method", "Split into training and validation"
GROUND, RASTERS, RECONSTRUCTION = "Ground", "Rasters", "Reconstruction"
WORK, ALARMS = "Parallel work", "Alarms and monitoring"
HEADINGS = (
    INPUTS,
    METHOD,
    VALIDATION,
    RECONSTRUCTION,
    GROUND,
    RASTERS,
    TILES,
    OUTPUTS,
    WORK,
    ALARMS,
)
"""In the order of a help page."""


ON_FAILURE = "FLEXROAD_ON_FAILURE"
"""Environment variable for `--on-failure`: options are visible in the list of processes, it is not."""

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of the run, or its address (s3://...).")]
CatalogFile = Annotated[Path, typer.Argument(metavar="CATALOG", help="Catalog of tiles.")]
Allow = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FOLDER|URL",
        help="Allow source files in this folder, too; repeatable.",
        rich_help_panel=INPUTS,
    ),
]
TileIds = Annotated[
    list[str] | None,
    typer.Option("--tile", metavar="ID", help="Only these tiles: --tile ID ID ...", rich_help_panel=TILES),
]
Box = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option("--bbox", metavar="W S E N", help="Only tiles in these bounds (m).", rich_help_panel=TILES),
]
Area = Annotated[
    Path | None,
    typer.Option(
        "--area",
        metavar="FILE",
        help="Only tiles that touch the polygons of this file, in any CRS.",
        rich_help_panel=TILES,
    ),
]
AreaLayer = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Layer of --area, if it has several.", rich_help_panel=TILES),
]
Workers = Annotated[
    int | None,
    typer.Option(min=1, metavar="N", help="Worker processes; default: one per core.", rich_help_panel=WORK),
]
MostWorkers = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        metavar="N",
        help="At most N worker processes; default: one per core.",
        rich_help_panel=WORK,
    ),
]
Executor = Annotated[
    Literal["dask", "serial"],
    typer.Option(help="dask: worker processes; serial: one process, for debugging.", rich_help_panel=WORK),
]
RunExecutor = Annotated[
    Literal["auto", "dask", "serial"],
    typer.Option(
        "--executor",
        help="auto: worker processes if they save more time than their start takes; dask: always; "
        "serial: never.",
        rich_help_panel=WORK,
    ),
]
Dashboard = Annotated[
    bool,
    typer.Option("--dashboard", help="Serve Dask's dashboard and print its address.", rich_help_panel=WORK),
]
Verify = Annotated[
    bool,
    typer.Option(
        "--verify",
        help="Compare the checksums of all products, not only their sizes.",
        rich_help_panel=OUTPUTS,
    ),
]
OnFailure = Annotated[
    str | None,
    typer.Option(
        metavar="CMD|URL",
        envvar=ON_FAILURE,
        help="Shell command or web address (POST) that gets a summary if the exit code is not 0.",
        rich_help_panel=ALARMS,
    ),
]
Prometheus = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Text file for Prometheus (.prom), updated during the run.",
        rich_help_panel=ALARMS,
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Option that replaces the configuration's: fit.spacing_m=5; repeatable.",
        rich_help_panel=INPUTS,
    ),
]
WorkerSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Option of the workers for this command: cluster.memory='8 GiB'; repeatable.",
        rich_help_panel=WORK,
    ),
]
