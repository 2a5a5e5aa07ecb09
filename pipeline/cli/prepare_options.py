"""The options of ``flexroad prepare`` that several of its commands share."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from flexroad.pipeline.cli import options
from flexroad.pipeline.prepare.options import PrepareOptions

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


def _common() -> list[inspect.Parameter]:
    """Return the fields of `PrepareOptions` as parameters of a command, in their order."""
    kinds, parameters = get_type_hints(PrepareOptions), []
    for field in fields(PrepareOptions):
        if field.metadata:
            more = dict(field.metadata)
            name = more.pop("name", field.name.removesuffix("_m").replace("_", "-"))
            option = typer.Option(f"--{name}", rich_help_panel=more.pop("heading"), **more)
            kind = Annotated[kinds[field.name], option]  # type: ignore[valid-type,name-defined]
            parameters.append(
                inspect.Parameter(
                    field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=kind
                )
            )
    return parameters


def with_common(command: Callable[..., None]) -> Callable[..., None]:
    """Add the shared options to a command, which receives them as a `PrepareOptions`, its first argument."""
    own, shared = inspect.signature(command, eval_str=True).parameters, _common()
    mine = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in list(own.values())[1:]]

    @functools.wraps(command)
    def wrapper(**values: Any) -> None:
        common = PrepareOptions(**{parameter.name: values.pop(parameter.name) for parameter in shared})
        command(common, **values)

    parameters = [*mine, *shared]
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    # Otherwise Typer reads the signature of the wrapped function.
    del wrapper.__wrapped__
    return wrapper
