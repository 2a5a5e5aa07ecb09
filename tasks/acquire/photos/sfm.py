"""Structure from motion, georeferenced by the cameras' GNSS: photographs -> poses and sparse points.

The paper's stage A leaves this to photogrammetry; here it is COLMAP (Schönberger & Frahm, 2016) by its
Python binding: SIFT, matching among GNSS neighbours, incremental mapping with the positions as priors in the
bundle adjustment.
All of it lives in a local frame, whole metres off the metric CRS, so that float32 files lose nothing.

Photographs that look straight down on flat ground tell nothing of the focal length: a longer one with the
ground further below explains them as well, and stretches every height by the same factor. So the files' focal
length is held unless freeing it makes the photographs fit clearly better.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.acquire.photos.exif import Control, Placed, Shot
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats

EXHAUSTIVE = 12
"""Up to so many photographs every pair is matched."""
CLEARLY_BETTER = 0.95
"""A freed focal length is taken if the reprojection error falls below this share of that with the held one.
Less is what a rolling shutter or a simple lens model can feign."""
INSTALL = "pip install 'flexroad[photogrammetry]'"


class Options(base.Options):
    """How photographs are matched and adjusted."""

    image_size: int = Field(
        2400, ge=320, description="features are sought in photographs of at most this width or height (px)"
    )
    features: int = Field(8192, ge=500, description="most features of one photograph")
    neighbours: int = Field(12, ge=2, description="each photograph is matched with so many nearest ones")
    calibrate: Literal["auto", "held", "free"] = Field(
        "auto",
        description="focal length: held as the files say, free, or free only where that fits clearly better",
    )
    seed: int = Field(1, ge=0, description="of all random choices")
    threads: int | None = Field(None, ge=1, description="null: all cores")


@dataclass(frozen=True)
class Camera:
    """A lens and sensor, in COLMAP's words."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    """Focal length, principal point, distortion; pixel centres lie at .5."""

    @property
    def focal_px(self) -> float:
        """Focal length (pixels)."""
        return self.params[0]


@dataclass(frozen=True, eq=False)
class View:
    """A photograph whose pose is known."""

    path: Path
    camera: Camera
    rotation: Floats
    """World to camera, ``(3, 3)``; the camera looks along its z, rows grow along its y."""
    centre: Floats
    """Where it was taken, ``(3,)``, m from the origin."""
    seen: NDArray[np.intp]
    """Indices of the sparse points it shows."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Poses and sparse points."""

    crs: str
    origin: Floats
    """Whole-metre easting, northing, height everything is relative to, ``(3,)``."""
    views: tuple[View, ...]
    missing: tuple[Path, ...]
    """Photographs that could not be placed."""
    points: Floats
    """Sparse points, ``(n, 3)``, m from the origin."""
    reprojection_px: float
    """Mean distance of the features from their points' images, in pixels of the whole photographs."""
    residuals: Floats
    """Adjusted minus measured camera positions, ``(len(views), 3)``, m."""
    control_m: Floats | None
    """Adjusted minus given ground control points, ``(n, 3)``, m; None if GNSS alone made the georeference."""
    focal_held: bool
    """Whether the focal length is the files' own."""
    model: Path
    """Folder of the model in COLMAP's format, in the local frame."""
    root: Path
    """Folder the model's names of photographs are relative to."""

    @property
    def gnss_m(self) -> tuple[float, float]:
        """Median distance of the cameras from their GNSS positions in plan and height (m)."""
        plan = np.hypot(self.residuals[:, 0], self.residuals[:, 1])
        return float(np.median(plan)), float(np.median(np.abs(self.residuals[:, 2])))


