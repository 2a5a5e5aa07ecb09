"""``flexroad prepare ...``: make rasters and a catalog from points, meshes and photographs."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from flexroad.pipeline.cli.command import MIN_COVER_HELP, Command
from flexroad.pipeline.cli.next_step import after_catalog
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.prepare.options import PrepareOptions

if TYPE_CHECKING:
    from flexroad.pipeline.execute import Executor
    from flexroad.pipeline.prepare.raster_writer import PreparedDataset
    from flexroad.tasks.acquire.points.to_rasters import Options

prepare = typer.Typer(
    no_args_is_help=True,
    help="Make DSM, DTM, orthophoto and a catalog from point clouds, meshes or photographs.",
)

COMMON: dict[str, Any] = {
    "cell_m": Annotated[float, typer.Option("--cell", min=0.01, help="Cell of the heights in m.")],
    "dop_cell_m": Annotated[
        float, typer.Option("--dop-cell", min=0.01, help="Pixel of the orthophoto in m.")
    ],
    "crs": Annotated[str | None, typer.Option("--crs", help="CRS of inputs without one, e.g. EPSG:2994.")],
    "to_crs": Annotated[
        str | None, typer.Option("--to-crs", help="CRS of the rasters; default: the input's, in metres.")
    ],
    "height_unit": Annotated[
        Literal["metre", "foot", "us-foot"] | None,
        typer.Option("--height-unit", help="Unit of heights if the CRS has none; default: that of the plan."),
    ],
    "roads": Annotated[
        Path | None,
        typer.Option("--roads", help="Roads: polygons, a raster or a mesh, for the mask; or lines."),
    ],
    "roads_layer": Annotated[
        str | None, typer.Option("--roads-layer", help="Layer of --roads, if the file has several.")
    ],
    "roads_where": Annotated[
        str | None, typer.Option("--roads-where", help="SQL condition on --roads: \"class = 'road'\".")
    ],
    "tile_size_m": Annotated[
        float, typer.Option("--tile-size", help="Side of a tile in m; a smaller area is one tile.")
    ],
    "min_cover": Annotated[float, typer.Option("--min-cover", min=0, max=1, help=MIN_COVER_HELP)],
    "date": Annotated[datetime | None, typer.Option("--date", help="Acquisition date.")],
    "dataset": Annotated[
        str | None, typer.Option("--name", help="Name of the data in reports; default: the input's name.")
    ],
}
"""The command-line options shared by all commands, by field of `PrepareOptions`."""

Out = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Output folder.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: one per core.")]
Slope = Annotated[
    float | None, typer.Option(min=0, help="Ground filter: steepest slope of the ground; 0.35 is 35 %.")
]
Radius = Annotated[
    float | None, typer.Option(min=1, help="Ground filter: search radius in m, half the widest roof.")
]
Fill = Annotated[float | None, typer.Option(min=0, help="Fill voids of the DSM up to this width in m.")]
Void = Annotated[float | None, typer.Option(min=0, help="Fill voids of the DTM up to this width in m.")]


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


def _points_options(
    slope: float | None, radius: float | None, fill: float | None, void: float | None, **more: Any
) -> Options:
    """Return the options for making rasters of points; None keeps a default."""
    from flexroad.tasks.acquire.points.ground_filter import Options as Filter
    from flexroad.tasks.acquire.points.to_rasters import Options

    ground_filter = Filter(**_given(slope=slope, radius_m=radius))
    return Options(filter=ground_filter, **_given(fill_m=fill, void_m=void, **more))


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None; the others keep the defaults of their models."""
    return {name: value for name, value in options.items() if value is not None}


def _executor(workers: int | None) -> Executor:
    from flexroad.pipeline.execute import DaskExecutor, SerialExecutor

    return SerialExecutor() if workers == 1 else DaskExecutor(workers)


def _log(line: str) -> None:
    echo(line, err=True)


def _run(make: Callable[[], PreparedDataset]) -> None:
    """Run a command and print its result; SIGTERM is handled like Ctrl-C, and leaves no files behind."""
    import signal

    from flexroad.pipeline.errors import ConfigError
    from flexroad.tasks.errors import TaskError

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        dataset = make()
    except TaskError as error:
        raise ConfigError(str(error)) from error
    except KeyboardInterrupt:
        echo("interrupted; nothing was written", err=True)
        raise typer.Exit(130) from None
    for note in dataset.notes:
        echo(f"note: {note}", err=True)
    echo(f"{dataset.tiles} tile{'s' * (dataset.tiles != 1)} in {dataset.catalog}")
    echo(after_catalog(dataset.catalog))


