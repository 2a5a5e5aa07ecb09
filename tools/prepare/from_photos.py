"""``flexroad prepare``: rasters from overlapping photographs, via a mesh as in the paper.

GNSS tags -> poses and sparse points -> dense cloud -> Poisson mesh -> rasters as from other meshes.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flexroad.catalog.lazy import lazy
from flexroad.catalog.scan.inputs import files_of
from flexroad.catalog.text import some
from flexroad.pipeline.config.options import PHOTOS, option
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.tasks import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.prepare.from_mesh import MeshOptions, publish_mesh
from flexroad.tools.prepare.options import PrepareOptions, written
from flexroad.tools.prepare.output import disk_errors, on_failure, scratch_folder
from flexroad.tools.prepare.photos import mvs_cpu, sfm, surface
from flexroad.tools.prepare.photos.exif import PlacedPhotos, place_photos, read_control, read_shot
from flexroad.tools.prepare.photos.mvs_cpu import Cloud
from flexroad.tools.prepare.photos.sfm import Reconstruction, View
from flexroad.tools.prepare.points import to_rasters
from flexroad.tools.prepare.raster_writer import PreparedDataset
from flexroad.tools.prepare.roads import check_roads

cv2 = lazy("cv2")

ON_GPU, ON_CPU = "PatchMatch on the GPU", "semi-global matching on the CPU, as pycolmap has no GPU"
PIXELS_PER_CELL = 4
"""Width of the smallest useful cell, in pixels of the depth maps."""
POINTS_PER_CELL = 5
"""Points sampled on the mesh along the edge of a cell."""
MERGED_AT_ONCE = 5_000_000
"""Number of unmerged points held in memory before they are merged."""


@dataclass(frozen=True)
class PhotosOptions:
    """Options of photographs only."""

    control: Path | None = option(
        None, PHOTOS, "Ground control, CSV: image,x_px,y_px,easting,northing,height.", "FILE"
    )
    """The column ``name`` is optional."""
    control_crs: str | None = None
    """CRS of the control; None: the CRS of the rasters."""
    sfm: sfm.Options = field(default_factory=sfm.Options)
    stereo: mvs_cpu.Options = field(default_factory=mvs_cpu.Options)
    """Dense stereo on the CPU."""
    patchmatch_size: int = 2000
    """Dense stereo on a GPU: photographs are reduced to this width or height (pixels)."""
    refine: bool = True
    """Whether the DTM is refined by ECSRC, as in the paper."""


@dataclass(frozen=True, eq=False)
class _DepthJob:
    """The input of one worker call: a photograph to match with its partners."""

    view: View
    others: tuple[View, ...]
    points: Floats
    """Sparse points visible in the photograph, ``(n, 3)``, m."""
    options: mvs_cpu.Options
    spacing_m: float
    """Spacing of the resulting points (m)."""
    target: Path
    """Output file with the cloud, ``.npz``."""


def prepare_photos(
    images: Sequence[Path],
    out: Path,
    common: PrepareOptions,
    photos_options: PhotosOptions,
    options: to_rasters.Options,
    executor: Executor,
    log: Callable[[str], None],
) -> PreparedDataset:
    """Make the rasters and the catalog of an area from overlapping photographs with GNSS tags.

    - `images`: photographs, or folders of them.
    - `common`: options shared by all commands. Cells that are too small for the stereo are enlarged, with a
      note.
    """
    check_roads(common)
    sfm.colmap()
    files = files_of(images, "photos")
    if strange := [file for file in files if not file.is_file()]:
        raise ConfigError(f"{strange[0]} is not a file; leave it out")
    placed = place_photos([read_shot(path) for path in files], common.to_crs)
    control = photos_options.control and read_control(
        photos_options.control, placed, photos_options.control_crs
    )
    with scratch_folder(out) as work:
        log(f"matching {len(placed.shots)} photographs ({_cameras(placed)})")
        reconstruction = sfm.reconstruct(placed, work, photos_options.sfm, control or None)
        notes = _notes(reconstruction, placed, control is not None)
        gpu = surface.has_gpu()
        pixel = mvs_cpu.ground_pixel_m(
            reconstruction, photos_options.patchmatch_size if gpu else photos_options.stereo.size
        )
        method = f"dense stereo: {ON_GPU if gpu else ON_CPU}, {pixel:.3f} m per pixel"
        common, coarser = _coarsened(common, pixel)
        notes += (method, *coarser)
        for note in notes:
            log(note)
        spacing = max(2 * pixel, min(common.cell_m, common.dop_cell_m) / 3)
        if gpu:
            cloud = surface.patchmatch(reconstruction, work, photos_options.patchmatch_size)
            cloud = mvs_cpu.merge([cloud], spacing)
        else:
            cloud = _stereo(reconstruction, work, photos_options.stereo, spacing, executor, log)
        log(f"Poisson surface of {len(cloud):,} points")
        with disk_errors(out):
            mesh = surface.poisson(
                cloud, spacing, reconstruction.crs, reconstruction.origin, work, photos_options.sfm.threads
            )
        name = f"{len(reconstruction.views)} photographs ({_cameras(placed)})"
        source = f"{name}; heights {placed.heights}, uncorrected; {method}; Poisson mesh"
        common = replace(common, to_crs=reconstruction.crs, height_unit=None, dataset=common.dataset or name)
        common = replace(common, date=common.date or _date(placed), assumed_date=written(files))
        mesh_options = MeshOptions(
            density=(POINTS_PER_CELL / common.cell_m) ** 2, refine=photos_options.refine
        )
        published = publish_mesh(mesh, source, out, common, mesh_options, options, executor, log)
    return published.with_notes(*notes)


def _cameras(placed: PlacedPhotos) -> str:
    return ", ".join(sorted({shot.camera or "unknown camera" for shot in placed.shots}))


def _date(placed: PlacedPhotos) -> datetime | None:
    taken = [shot.taken.timestamp() for shot in placed.shots if shot.taken]
    return datetime.fromtimestamp(statistics.median_low(taken), UTC) if taken else None


def _coarsened(common: PrepareOptions, pixel_m: float) -> tuple[PrepareOptions, tuple[str, ...]]:
    """Return the options with cells not smaller than stereo resolves, and a note if they were changed."""
    finest = PIXELS_PER_CELL * pixel_m
    if min(common.cell_m, common.dop_cell_m) >= finest:
        return common, ()
    cell, dop = (m if m >= finest else _round_up(finest) for m in (common.cell_m, common.dop_cell_m))
    small, large = sorted((cell, dop))
    # Cell and pixel must stay multiples of each other.
    large = math.ceil(large / small - 1e-9) * small
    cell, dop = (small, large) if cell <= dop else (large, small)
    note = (
        f"cells of {cell:g} m and pixels of {dop:g} m, not {common.cell_m:g} m and {common.dop_cell_m:g} m: "
        f"dense stereo had {pixel_m:.3f} m per pixel; for smaller cells, use a larger --stereo-size"
    )
    return replace(common, cell_m=cell, dop_cell_m=dop), (note,)


def _round_up(metres: float) -> float:
    """Round up to the next of 0.01, 0.02, 0.05, 0.1 ... m."""
    power = 10.0 ** math.floor(math.log10(metres))
    return round(next(step for step in (1, 2, 5, 10) if step * power >= metres * (1 - 1e-9)) * power, 9)


def _notes(result: Reconstruction, placed: PlacedPhotos, has_control: bool) -> tuple[str, ...]:
    (plan, height), accuracy = result.gnss_m, placed.accuracy.max(axis=0)
    notes = [
        f"{len(result.views)} of {len(placed.shots)} photographs placed, mean reprojection error "
        f"{result.reprojection_px:.2f} px; cameras {plan:.2f} m in plan and {height:.2f} m in height from "
        f"their GNSS positions (medians), whose accuracy is {accuracy[0]:g} and {accuracy[2]:g} m",
        f"heights are {placed.heights}, as written by the cameras; they are not corrected",
    ]
    if result.missing:
        notes.append(f"not placed: {some([path.name for path in result.missing])}; too little overlap")
    if result.control_m is not None:
        east, north, up = np.abs(result.control_m).max(axis=0)
        notes.append(
            f"{len(result.control_m)} control points: largest residuals {east:.2f}, {north:.2f}, {up:.2f} m"
        )
    elif has_control:
        notes.append("control points not used: fewer than 3 are marked in at least 2 placed photographs")
    if result.focal_held:
        focal = result.views[0].camera.focal_px
        notes.append(
            f"focal length held at {focal:.0f} px, as in the files: these photographs "
            "do not determine it better. An error of the focal length scales heights, one of the distortion "
            "bends them: use ground control (--control)"
        )
    return tuple(notes)


def _stereo(
    reconstruction: Reconstruction,
    work: Path,
    options: mvs_cpu.Options,
    spacing: float,
    executor: Executor,
    log: Callable[[str], None],
) -> Cloud:
    """Match every photograph with its partners and merge the clouds in the order of the photographs."""
    folder = work / "depths"
    with disk_errors(work.parent):
        folder.mkdir()
    jobs = list(_jobs(reconstruction, folder, options, spacing))
    fail = on_failure(lambda job: job.view.path, "use fewer workers or a smaller --stereo-size")
    for number, _ in enumerate(executor.map(_match, jobs, fail), 1):
        log(f"matched {number} of {len(jobs)} photographs pixel by pixel")
    merged: list[Cloud] = []
    for job in jobs:
        with np.load(job.target) as arrays:
            merged.append(Cloud(arrays["points"], arrays["normals"], arrays["colours"]))
        if sum(map(len, merged[1:])) > MERGED_AT_ONCE:
            merged = [mvs_cpu.merge(merged, spacing)]
    if not sum(map(len, merged)):
        raise TaskError(
            "dense stereo gave no point that three photographs agree on; use photographs that overlap by "
            "60 % or more"
        )
    return mvs_cpu.merge(merged, spacing)


def _jobs(
    result: Reconstruction, folder: Path, options: mvs_cpu.Options, spacing: float
) -> Iterator[_DepthJob]:
    for number, view in enumerate(result.views):
        others = tuple(result.views[other] for other in mvs_cpu.partners(result, number, options))
        if len(others) >= 2:
            sparse = result.points[view.visible]
            yield _DepthJob(view, others, sparse, options, spacing, folder / f"{number}.npz")


def _match(job: _DepthJob) -> Path:
    # Photographs are matched in parallel, one thread each; OpenCV does not read the environment.
    cv2.setNumThreads(1)
    cloud = mvs_cpu.photo_cloud(job.view, job.others, job.points, job.options)
    if len(cloud):
        cloud = mvs_cpu.merge([cloud], job.spacing_m)
    with disk_errors(job.target.parent.parent.parent):
        np.savez(job.target, points=cloud.points, normals=cloud.normals, colours=cloud.colours)
    return job.target
