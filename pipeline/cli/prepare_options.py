"""The options of ``flexroad prepare`` that several of its commands share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from flexroad.pipeline.cli import options
from flexroad.pipeline.prepare.options import PrepareOptions

COMMON: dict[str, Any] = {
    "cell_m": Annotated[
        float,
        typer.Option(
            "--cell",
            min=0.01,
            metavar="METRES",
            rich_help_panel=options.RASTERS,
            help="Cell of the heights in m.",
        ),
    ],
    "dop_cell_m": Annotated[
        float,
        typer.Option(
            "--dop-cell",
            min=0.01,
            metavar="METRES",
            rich_help_panel=options.RASTERS,
            help="Pixel of the orthophoto in m.",
        ),
    ],
    "crs": Annotated[
        str | None,
        typer.Option(
            "--crs",
            metavar="CRS",
            rich_help_panel=options.INPUTS,
            help="CRS of inputs without one, e.g. EPSG:2994.",
        ),
    ],
    "to_crs": Annotated[
        str | None,
        typer.Option(
            "--to-crs",
            metavar="CRS",
            rich_help_panel=options.RASTERS,
            help="CRS of the rasters; default: the input's, in metres.",
        ),
    ],
    "height_unit": Annotated[
        Literal["metre", "foot", "us-foot"] | None,
        typer.Option(
            "--height-unit",
            rich_help_panel=options.INPUTS,
            help="Unit of heights if the CRS has none; default: that of the plan.",
        ),
    ],
    "roads": Annotated[
        Path | None,
        typer.Option(
            "--roads",
            metavar="FILE",
            rich_help_panel=options.INPUTS,
            help="Roads: polygons, a raster or a mesh, for the mask; or lines.",
        ),
    ],
    "roads_layer": Annotated[
        str | None,
        typer.Option(
            "--roads-layer",
            metavar="NAME",
            rich_help_panel=options.INPUTS,
            help="Layer of --roads, if the file has several.",
        ),
    ],
    "roads_where": Annotated[
        str | None,
        typer.Option(
            "--roads-where",
            metavar="SQL",
            rich_help_panel=options.INPUTS,
            help="SQL condition on --roads: \"class = 'road'\".",
        ),
    ],
    "tile_size_m": Annotated[
        float,
        typer.Option(
            "--tile-size",
            metavar="METRES",
            rich_help_panel=options.RASTERS,
            help="Side of a tile in m; a smaller area is one tile.",
        ),
    ],
    "min_cover": Annotated[
        float,
        typer.Option(
            "--min-cover",
            min=0,
            max=1,
            metavar="SHARE",
            rich_help_panel=options.RASTERS,
            help=options.MIN_COVER_HELP,
        ),
    ],
    "date": Annotated[
        datetime | None,
        typer.Option(
            "--date",
            metavar="YYYY-MM-DD",
            rich_help_panel=options.INPUTS,
            help="Date of the survey; default: that of the files.",
        ),
    ],
    "dataset": Annotated[
        str | None,
        typer.Option(
            "--name",
            metavar="NAME",
            rich_help_panel=options.OUTPUTS,
            help="Name of the data in reports; default: the input's name.",
        ),
    ],
}
"""The command-line options shared by all commands, by field of `PrepareOptions`."""

Out = Annotated[
    Path,
    typer.Option("-o", "--output", metavar="FOLDER", rich_help_panel=options.OUTPUTS, help="Output folder."),
]
Slope = Annotated[
    float | None,
    typer.Option(
        min=0,
        metavar="NUMBER",
        rich_help_panel=options.GROUND,
        help="Ground filter: steepest slope of the ground; 0.35 is 35 %, the slope filter's default.",
    ),
]
Radius = Annotated[
    float | None,
    typer.Option(
        min=1,
        metavar="METRES",
        rich_help_panel=options.GROUND,
        help="Ground filter: search radius in m, half the widest roof.",
    ),
]
Fill = Annotated[
    float | None,
    typer.Option(
        min=0,
        metavar="METRES",
        rich_help_panel=options.RASTERS,
        help="Fill voids of the DSM up to this width in m.",
    ),
]
Void = Annotated[
    float | None,
    typer.Option(
        min=0,
        metavar="METRES",
        rich_help_panel=options.RASTERS,
        help="Fill voids of the DTM up to this width in m.",
    ),
]
Up = Annotated[
    Literal["y", "z"] | None,
    typer.Option(
        rich_help_panel=options.INPUTS, help="The mesh's upward axis; default: y in glTF, z elsewhere."
    ),
]
Offset = Annotated[
    tuple[float, float, float] | None,
    typer.Option(
        metavar="E N H",
        rich_help_panel=options.INPUTS,
        help="Position of the mesh's origin; default: from its sidecar file.",
    ),
]
Density = Annotated[
    float,
    typer.Option(
        min=0.1,
        metavar="NUMBER",
        rich_help_panel=options.RASTERS,
        help="Sampled points per m2 of the mesh's surface.",
    ),
]
Seed = Annotated[
    int,
    typer.Option(min=0, metavar="N", rich_help_panel=options.RASTERS, help="Random seed of the sampling."),
]
NoDop = Annotated[bool, typer.Option("--no-dop", rich_help_panel=options.RASTERS, help="Make no orthophoto.")]
NoRefine = Annotated[
    bool, typer.Option("--no-refine", rich_help_panel=options.RASTERS, help="Do not refine the DTM by ECSRC.")
]


def with_common(command: Callable[..., None]) -> Callable[..., None]:
    """Add the shared options to a command, which receives them as a `PrepareOptions`, its first argument."""
    own = inspect.signature(command, eval_str=True).parameters
    defaults = {field.name: field.default for field in fields(PrepareOptions)}
    common = {
        name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=kind)
        for name, kind in COMMON.items()
    }
    mine = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in list(own.values())[1:]]

    @functools.wraps(command)
    def wrapper(**values: Any) -> None:
        common = PrepareOptions(**{name: values.pop(name) for name in COMMON})
        command(common, **values)

    parameters = [*mine, *common.values()]
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    # Otherwise Typer reads the signature of the wrapped function.
    del wrapper.__wrapped__
    return wrapper
