"""``flexroad prepare``: make rasters and a catalog from points, meshes and photographs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from flexroad.catalog.scan.inputs import TITLES, recognised
from flexroad.catalog.storage.outputs import made_folder
from flexroad.catalog.storage.paths import check_writable
from flexroad.catalog.text import count
from flexroad.pipeline.cli import options
from flexroad.pipeline.cli.catalogs import after_catalog
from flexroad.pipeline.cli.command import Command, group
from flexroad.pipeline.cli.signals import INTERRUPTED
from flexroad.pipeline.cli.stdio import echo
from flexroad.pipeline.config.options import MESH, PHOTOS, POINTS, RASTERS, option
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import DaskExecutor, SerialExecutor
from flexroad.pipeline.run.lock import run_lock
from flexroad.tasks.errors import TaskError
from flexroad.tools.prepare import from_mesh, from_odm, from_photos, from_points
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.output import check_replaced, disk_errors
from flexroad.tools.prepare.photos import mvs_cpu, sfm
from flexroad.tools.prepare.points import ground_filter, morphological
from flexroad.tools.prepare.points.to_rasters import Options

app = group()

NOT_OF_PHOTOS = ("crs", "height_unit")
"""Options that photographs do not have: their tags give both."""


@dataclass(frozen=True)
class _Options:
    """Options of ground filters, and the sizes of photographs; None keeps the default of the method."""

    ground: Literal["auto", "classes", "filter", "morphological"] = option(
        "auto", POINTS, "How ground is identified; auto: by classes if all files have them, else by filter."
    )
    ground_class: list[int] | None = option(None, POINTS, "Classes of ground; default: 2.", "N")
    bridge_class: list[int] | None = option(
        None, POINTS, "Classes of bridge decks; default: 17; 26 in the Dutch AHN.", "N"
    )
    slope: float | None = option(
        None,
        RASTERS,
        "Ground filter: steepest slope of the ground; 0.35 is 35 %, the slope filter's default.",
        "NUMBER",
        min=0,
    )
    radius_m: float | None = option(
        None, RASTERS, "Ground filter: search radius in m, half the widest roof.", "METRES", min=1
    )
    image_size: int | None = option(
        None, PHOTOS, "Longest side of images for feature detection, in pixels.", "N", min=320
    )
    stereo_size: int | None = option(
        None, PHOTOS, "Longest side of images for dense stereo, in pixels.", "N", min=320
    )

    def of_rasters(self) -> Options:
        """Return the options for making rasters."""
        given = _given(slope=self.slope, radius_m=self.radius_m)
        classes = _given(ground_classes=self.ground_class, bridge_classes=self.bridge_class)
        if self.ground == "morphological":
            return Options(ground="morphological", morphological=morphological.Options(**given), **classes)
        return Options(ground="filter", filter=ground_filter.Options(**given), **classes)

    def of_photos(self, photos: from_photos.PhotosOptions) -> from_photos.PhotosOptions:
        """Return the options of photographs with the given sizes."""
        return replace(
            photos,
            sfm=sfm.Options(**_given(image_size=self.image_size)),
            stereo=mvs_cpu.Options(**_given(size=self.stereo_size)),
            **_given(patchmatch_size=self.stereo_size),
        )


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None; the others keep the defaults of their models."""
    return {name: value for name, value in options.items() if value is not None}


def _log(line: str) -> None:
    echo(line, err=True)


@contextlib.contextmanager
def _making(out: Path) -> Iterator[None]:
    """Make the output folder and hold its lock; a failure or an interruption leaves no files behind."""
    check_replaced(out)
    try:
        with contextlib.ExitStack() as stack:
            with disk_errors(out):
                stack.enter_context(made_folder(out))
                check_writable(out)
            stack.enter_context(run_lock(out, lambda line: _log(f"note: {line}")))
            yield
    except TaskError as error:
        raise ConfigError(str(error)) from error
    except KeyboardInterrupt:
        echo("interrupted; nothing was written", err=True)
        raise typer.Exit(INTERRUPTED) from None


def _check_options(ctx: typer.Context, kind: str, source: Path) -> None:
    """Refuse options that are for another kind of input."""
    for param in ctx.command.params:
        heading = getattr(param, "rich_help_panel", None)
        is_other = heading in (POINTS, MESH, PHOTOS) and heading.lower() != kind
        if is_other or (kind == "photos" and param.name in NOT_OF_PHOTOS):
            given = ctx.get_parameter_source(param.name)
            if given is not None and given.name != "DEFAULT":
                raise ConfigError(f"{param.opts[0]} has no effect on {TITLES[kind]} ({source}); leave it out")


@app.command(cls=Command)
@options.with_options
def prepare(
    ctx: typer.Context,
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUT",
            help="LAS, LAZ or COPC files; OBJ, PLY or glTF with textures or coloured vertices; overlapping "
            "photographs with GNSS tags; folders of them; or a project folder of OpenDroneMap.",
        ),
    ],
    output: options.OutputFolder,
    *,
    chosen: _Options,
    mesh_options: from_mesh.MeshOptions,
    photos_options: from_photos.PhotosOptions,
    workers: options.Workers = None,
    common: PrepareOptions,
) -> None:
    """Make rasters and a catalog from points, meshes or photographs.

    Points are sampled on a mesh. A mesh is reconstructed from photographs. From an OpenDroneMap project its
    rasters are taken, else its textured mesh, else its points.
    """
    kind, paths = recognised(inputs)
    if kind == "odm":
        kind, paths = from_odm.found(paths[0])
    _check_options(ctx, kind, paths[0])
    rasters = chosen.of_rasters()
    executor = SerialExecutor() if workers == 1 else DaskExecutor(workers)
    with _making(output):
        if kind == "odm":
            dataset = from_odm.prepare_odm(paths[0], output, common, rasters, _log)
        elif kind == "mesh":
            dataset = from_mesh.prepare_mesh(paths[0], output, common, mesh_options, rasters, executor, _log)
        elif kind == "points":
            dataset = from_points.prepare_points(
                paths, output, common, rasters, executor, _log, chosen.ground
            )
        else:
            sizes = chosen.of_photos(photos_options)
            dataset = from_photos.prepare_photos(paths, output, common, sizes, rasters, executor, _log)
    for note in dataset.notes:
        _log(f"note: {note}")
    echo(f"{count(dataset.tiles, 'tile')} in {dataset.catalog}")
    echo(after_catalog(dataset.catalog))