def colmap() -> ModuleType:
    """Return pycolmap, an optional extra, made quiet.

    Raises
    ------
    TaskError
        If it is not installed; the line says how to.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise TaskError(f"photographs need pycolmap ({error}): {INSTALL}") from error
    # Its progress is hundreds of lines, and what it calls errors are raised here in words of our own.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    return pycolmap  # type: ignore[no-any-return]


def reconstruct(
    placed: Placed, work: Path, options: Options, control: Control | None = None
) -> Reconstruction:
    """Place photographs in space by what they show and where they were taken.

    Parameters
    ----------
    placed : Placed
        The photographs and their GNSS positions.
    work : Path
        Empty folder for the database and the model.
    options : Options
        Sizes, numbers and the seed. The same seed and number of threads give the same result up to rounding.
    control : Control, optional
        Ground control points. With 3 or more of them seen in 2 placed photographs each, they alone make the
        georeference; GNSS then only guides the matching.

    Raises
    ------
    TaskError
        If pycolmap is missing, no photographs match, or fewer than 3 or than half of them can be placed.
    """
    pycolmap = colmap()
    pycolmap.set_random_seed(options.seed)
    origin = np.floor(placed.positions.min(axis=0))
    root = Path(os.path.commonpath([shot.path.resolve().parent for shot in placed.shots]))
    shots = {shot.path.resolve().relative_to(root).as_posix(): shot for shot in placed.shots}
    database = work / "database.db"
    _features(pycolmap, database, root, shots, options)
    _priors(pycolmap, database, dict(zip(shots, placed.positions - origin, strict=True)), placed)
    _match(pycolmap, database, len(shots), options)
    told = all(shot.focal_px for shot in placed.shots)
    model, held = _map(pycolmap, database, root, work, options, told)
    _enough(model, shots, options)
    controlled = None if control is None else _control(pycolmap, model, shots, control, origin)
    folder = work / "model"
    folder.mkdir()
    model.write(folder)
    return _result(model, (folder, root), placed, shots, origin, controlled, held and controlled is None)


def _features(
    pycolmap: ModuleType, database: Path, root: Path, shots: Mapping[str, Shot], options: Options
) -> None:
    cameras: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for name, shot in shots.items():
        cameras[shot.camera, shot.width, shot.height, shot.focal_px].append(name)
    extraction = pycolmap.FeatureExtractionOptions(
        max_image_size=options.image_size, num_threads=options.threads or -1, use_gpu=pycolmap.has_cuda
    )
    extraction.sift.max_num_features = options.features
    for (_, width, height, focal), names in cameras.items():
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if focal:
            reader.camera_params = f"{focal},{width / 2},{height / 2},0"
        pycolmap.extract_features(
            database,
            root,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=extraction,
        )


def _priors(pycolmap: ModuleType, database: Path, local: Mapping[str, Floats], placed: Placed) -> None:
    accuracy = dict(zip(local, placed.accuracy, strict=True))
    with pycolmap.Database.open(database) as opened:
        # Those of EXIF, in degrees, that the extraction wrote.
        opened.clear_pose_priors()
        for image in opened.read_all_images():
            opened.write_pose_prior(
                pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=local[image.name].reshape(3, 1),
                    position_covariance=np.diag(accuracy[image.name] ** 2),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
            )


def _match(pycolmap: ModuleType, database: Path, count: int, options: Options) -> None:
    matching = pycolmap.FeatureMatchingOptions(num_threads=options.threads or -1, use_gpu=pycolmap.has_cuda)
    verifying = pycolmap.TwoViewGeometryOptions()
    verifying.ransac.random_seed = options.seed
    common = {"matching_options": matching, "verification_options": verifying}
    if count <= EXHAUSTIVE:
        pycolmap.match_exhaustive(database, **common)
    else:
        # The number of neighbours is the limit, not a distance: flying heights differ.
        pairing = pycolmap.SpatialPairingOptions(
            max_num_neighbors=options.neighbours, max_distance=1e6, ignore_z=True
        )
        pycolmap.match_spatial(database, pairing_options=pairing, **common)
    with pycolmap.Database.open(database) as opened:
        if not opened.num_inlier_matches():
            raise TaskError(
                f"none of the {count} photographs match each other; do they show one place? {_more(options)}"
            )


def _map(
    pycolmap: ModuleType, database: Path, root: Path, work: Path, options: Options, told: bool
) -> tuple[Any, bool]:
    """Return the largest model and whether the focal length was held in it."""
    held = told and options.calibrate != "free"
    models = {}
    for hold in [True] * held + [False] * (not held or options.calibrate == "auto"):
        folder = work / f"mapped-{'held' if hold else 'free'}"
        folder.mkdir()
        found = pycolmap.incremental_mapping(database, root, folder, _mapping(pycolmap, options, hold))
        if found:
            models[hold] = max(found.values(), key=lambda model: model.num_reg_images())
    if not models:
        raise TaskError(f"the photographs match too little to place any of them: {_more(options)}")
    if len(models) == 1:
        return next((model, hold) for hold, model in models.items())
    free = models[False].num_reg_images(), -models[False].compute_mean_reprojection_error()
    rigid = models[True].num_reg_images(), -models[True].compute_mean_reprojection_error() * CLEARLY_BETTER
    return (models[False], False) if free > rigid else (models[True], True)


def _mapping(pycolmap: ModuleType, options: Options, hold: bool) -> Any:
    mapping = pycolmap.IncrementalPipelineOptions(
        use_prior_position=True,
        ba_refine_focal_length=not hold,
        extract_colors=False,
        min_model_size=3,
        random_seed=options.seed,
        num_threads=options.threads or -1,
    )
    mapping.mapper.abs_pose_refine_focal_length = not hold
    mapping.mapper.random_seed = options.seed
    mapping.triangulation.random_seed = options.seed
    return mapping


def _more(options: Options) -> str:
    return (
        "take photographs that overlap by 60 % and more, "
        f"or look for features in larger ones: --image-size {2 * options.image_size}"
    )


def _enough(model: Any, shots: Mapping[str, Shot], options: Options) -> None:
    placed = {image.name for image in model.images.values() if image.has_pose}
    lacking = [shot.path.name for name, shot in shots.items() if name not in placed]
    if len(placed) >= max(3, len(shots) / 2):
        return
    names = ", ".join(lacking[:5]) + (" and others" if len(lacking) > 5 else "")
    raise TaskError(
        f"{len(placed)} of {len(shots)} photographs could be placed, not {names}: {_more(options)}"
    )


def _control(
    pycolmap: ModuleType, model: Any, shots: Mapping[str, Shot], control: Control, origin: Floats
) -> Floats | None:
    """Move the model onto the control points, adjust it with them held, return what is left, ``(n, 3)``.

    None, and the model unchanged, if fewer than 3 points are seen twice.
    """
    of_path = {shots[image.name].path: image for image in model.images.values() if image.has_pose}
    used, marks = [], []
    for point, seen in zip(control.points - origin, control.marks, strict=True):
        rays = [(of_path[path], np.array(pixel)) for path, pixel in seen.items() if path in of_path]
        if len(rays) >= 2:
            used.append(point)
            marks.append(rays)
    given = np.array(used).reshape(-1, 3)
    if len(given) < 3:
        return None
    found = np.array([_intersect(rays) for rays in marks])
    model.transform(pycolmap.estimate_sim3d(found, given))
    config = pycolmap.BundleAdjustmentConfig()
    for image in of_path.values():
        config.add_image(image.image_id)
    for point, rays in zip(given, marks, strict=True):
        config.add_constant_point(_add(pycolmap, model, point, rays))
    pycolmap.create_default_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(print_summary=False), config, model
    ).solve()
    left: Floats = np.array([_intersect(rays) for rays in marks]) - given
    return left


def _add(pycolmap: ModuleType, model: Any, point: Floats, rays: Sequence[tuple[Any, Floats]]) -> int:
    track = pycolmap.Track()
    for image, pixel in rays:
        image.points2D.append(pycolmap.Point2D(pixel))
        track.add_element(image.image_id, len(image.points2D) - 1)
    return int(model.add_point3D(point, track))


def _intersect(rays: Sequence[tuple[Any, Floats]]) -> Floats:
    """Return the point nearest to the rays through a pixel of each image, ``(3,)``: least squares."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for image, pixel in rays:
        direction = image.cam_from_world().rotation.matrix().T @ np.append(
            image.camera.cam_from_img(pixel), 1
        )
        across = np.eye(3) - np.outer(direction, direction) / (direction @ direction)
        normal += across
        right += across @ image.projection_center()
    return np.asarray(np.linalg.solve(normal, right), np.float64)


