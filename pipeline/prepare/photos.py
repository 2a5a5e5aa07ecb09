"""``prepare photos``: the rasters of a place from overlapping photographs, by way of a mesh, as in the paper.

GNSS tags -> poses and sparse points -> dense cloud -> Poisson mesh -> as any other mesh.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flexroad.catalog.headers.rasters import some
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.mesh import MeshAsked, publish_mesh
from flexroad.pipeline.prepare.sheet import Published
from flexroad.pipeline.prepare.spool import room, scratch
from flexroad.tasks import TaskError
from flexroad.tasks.acquire.photos import mvs_cpu, mvs_gpu, sfm
from flexroad.tasks.acquire.photos.exif import Placed, place, read_control, read_shot
from flexroad.tasks.acquire.photos.mvs_cpu import Cloud
from flexroad.tasks.acquire.photos.poisson import poisson
from flexroad.tasks.acquire.photos.sfm import Reconstruction, View
from flexroad.tasks.acquire.points import to_rasters
from flexroad.tasks.types import Floats

SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".png")
ON_GPU, ON_CPU = "PatchMatch on the GPU", "semi-global matching on the CPU, as this pycolmap has no CUDA"
PIXELS_PER_CELL = 4
"""Pixels of the depth maps across the finest cell that makes sense."""
POINTS_PER_CELL = 5
"""Points of the mesh along a cell's edge."""
MERGED_AT_ONCE = 5_000_000
"""Points of the photographs' clouds held beside the merged one."""


@dataclass(frozen=True)
class PhotosAsked:
    """The options of ``prepare photos`` alone."""

    control: Path | None = None
    """Ground control points, CSV: image, x_px, y_px, easting, northing, height and perhaps name."""
    control_crs: str | None = None
    """CRS of the control points; that of the rasters by default."""
    sfm: sfm.Options = field(default_factory=sfm.Options)
    stereo: mvs_cpu.Options = field(default_factory=mvs_cpu.Options)
    """On the CPU."""
    patchmatch: mvs_gpu.Options = field(default_factory=mvs_gpu.Options)
    """On a GPU."""
    refine: bool = True
    """Whether the DTM is refined by ECSRC, as in the paper."""


@dataclass(frozen=True, eq=False)
class DepthJob:
    """One photograph to match with its partners."""

    view: View
    others: tuple[View, ...]
    points: Floats
    options: mvs_cpu.Options
    spacing_m: float
    target: Path
    """Where the cloud goes, ``.npz``."""


def prepare_photos(
    images: Sequence[Path],
    out: Path,
    asked: Asked,
    photos_asked: PhotosAsked,
    options: to_rasters.Options,
    executor: Executor,
    say: Callable[[str], None],
) -> Published:
    """Make rasters and catalog of a place from overlapping photographs with GNSS tags.

    Parameters
    ----------
    images : Sequence of Path
        Photographs, or folders of them.
    out : Path
        Folder to publish in.
    asked, photos_asked : Asked, PhotosAsked
        What the user wants. Cells finer than the stereo resolves are made coarser, which is said.
    options : to_rasters.Options
        How points become rasters.
    executor : Executor
        Where photographs and blocks are worked on.
    say : callable
        Told what is going on.

    Raises
    ------
    TaskError, CatalogError, ConfigError
        If pycolmap is missing, a photograph has no position, or they do not match; nothing is left behind.
    """
    sfm.colmap()
    placed = place([read_shot(path) for path in _files(images)], asked.to_crs)
    control = photos_asked.control and read_control(photos_asked.control, placed, photos_asked.control_crs)
    with scratch(out) as work:
        say(f"matching {len(placed.shots)} photographs ({_cameras(placed)})")
        found = sfm.reconstruct(placed, work, photos_asked.sfm, control or None)
        notes = _notes(found, placed, control is not None)
        gpu = mvs_gpu.available()
        pixel = mvs_cpu.ground_pixel_m(
            found, photos_asked.patchmatch.size if gpu else photos_asked.stereo.size
        )
        how = f"dense stereo: {ON_GPU if gpu else ON_CPU}, {pixel:.3f} m per pixel"
        asked, coarser = _resolved(asked, pixel)
        notes += (how, *coarser)
        for note in notes:
            say(note)
        spacing = max(2 * pixel, min(asked.cell_m, asked.dop_cell_m) / 3)
        if gpu:
            cloud = mvs_cpu.merge([mvs_gpu.patchmatch(found, work, photos_asked.patchmatch)], spacing)
        else:
            cloud = _stereo(found, work, photos_asked.stereo, spacing, executor, say)
        say(f"Poisson surface of {len(cloud):,} points")
        with room(out):
            mesh = poisson(cloud, spacing, found.crs, found.origin, work, photos_asked.sfm.threads)
        name = f"{len(found.views)} photographs ({_cameras(placed)})"
        source = f"{name}; heights {placed.heights}, uncorrected; {how}; Poisson mesh"
        asked = replace(asked, to_crs=found.crs, height_unit=None, dataset=asked.dataset or name)
        asked = replace(asked, date=asked.date or _date(placed))
        mesh_asked = MeshAsked(density=(POINTS_PER_CELL / asked.cell_m) ** 2, refine=photos_asked.refine)
        published = publish_mesh(mesh, source, out, asked, mesh_asked, options, executor, say)
    return published.noting(*notes)


