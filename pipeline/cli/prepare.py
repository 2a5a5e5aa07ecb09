"""``flexroad prepare ...``: rasters and a catalog from points, meshes and photographs."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from flexroad.pipeline.cli.command import Command
from flexroad.pipeline.cli.run import next_run
from flexroad.pipeline.prepare.asked import Asked

if TYPE_CHECKING:
    from flexroad.pipeline.execute import Executor
    from flexroad.pipeline.prepare.sheet import Published
    from flexroad.tasks.acquire.points.to_rasters import Options

prepare = typer.Typer(
    no_args_is_help=True, help="Make DSM, DTM, orthophoto and a catalog where there are none yet."
)

COMMON: dict[str, Any] = {
    "cell_m": Annotated[float, typer.Option("--cell", min=0.01, help="Cell of the heights in m.")],
    "dop_cell_m": Annotated[
        float, typer.Option("--dop-cell", min=0.01, help="Pixel of the orthophoto in m.")
    ],
    "crs": Annotated[
        str | None, typer.Option("--crs", help="CRS of inputs that carry none, like EPSG:2994.")
    ],
    "to_crs": Annotated[
        str | None, typer.Option("--to-crs", help="CRS of the rasters; default: the input's, in metres.")
    ],
    "height_unit": Annotated[
        Literal["metre", "foot", "us-foot"] | None,
        typer.Option("--height-unit", help="Unit of heights where no CRS tells; default: as in plan."),
    ],
    "roads": Annotated[
        Path | None,
        typer.Option("--roads", help="Roads: polygons, a raster or a mesh, for the mask; or lines."),
    ],
    "roads_layer": Annotated[
        str | None, typer.Option("--roads-layer", help="Layer of a vector file with several.")
    ],
    "roads_where": Annotated[
        str | None, typer.Option("--roads-where", help="Which features: \"class = 'road'\".")
    ],
    "tile_size_m": Annotated[
        float, typer.Option("--tile-size", help="Size of a tile in m; a smaller area is one tile.")
    ],
    "date": Annotated[datetime | None, typer.Option("--date", help="When the data was taken.")],
    "dataset": Annotated[
        str | None, typer.Option("--name", help="What reports call the data; default: the input's name.")
    ],
}
"""The options of every command, by their field of `Asked`."""

Out = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: one per core.")]
Slope = Annotated[
    float | None, typer.Option(min=0, help="Steepest fall of the ground, to its filter: 0.35 is 35 %.")
]
Radius = Annotated[
    float | None, typer.Option(min=1, help="How far the ground filter looks in m: half the widest roof.")
]
Fill = Annotated[float | None, typer.Option(min=0, help="Fill voids of the surface up to this width in m.")]
Void = Annotated[float | None, typer.Option(min=0, help="Bridge voids of the ground up to this width in m.")]


def with_common(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of every command; it gets them as one `Asked`, its first argument."""
    own = inspect.signature(command, eval_str=True).parameters
    defaults = {field.name: field.default for field in fields(Asked)}
    common = {
        name: inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=kind)
        for name, kind in COMMON.items()
    }
    mine = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in list(own.values())[1:]]

    @functools.wraps(command)
    def called(**given: Any) -> None:
        asked = Asked(**{name: given.pop(name) for name in COMMON})
        command(asked, **given)

    parameters = [*mine, *common.values()]
    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    # Typer looks behind wrappers for the signature.
    del called.__wrapped__
    return called


def _points_options(
    slope: float | None, radius: float | None, fill: float | None, void: float | None, **more: Any
) -> Options:
    """Return how points become rasters: the defaults but for what was asked."""
    from flexroad.tasks.acquire.points.ground_filter import Options as Filter
    from flexroad.tasks.acquire.points.to_rasters import Options

    ground_filter = Filter(**_told(slope=slope, radius_m=radius))
    return Options(filter=ground_filter, **_told(fill_m=fill, void_m=void, **more))


def _told(**options: Any) -> dict[str, Any]:
    """Return the options that were given; the others keep the defaults of their models."""
    return {name: value for name, value in options.items() if value is not None}


def _executor(workers: int | None) -> Executor:
    from flexroad.pipeline.execute import DaskExecutor, SerialExecutor

    return SerialExecutor() if workers == 1 else DaskExecutor(workers)


def _say(line: str) -> None:
    typer.echo(line, err=True)


def _carry_out(make: Callable[[], Published]) -> None:
    """Make it; an operator's `kill` ends it as Ctrl-C does, with nothing left behind."""
    import signal

    from flexroad.pipeline.errors import ConfigError
    from flexroad.tasks.errors import TaskError

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        made = make()
    except TaskError as error:
        raise ConfigError(str(error)) from error
    except KeyboardInterrupt:
        typer.echo("interrupted; nothing was written", err=True)
        raise typer.Exit(130) from None
    for note in made.notes:
        typer.echo(f"note: {note}", err=True)
    typer.echo(f"{made.tiles} tile{'s' * (made.tiles != 1)} in {made.catalog}")
    typer.echo(f"next: {next_run(made.catalog)}")


