"""Options that several commands share, and options made from the fields of dataclasses."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from flexroad.pipeline.config.options import INPUTS, OUTPUTS, TILES, WORK


def under(heading: str, help: str, *names: str, **more: Any) -> Any:
    """Return an option that is listed below a heading of a help page."""
    return typer.Option(*names, help=help, rich_help_panel=heading, **more)


Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of the run, or its address (s3://...).")]
OutputFolder = Annotated[Path, under(OUTPUTS, "Output folder.", "-o", "--output", metavar="FOLDER")]
CatalogFile = Annotated[Path, typer.Argument(metavar="CATALOG", help="Catalog of tiles.")]
TileIds = Annotated[
    list[str] | None, under(TILES, "Only these tiles: --tile ID ID ...", "--tile", metavar="ID")
]
Box = Annotated[
    tuple[float, float, float, float] | None,
    under(TILES, "Only tiles in these bounds (m).", "--bbox", metavar="W S E N"),
]
Area = Annotated[
    Path | None,
    under(
        TILES,
        "Only tiles that touch the polygons of this file, in any CRS; FILE|layername=NAME for one layer.",
        "--area",
        metavar="FILE",
    ),
]
Workers = Annotated[int | None, under(WORK, "Worker processes; default: one per core.", min=1, metavar="N")]
MostWorkers = Annotated[
    int | None,
    under(WORK, "At most N worker processes; default: one per core.", "--workers", min=1, metavar="N"),
]
Parallel = Annotated[
    int, under(WORK, "Worker processes; default: this process alone.", "--workers", min=1, metavar="N")
]
Dashboard = Annotated[bool, under(WORK, "Serve Dask's dashboard and print its address.", "--dashboard")]
Verify = Annotated[
    bool, under(OUTPUTS, "Compare the checksums of all products, not only their sizes.", "--verify")
]
Settings = Annotated[
    list[str] | None,
    under(
        INPUTS,
        "Option that replaces the configuration's: fit.spacing_m=5; repeatable.",
        "--set",
        metavar="KEY=VALUE",
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


def allowed(ctx: typer.Context) -> list[str]:
    """Return the folders of the program's option ``--allow``."""
    return ctx.find_root().params["allow"] or []


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take the fields of its dataclasses as options, and receive the dataclasses.

    Options are the fields made by `pipeline.config.options.option`. A parameter ``Annotated[Kind, "name",
    ...]`` has only the fields with these names.
    """
    parameters: list[inspect.Parameter] = []
    taken: dict[str, tuple[Any, dict[str, inspect.Parameter]]] = {}
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        annotation = parameter.annotation
        kind, *names = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
        if is_dataclass(kind):
            own = {name: option for name, option in _options(kind) if not names or name in names}
            taken[parameter.name] = kind, own
            parameters += own.values()
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(command)
    def wrapper(**values: Any) -> None:
        for parameter, (kind, own) in taken.items():
            given = {name: values.pop(option.name) for name, option in own.items()}
            inverted = {name: not given[name] for name, option in own.items() if option.name != name}
            values[parameter] = kind(**{**given, **inverted})
        command(**values)

    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    # Otherwise Typer reads the signature of the wrapped function.
    del wrapper.__wrapped__
    return wrapper


def _options(kind: Any) -> Iterator[tuple[str, inspect.Parameter]]:
    """Yield the fields that are options with their parameters, named ``no_...`` if they are inverted."""
    kinds = get_type_hints(kind)
    for field in fields(kind):
        if not field.metadata:
            continue
        more, name, default = dict(field.metadata), field.name, field.default
        word = more.pop("name", name.removesuffix("_m").replace("_", "-"))
        if default is True:
            name, word, default = f"no_{name}", f"no-{word}", False
        option = typer.Option(f"--{word}", rich_help_panel=more.pop("heading"), **more)
        yield (
            field.name,
            inspect.Parameter(
                name,
                inspect.Parameter.KEYWORD_ONLY,
                default=inspect.Parameter.empty if default is MISSING else default,
                annotation=Annotated[kinds[field.name], option],
            ),
        )