@prepare.command("points", cls=Command)
@with_common
def prepare_points(
    common: PrepareOptions,
    files: Annotated[list[Path], typer.Argument(help="LAS, LAZ or COPC files, or folders of them.")],
    output: Out,
    ground: Annotated[
        Literal["auto", "classes", "filter"],
        typer.Option(help="How ground is identified; auto: by classes if all files have them."),
    ] = "auto",
    ground_class: Annotated[list[int] | None, typer.Option(help="Classes of ground; default: 2.")] = None,
    bridge_class: Annotated[
        list[int] | None, typer.Option(help="Classes of bridge decks; default: 17.")
    ] = None,
    dtm: Annotated[
        Literal["tin", "mean"] | None,
        typer.Option(help="DTM: linear between ground points, or their mean per cell."),
    ] = None,
    slope: Slope = None,
    radius: Radius = None,
    despike: Annotated[
        float | None,
        typer.Option(min=0.1, help="Drop single points that are this much above all around (m)."),
    ] = None,
    fill: Fill = None,
    void: Void = None,
    workers: Workers = None,
) -> None:
    """Make rasters of laser scans and other point clouds: DSM, DTM, bridge decks and orthophoto."""
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
    _run(lambda: points.prepare_points(files, output, common, options, _executor(workers), _log, ground))


Up = Annotated[
    Literal["y", "z"] | None, typer.Option(help="The mesh's upward axis; default: y in glTF, z elsewhere.")
]
Offset = Annotated[
    tuple[float, float, float] | None,
    typer.Option(metavar="E N H", help="Position of the mesh's origin; default: from its sidecar file."),
]
Density = Annotated[float, typer.Option(min=0.1, help="Sampled points per m2 of the mesh's surface.")]
Seed = Annotated[int, typer.Option(min=0, help="Random seed of the sampling.")]
NoDop = Annotated[bool, typer.Option("--no-dop", help="Make no orthophoto.")]
NoRefine = Annotated[bool, typer.Option("--no-refine", help="Do not refine the DTM by ECSRC.")]


@prepare.command("mesh")
@with_common
def prepare_mesh(
    common: PrepareOptions,
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
    """Make rasters of a textured mesh as in the paper: from sampled points, and its texture from above."""
    from flexroad.pipeline.prepare import mesh as meshes

    mesh_options = meshes.MeshOptions(up, offset, density, seed, dop=not no_dop, refine=not no_refine)
    options = _points_options(slope, radius, fill, void, ground="filter")
    _run(lambda: meshes.prepare_mesh(mesh, output, common, mesh_options, options, _executor(workers), _log))


@prepare.command("odm")
@with_common
def prepare_odm(
    common: PrepareOptions,
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
    """Use the rasters of an OpenDroneMap project, else its textured mesh, else its points."""
    from flexroad.pipeline.prepare import mesh, odm

    mesh_options = mesh.MeshOptions(density=density, seed=seed)
    options = _points_options(slope, radius, fill, void, ground="filter")
    _run(lambda: odm.prepare_odm(project, output, common, mesh_options, options, _executor(workers), _log))


@prepare.command("photos")
@with_common
def prepare_photos(
    common: PrepareOptions,
    images: Annotated[list[Path], typer.Argument(help="Overlapping photographs with GNSS tags, or folders.")],
    output: Out,
    control: Annotated[
        Path | None, typer.Option(help="Ground control, CSV: image,x_px,y_px,easting,northing,height.")
    ] = None,
    control_crs: Annotated[
        str | None, typer.Option(help="CRS of the control; default: the rasters'.")
    ] = None,
    image_size: Annotated[
        int | None, typer.Option(min=320, help="Longest side of images for feature detection, in pixels.")
    ] = None,
    stereo_size: Annotated[
        int | None, typer.Option(min=320, help="Longest side of images for dense stereo, in pixels.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Random seed.")] = None,
    no_refine: NoRefine = False,
    slope: Slope = None,
    radius: Radius = None,
    fill: Fill = None,
    void: Void = None,
    workers: Workers = None,
) -> None:
    """Reconstruct an area from photographs: cameras, dense stereo, Poisson mesh, rasters as with `mesh`."""
    from flexroad.pipeline.prepare import photos
    from flexroad.tasks.acquire.photos import mvs_cpu, mvs_gpu, sfm

    photos_options = photos.PhotosOptions(
        control,
        control_crs,
        sfm.Options(**_given(image_size=image_size, seed=seed)),
        mvs_cpu.Options(**_given(size=stereo_size)),
        mvs_gpu.Options(**_given(size=stereo_size)),
        refine=not no_refine,
    )
    options = _points_options(slope, radius, fill, void, ground="filter")
    _run(
        lambda: photos.prepare_photos(
            images, output, common, photos_options, options, _executor(workers), _log
        )
    )