@prepare.command("points", cls=Command)
@with_common
def prepare_points(
    asked: Asked,
    files: Annotated[list[Path], typer.Argument(help="LAS, LAZ or COPC files, or folders of them.")],
    output: Out,
    ground: Annotated[
        Literal["auto", "classes", "filter"],
        typer.Option(help="What finds the ground; auto: classes where all files have them."),
    ] = "auto",
    ground_class: Annotated[list[int] | None, typer.Option(help="Classes of ground; default: 2.")] = None,
    bridge_class: Annotated[
        list[int] | None, typer.Option(help="Classes of bridge decks; default: 17.")
    ] = None,
    dtm: Annotated[
        Literal["tin", "mean"] | None, typer.Option(help="Ground: linear between points, or mean per cell.")
    ] = None,
    slope: Slope = None,
    radius: Radius = None,
    despike: Annotated[
        float | None, typer.Option(min=0.1, help="Drop single points so far above all around them (m).")
    ] = None,
    fill: Fill = None,
    void: Void = None,
    workers: Workers = None,
) -> None:
    """Raster laser scans and other point clouds: highest point per cell, ground, bridges, colours."""
    from flexroad.pipeline.prepare import points

    options = _points_options(
        slope,
        radius,
        fill,
        void,
        despike_m=despike,
        dtm=dtm,
        ground_classes=ground_class,
        bridge_classes=bridge_class,
    )
    _carry_out(lambda: points.prepare_points(files, output, asked, options, _executor(workers), _say, ground))


Up = Annotated[
    Literal["y", "z"] | None, typer.Option(help="The mesh's upward axis; default: y in glTF, z elsewhere.")
]
Offset = Annotated[
    tuple[float, float, float] | None,
    typer.Option(metavar="E N H", help="Place of the mesh's zero; default: that of its sidecar."),
]
Density = Annotated[float, typer.Option(min=0.1, help="Points per m2 of the mesh's surface.")]
Seed = Annotated[int, typer.Option(min=0, help="Of the points' places.")]
NoDop = Annotated[bool, typer.Option("--no-dop", help="Draw no orthophoto.")]
NoRefine = Annotated[bool, typer.Option("--no-refine", help="Leave the DTM as the ground filter gives it.")]


@prepare.command("mesh")
@with_common
def prepare_mesh(
    asked: Asked,
    mesh: Annotated[Path, typer.Argument(help="OBJ, PLY or glTF with textures or coloured vertices.")],
    output: Out,
    up: Up = None,
    offset: Offset = None,
    density: Density = 25.0,
    seed: Seed = 0,
    no_dop: NoDop = False,
    no_refine: NoRefine = False,
    slope: Slope = None,
    radius: Radius = None,
    fill: Fill = None,
    void: Void = None,
    workers: Workers = None,
) -> None:
    """Raster a textured mesh as the paper does: sampled points, highest per cell, view from above."""
    from flexroad.pipeline.prepare import mesh as meshes

    of_mesh = meshes.MeshAsked(up, offset, density, seed, dop=not no_dop, refine=not no_refine)
    options = _points_options(slope, radius, fill, void, ground="filter")
    _carry_out(lambda: meshes.prepare_mesh(mesh, output, asked, of_mesh, options, _executor(workers), _say))


@prepare.command("odm")
@with_common
def prepare_odm(
    asked: Asked,
    project: Annotated[Path, typer.Argument(help="Project folder of OpenDroneMap.")],
    output: Out,
    density: Density = 25.0,
    seed: Seed = 0,
    slope: Slope = None,
    radius: Radius = None,
    fill: Fill = None,
    void: Void = None,
    workers: Workers = None,
) -> None:
    """Take what an OpenDroneMap project has: its rasters, else its textured mesh, else its points."""
    from flexroad.pipeline.prepare import mesh, odm

    of_mesh = mesh.MeshAsked(density=density, seed=seed)
    options = _points_options(slope, radius, fill, void, ground="filter")
    _carry_out(lambda: odm.prepare_odm(project, output, asked, of_mesh, options, _executor(workers), _say))


@prepare.command("photos")
@with_common
def prepare_photos(
    asked: Asked,
    images: Annotated[list[Path], typer.Argument(help="Overlapping photographs with GNSS tags, or folders.")],
    output: Out,
    control: Annotated[
        Path | None, typer.Option(help="Ground control, CSV: image,x_px,y_px,easting,northing,height.")
    ] = None,
    control_crs: Annotated[
        str | None, typer.Option(help="CRS of the control; default: the rasters'.")
    ] = None,
    image_size: Annotated[
        int | None, typer.Option(min=320, help="Longest side at which features are sought, in pixels.")
    ] = None,
    stereo_size: Annotated[
        int | None, typer.Option(min=320, help="Longest side at which depth is measured, in pixels.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of all random choices.")] = None,
    no_refine: NoRefine = False,
    slope: Slope = None,
    radius: Radius = None,
    fill: Fill = None,
    void: Void = None,
    workers: Workers = None,
) -> None:
    """Reconstruct a place from photographs: cameras, dense stereo, Poisson mesh, and that as `mesh` does."""
    from flexroad.pipeline.prepare import photos
    from flexroad.tasks.acquire.photos import mvs_cpu, mvs_gpu, sfm

    of_photos = photos.PhotosAsked(
        control,
        control_crs,
        sfm.Options(**_told(image_size=image_size, seed=seed)),
        mvs_cpu.Options(**_told(size=stereo_size)),
        mvs_gpu.Options(**_told(size=stereo_size)),
        refine=not no_refine,
    )
    options = _points_options(slope, radius, fill, void, ground="filter")
    _carry_out(
        lambda: photos.prepare_photos(images, output, asked, of_photos, options, _executor(workers), _say)
    )