def _result(
    model: Any,
    folders: tuple[Path, Path],
    placed: Placed,
    shots: Mapping[str, Shot],
    origin: Floats,
    control_m: Floats | None,
    held: bool,
) -> Reconstruction:
    number = {point: n for n, point in enumerate(sorted(model.points3D))}
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)
    views = tuple(_view(image, shots[image.name].path, number) for image in images)
    measured = {shot.path: position for shot, position in zip(placed.shots, placed.positions, strict=True)}
    return Reconstruction(
        crs=placed.crs,
        origin=origin,
        views=views,
        missing=tuple(shot.path for shot in placed.shots if shot.path not in {view.path for view in views}),
        points=np.array([model.points3D[point].xyz for point in number]),
        reprojection_px=model.compute_mean_reprojection_error(),
        residuals=np.array([view.centre + origin - measured[view.path] for view in views]),
        control_m=control_m,
        focal_held=held,
        model=folders[0],
        root=folders[1],
    )


def _view(image: Any, path: Path, number: Mapping[int, int]) -> View:
    camera = image.camera
    seen = {number[p.point3D_id] for p in image.points2D if p.has_point3D()}
    return View(
        path=path,
        camera=Camera(camera.model.name, camera.width, camera.height, tuple(camera.params.tolist())),
        rotation=image.cam_from_world().rotation.matrix(),
        centre=image.projection_center(),
        seen=np.array(sorted(seen), np.intp),
    )