def _files(images: Iterable[Path]) -> list[Path]:
    found: dict[Path, None] = {}
    for path in images:
        if not path.exists():
            raise ConfigError(f"{path} is no file or folder")
        inside = (
            sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
        )
        if not inside:
            raise ConfigError(f"{path} has no photographs ({', '.join(SUFFIXES)})")
        found.update(dict.fromkeys(inside))
    return list(found)


def _cameras(placed: Placed) -> str:
    return ", ".join(sorted({shot.camera or "unknown camera" for shot in placed.shots}))


def _date(placed: Placed) -> datetime | None:
    taken = [shot.taken.timestamp() for shot in placed.shots if shot.taken]
    return datetime.fromtimestamp(statistics.median_low(taken), UTC) if taken else None


def _resolved(asked: Asked, pixel_m: float) -> tuple[Asked, tuple[str, ...]]:
    """Return what is asked with cells no finer than the stereo resolves, and what was changed."""
    finest = PIXELS_PER_CELL * pixel_m
    if min(asked.cell_m, asked.dop_cell_m) >= finest:
        return asked, ()
    cell, dop = (m if m >= finest else _round_up(finest) for m in (asked.cell_m, asked.dop_cell_m))
    small, large = sorted((cell, dop))
    # Cells and pixels stay whole numbers of each other.
    large = math.ceil(large / small - 1e-9) * small
    cell, dop = (small, large) if cell <= dop else (large, small)
    note = (
        f"cells of {cell:g} m and pixels of {dop:g} m, not {asked.cell_m:g} m and {asked.dop_cell_m:g} m: "
        f"dense stereo had {pixel_m:.3f} m per pixel; reduce the photographs less: --dense-size"
    )
    return replace(asked, cell_m=cell, dop_cell_m=dop), (note,)


def _round_up(metres: float) -> float:
    """Return the next of 0.01, 0.02, 0.05, 0.1 ... m."""
    power = 10.0 ** math.floor(math.log10(metres))
    return round(next(step for step in (1, 2, 5, 10) if step * power >= metres * (1 - 1e-9)) * power, 9)


def _notes(found: Reconstruction, placed: Placed, wanted_control: bool) -> tuple[str, ...]:
    (plan, height), good = found.gnss_m, placed.accuracy.max(axis=0)
    notes = [
        f"{len(found.views)} of {len(placed.shots)} photographs placed, mean reprojection error "
        f"{found.reprojection_px:.2f} px; cameras {plan:.2f} m in plan and {height:.2f} m in height from "
        f"their GNSS (medians), which is good to {good[0]:g} and {good[2]:g} m",
        f"heights are {placed.heights}, as the cameras say; nothing is corrected",
    ]
    if found.missing:
        notes.append(f"not placed: {some([path.name for path in found.missing])}; they overlap too little")
    if found.control_m is not None:
        east, north, up = np.abs(found.control_m).max(axis=0)
        notes.append(
            f"{len(found.control_m)} control points: largest residuals {east:.2f}, {north:.2f}, {up:.2f} m"
        )
    elif wanted_control:
        notes.append("control points not used: fewer than 3 are marked in 2 placed photographs")
    if found.focal_held:
        focal = found.views[0].camera.focal_px
        notes.append(
            f"focal length held at {focal:.0f} px, as the files say: these photographs "
            "do not tell it better. Its error stretches heights, the lens's bends them: give --control points"
        )
    return tuple(notes)


def _stereo(
    found: Reconstruction,
    work: Path,
    options: mvs_cpu.Options,
    spacing: float,
    executor: Executor,
    say: Callable[[str], None],
) -> Cloud:
    """Match every photograph with its partners and merge what they show, in the photographs' order."""
    folder = work / "depths"
    with room(work.parent):
        folder.mkdir()
    jobs = list(_jobs(found, folder, options, spacing))
    for number, _ in enumerate(executor.map(_match, jobs, _lost), 1):
        say(f"matched {number} of {len(jobs)} photographs pixel by pixel")
    merged: list[Cloud] = []
    for job in jobs:
        with np.load(job.target) as made:
            merged.append(Cloud(made["points"], made["normals"], made["colours"]))
        if sum(map(len, merged[1:])) > MERGED_AT_ONCE:
            merged = [mvs_cpu.merge(merged, spacing)]
    if not sum(map(len, merged)):
        raise TaskError(
            "dense stereo found nothing that three photographs share; take some that overlap by 60 % and more"
        )
    return mvs_cpu.merge(merged, spacing)


def _jobs(
    found: Reconstruction, folder: Path, options: mvs_cpu.Options, spacing: float
) -> Iterator[DepthJob]:
    for number, view in enumerate(found.views):
        others = tuple(found.views[other] for other in mvs_cpu.partners(found, number, options))
        if len(others) >= 2:
            sparse = found.points[view.seen]
            yield DepthJob(view, others, sparse, options, spacing, folder / f"{number}.npz")


def _match(job: DepthJob) -> Path:
    import cv2

    # Photographs run side by side, one thread each; OpenCV does not read the environment.
    cv2.setNumThreads(1)
    cloud = mvs_cpu.photo_cloud(job.view, job.others, job.points, job.options)
    if len(cloud):
        cloud = mvs_cpu.merge([cloud], job.spacing_m)
    with room(job.target.parent.parent.parent):
        np.savez(job.target, points=cloud.points, normals=cloud.normals, colours=cloud.colours)
    return job.target


def _lost(job: DepthJob, why: str) -> Path:
    raise ConfigError(f"{job.view.path}: {why}; take fewer workers or a smaller --dense-size")
