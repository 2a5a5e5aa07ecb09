"""``flexroad prepare ...``: make rasters and a catalog from points, meshes and photographs."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from flexroad.catalog.storage.outputs import made_folder
from flexroad.catalog.storage.paths import check_writable
from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.catalogs import after_catalog
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.signals import INTERRUPTED
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.options import GROUND, RECONSTRUCTION, option
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, Executor, SerialExecutor
from flexroad.pipeline.run.lock import run_lock
from flexroad.tasks.errors import TaskError
from flexroad.tools.prepare import from_mesh, from_odm, from_photos, from_points
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.output import check_replaced, disk_errors
from flexroad.tools.prepare.photos import mvs_cpu, sfm
from flexroad.tools.prepare.points import ground_filter, morphological
from flexroad.tools.prepare.points.to_rasters import Options
from flexroad.tools.prepare.raster_writer import PreparedDataset

app = group("prepare", "Make rasters and a catalog of points, meshes or photographs.")


@dataclass(frozen=True)
class _RasterOptions:
    """How points become rasters, as far as all commands have it; None keeps the default of the method."""

    slope: float | None = option(
        None,
        GROUND,
        "Ground filter: steepest slope of the ground; 0.35 is 35 %, the slope filter's default.",
        "NUMBER",
        min=0,
    )
    radius_m: float | None = option(
        None, GROUND, "Ground filter: search radius in m, half the widest roof.", "METRES", min=1
    )

    def of(self, **more: Any) -> Options:
        """Return the options for making rasters, with more of them; None keeps a default."""
        given = _given(slope=self.slope, radius_m=self.radius_m)
        if more.get("ground") == "morphological":
            more["morphological"] = morphological.Options(**given)
        else:
            more["filter"] = ground_filter.Options(**given)
        return Options(**_given(**more))


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None; the others keep the defaults of their models."""
    return {name: value for name, value in options.items() if value is not None}


def _executor(workers: int | None) -> Executor:
    return SerialExecutor() if workers == 1 else DaskExecutor(workers)


def _log(line: str) -> None:
    echo(line, err=True)


@contextlib.contextmanager
def _held(out: Path) -> Iterator[None]:
    """Make the output folder, check that it can be written, and hold its lock; no empty one is left."""
    check_replaced(out)
    with contextlib.ExitStack() as stack:
        with disk_errors(out):
            stack.enter_context(made_folder(out))
            check_writable(out)
        stack.enter_context(run_lock(out, lambda line: _log(f"note: {line}")))
        yield


def _run(out: Path, make: Callable[[], PreparedDataset]) -> None:
    """Run a command and print its result; an interruption leaves no files behind."""
    try:
        with _held(out):
            dataset = make()
    except TaskError as error:
        raise ConfigError(str(error)) from error
    except KeyboardInterrupt:
        echo("interrupted; nothing was written", err=True)
        raise typer.Exit(INTERRUPTED) from None
    for note in dataset.notes:
        echo(f"note: {note}", err=True)
    echo(f"{count(dataset.tiles, 'tile')} in {dataset.catalog}")
    echo(after_catalog(dataset.catalog))


@app.command("points", cls=Command)
@options.with_options
def prepare_points(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE", help="LAS, LAZ or COPC files, or folders of them.")
    ],
    output: options.OutputFolder,
    *,
    ground: Annotated[
        Literal["auto", "classes", "filter", "morphological"],
        typer.Option(
            rich_help_panel=GROUND,
            help="How ground is identified; auto: by classes if all files have them, else by filter.",
        ),
    ] = "auto",
    ground_class: Annotated[
        list[int] | None,
        typer.Option(metavar="N", rich_help_panel=GROUND, help="Classes of ground; default: 2."),
    ] = None,
    bridge_class: Annotated[
        list[int] | None,
        typer.Option(
            metavar="N",
            rich_help_panel=GROUND,
            help="Classes of bridge decks; default: 17; 26 in the Dutch AHN.",
        ),
    ] = None,
    rasters: _RasterOptions,
    workers: options.Workers = None,
    common: PrepareOptions,
) -> None:
    """Make rasters of laser scans and other point clouds.

    They are DSM, DTM, bridge decks and orthophoto.
    """
    options = rasters.of(
        ground=ground if ground == "morphological" else None,
        ground_classes=ground_class,
        bridge_classes=bridge_class,
    )
    _run(
        output,
        lambda: from_points.prepare_points(files, output, common, options, _executor(workers), _log, ground),
    )


@app.command("mesh", cls=Command)
@options.with_options
def prepare_mesh(
    file: Annotated[
        Path, typer.Argument(metavar="MESH", help="OBJ, PLY or glTF with textures or coloured vertices.")
    ],
    output: options.OutputFolder,
    mesh_options: from_mesh.MeshOptions,
    rasters: _RasterOptions,
    *,
    workers: options.Workers = None,
    common: PrepareOptions,
) -> None:
    """Make rasters of a textured mesh, as in the paper.

    They are made from sampled points, and from its texture seen from above.
    """
    options = rasters.of(ground="filter")
    _run(
        output,
        lambda: from_mesh.prepare_mesh(file, output, common, mesh_options, options, _executor(workers), _log),
    )


@app.command("odm", cls=Command)
@options.with_options
def prepare_odm(
    project: Annotated[Path, typer.Argument(metavar="PROJECT", help="Project folder of OpenDroneMap.")],
    output: options.OutputFolder,
    mesh_options: Annotated[from_mesh.MeshOptions, "density"],
    rasters: _RasterOptions,
    *,
    workers: options.Workers = None,
    common: PrepareOptions,
) -> None:
    """Take or make the rasters of an OpenDroneMap project.

    Its own rasters are taken, else they are made of its textured mesh, else of its points.
    """
    options = rasters.of(ground="filter")
    _run(
        output,
        lambda: from_odm.prepare_odm(
            project, output, common, mesh_options, options, _executor(workers), _log
        ),
    )


@app.command("photos", cls=Command)
@options.with_options
def prepare_photos(
    images: Annotated[
        list[Path],
        typer.Argument(metavar="IMAGE", help="Overlapping photographs with GNSS tags, or folders."),
    ],
    output: options.OutputFolder,
    photos_options: from_photos.PhotosOptions,
    rasters: _RasterOptions,
    *,
    image_size: Annotated[
        int | None,
        typer.Option(
            min=320,
            metavar="N",
            rich_help_panel=RECONSTRUCTION,
            help="Longest side of images for feature detection, in pixels.",
        ),
    ] = None,
    stereo_size: Annotated[
        int | None,
        typer.Option(
            min=320,
            metavar="N",
            rich_help_panel=RECONSTRUCTION,
            help="Longest side of images for dense stereo, in pixels.",
        ),
    ] = None,
    workers: options.Workers = None,
    common: PrepareOptions,
) -> None:
    """Reconstruct an area from overlapping photographs.

    The steps are cameras, dense stereo, a Poisson mesh, and rasters as with `mesh`.
    """
    photos_options = replace(
        photos_options,
        sfm=sfm.Options(**_given(image_size=image_size)),
        stereo=mvs_cpu.Options(**_given(size=stereo_size)),
        **_given(patchmatch_size=stereo_size),
    )
    options = rasters.of(ground="filter")
    _run(
        output,
        lambda: from_photos.prepare_photos(
            images, output, common, photos_options, options, _executor(workers), _log
        ),
    )
