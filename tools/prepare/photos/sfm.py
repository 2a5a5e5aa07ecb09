"""Structure from motion: camera poses and sparse points from photographs with GNSS positions.

The paper's stage A leaves this to photogrammetry. Here it is COLMAP (Schönberger & Frahm, 2016) by its Python
binding: SIFT, matching of GNSS neighbours, and incremental mapping. The positions are priors in the bundle
adjustment. Coordinates are relative to an origin in whole metres, so that float32 files lose no precision.
Features are found and matched on the CPU, even if pycolmap has a GPU. With COLMAP's SIFT for GPUs, heights
from the synthetic photographs of the tests were 0.09 m off (median), instead of 0.004 m.

Vertical photographs of flat ground do not determine the focal length: a longer focal length with the ground
farther below fits them equally well, and scales all heights by the same factor. So the focal length of the
files is fixed unless a free focal length fits clearly better.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.lazy import lazy
from flexroad.tasks import options as base
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Floats
from flexroad.tools.prepare.photos.exif import Control, PlacedPhotos, Shot

pycolmap = lazy("pycolmap")

EXHAUSTIVE = 12
"""Up to this number of photographs, all pairs are matched."""
CLEARLY_BETTER = 0.95
"""A free focal length is used if it reduces the reprojection error below this share.
A rolling shutter or a simple lens model can cause smaller improvements."""
INSTALL = "pip install 'flexroad[photogrammetry]'"


class Options(base.Options):
    """Options of feature matching and bundle adjustment."""

    image_size: int = Field(
        2400, ge=320, description="photographs are reduced to this width or height for feature detection (px)"
    )
    features: int = Field(8192, ge=500, description="largest number of features per photograph")
    neighbours: int = Field(
        12, ge=2, description="each photograph is matched with this number of nearest photographs"
    )
    calibrate: Literal["auto", "held", "free"] = Field(
        "auto",
        description="focal length: fixed (from the files), free, or auto: free if this fits much better",
    )
    seed: int = Field(1, ge=0, description="random seed")
    threads: int | None = Field(None, ge=1, description="number of threads; null: one per core")


@dataclass(frozen=True)
class _Camera:
    """A lens and sensor, as a COLMAP camera model."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]
    """Focal length, principal point, distortion (pixels); pixel centres are at .5."""

    @property
    def focal_px(self) -> float:
        """Focal length (pixels)."""
        return self.params[0]


@dataclass(frozen=True, eq=False)
class View:
    """A photograph with its pose."""

    path: Path
    camera: _Camera
    rotation: Floats
    """World to camera, ``(3, 3)``; the viewing direction is z, rows increase along y."""
    centre: Floats
    """Projection centre, ``(3,)``, m from the origin."""
    visible: NDArray[np.intp]
    """Indices of the sparse points visible in it."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Camera poses and sparse points."""

    crs: str
    origin: Floats
    """Easting, northing, height that all coordinates are relative to, in whole metres, ``(3,)``."""
    views: tuple[View, ...]
    missing: tuple[Path, ...]
    """Photographs that could not be placed."""
    points: Floats
    """Sparse points, ``(n, 3)``, m from the origin."""
    reprojection_px: float
    """Mean distance of features from the projections of their points, in pixels of the full photographs."""
    residuals: Floats
    """Adjusted minus measured camera positions, ``(len(views), 3)``, m."""
    control_m: Floats | None
    """Adjusted minus given ground control points, ``(n, 3)``, m; None if only GNSS was used."""
    focal_held: bool
    """Whether the focal length was fixed to the value of the files."""
    model: Path
    """Folder of the model in COLMAP's format, in the local frame."""
    root: Path
    """Folder that the photographs' names in the model are relative to."""

    @property
    def gnss_m(self) -> tuple[float, float]:
        """Median distance of the cameras from their GNSS positions in plan and height (m)."""
        plan = np.hypot(self.residuals[:, 0], self.residuals[:, 1])
        return float(np.median(plan)), float(np.median(np.abs(self.residuals[:, 2])))


def colmap() -> Any:
    """Return pycolmap, an optional dependency, and silence its log."""
    try:
        # It logs hundreds of lines of progress. Its errors are raised here as TaskError.
        pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    except ImportError as error:
        raise TaskError(f"photographs need pycolmap ({error}): {INSTALL}") from error
    except RuntimeError as error:
        # For example pycolmap-cuda12 without CUDA's libraries or libSM.so.6.
        reason = error.__cause__ or error
        raise TaskError(
            f"pycolmap cannot be loaded ({reason}); install the library that is missing, "
            "as by apt-get install libsm6 for libSM.so.6"
        ) from error
    return pycolmap


def reconstruct(
    placed: PlacedPhotos, work: Path, options: Options, control: Control | None = None
) -> Reconstruction:
    """Reconstruct the poses of photographs and sparse points from their features and GNSS positions.

    - `work`: empty folder for the database and the model.
    - `options`: the same seed and number of threads give the same result up to rounding.
    - `control`: ground control points. If 3 or more are marked in at least 2 placed photographs each, they
      alone determine the georeference; GNSS is then only used for matching.
    """
    colmap()
    pycolmap.set_random_seed(options.seed)
    origin = np.floor(placed.positions.min(axis=0))
    root = Path(os.path.commonpath([shot.path.resolve().parent for shot in placed.shots]))
    shots = {shot.path.resolve().relative_to(root).as_posix(): shot for shot in placed.shots}
    database = work / "database.db"
    _features(database, root, shots, options)
    _priors(database, dict(zip(shots, placed.positions - origin, strict=True)), placed)
    _match(database, len(shots), options)
    has_focal = all(shot.focal_px for shot in placed.shots)
    model, held = _map(database, root, work, options, has_focal)
    _check_placed(model, shots, options)
    controlled = None if control is None else _control(model, shots, control, origin)
    folder = work / "model"
    folder.mkdir()
    model.write(folder)
    return _result(model, (folder, root), placed, shots, origin, controlled, held and controlled is None)


def _features(database: Path, root: Path, shots: Mapping[str, Shot], options: Options) -> None:
    cameras: dict[tuple[Any, ...], list[str]] = defaultdict(list)
    for name, shot in shots.items():
        cameras[shot.camera, shot.width, shot.height, shot.focal_px].append(name)
    extraction = pycolmap.FeatureExtractionOptions(
        max_image_size=options.image_size, num_threads=options.threads or -1
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
            device=pycolmap.Device.cpu,
        )


def _priors(database: Path, local: Mapping[str, Floats], placed: PlacedPhotos) -> None:
    accuracy = dict(zip(local, placed.accuracy, strict=True))
    with pycolmap.Database.open(database) as db:
        # Remove the priors in degrees that the feature extraction wrote from EXIF.
        db.clear_pose_priors()
        for image in db.read_all_images():
            db.write_pose_prior(
                pycolmap.PosePrior(
                    corr_data_id=image.data_id,
                    position=local[image.name].reshape(3, 1),
                    position_covariance=np.diag(accuracy[image.name] ** 2),
                    coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
                )
            )


def _match(database: Path, count: int, options: Options) -> None:
    matching = pycolmap.FeatureMatchingOptions(num_threads=options.threads or -1)
    verifying = pycolmap.TwoViewGeometryOptions()
    verifying.ransac.random_seed = options.seed
    common = {"matching_options": matching, "verification_options": verifying, "device": pycolmap.Device.cpu}
    if count <= EXHAUSTIVE:
        pycolmap.match_exhaustive(database, **common)
    else:
        # Neighbours are limited by number, not by distance, as flying heights differ.
        pairing = pycolmap.SpatialPairingOptions(
            max_num_neighbors=options.neighbours, max_distance=1e6, ignore_z=True
        )
        pycolmap.match_spatial(database, pairing_options=pairing, **common)
    with pycolmap.Database.open(database) as db:
        if not db.num_inlier_matches():
            raise TaskError(
                f"none of the {count} photographs match each other; check that they show the same place; "
                f"{_advice(options)}"
            )


def _map(database: Path, root: Path, work: Path, options: Options, has_focal: bool) -> tuple[Any, bool]:
    """Return the model with most photographs, and whether the focal length was fixed."""
    held = has_focal and options.calibrate != "free"
    models = {}
    for hold in [True] * held + [False] * (not held or options.calibrate == "auto"):
        folder = work / f"mapped-{'held' if hold else 'free'}"
        folder.mkdir()
        candidates = pycolmap.incremental_mapping(database, root, folder, _mapping(options, hold))
        if candidates:
            models[hold] = max(candidates.values(), key=lambda model: model.num_reg_images())
    if not models:
        raise TaskError(f"the photographs match too little to place any of them; {_advice(options)}")
    if len(models) == 1:
        return next((model, hold) for hold, model in models.items())
    free = models[False].num_reg_images(), -models[False].compute_mean_reprojection_error()
    fixed = models[True].num_reg_images(), -models[True].compute_mean_reprojection_error() * CLEARLY_BETTER
    return (models[False], False) if free > fixed else (models[True], True)


def _mapping(options: Options, hold: bool) -> Any:
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


def _advice(options: Options) -> str:
    return (
        "use photographs that overlap by 60 % or more, "
        f"or a larger image size for features: --image-size {2 * options.image_size}"
    )


def _check_placed(model: Any, shots: Mapping[str, Shot], options: Options) -> None:
    placed = {image.name for image in model.images.values() if image.has_pose}
    missing = [shot.path.name for name, shot in shots.items() if name not in placed]
    if len(placed) >= max(3, len(shots) / 2):
        return
    names = ", ".join(missing[:5]) + (" and others" if len(missing) > 5 else "")
    raise TaskError(
        f"{len(placed)} of {len(shots)} photographs could be placed, not {names}; {_advice(options)}"
    )


def _control(model: Any, shots: Mapping[str, Shot], control: Control, origin: Floats) -> Floats | None:
    """Transform the model to the control points and adjust it to them; return residuals, ``(n, 3)``, m.

    Returns None, and leaves the model unchanged, if fewer than 3 points are marked in 2 placed photographs.
    """
    image_of = {shots[image.name].path: image for image in model.images.values() if image.has_pose}
    used, observations = [], []
    for point, pixels in zip(control.points - origin, control.marks, strict=True):
        rays = [(image_of[path], np.array(pixel)) for path, pixel in pixels.items() if path in image_of]
        if len(rays) >= 2:
            used.append(point)
            observations.append(rays)
    given = np.array(used).reshape(-1, 3)
    if len(given) < 3:
        return None
    estimated = np.array([_intersect(rays) for rays in observations])
    model.transform(pycolmap.estimate_sim3d(estimated, given))
    config = pycolmap.BundleAdjustmentConfig()
    for image in image_of.values():
        config.add_image(image.image_id)
    for point, rays in zip(given, observations, strict=True):
        track = pycolmap.Track()
        for image, pixel in rays:
            image.points2D.append(pycolmap.Point2D(pixel))
            track.add_element(image.image_id, len(image.points2D) - 1)
        config.add_constant_point(int(model.add_point3D(point, track)))
    pycolmap.create_default_bundle_adjuster(
        pycolmap.BundleAdjustmentOptions(print_summary=False), config, model
    ).solve()
    residuals: Floats = np.array([_intersect(rays) for rays in observations]) - given
    return residuals


def _intersect(rays: Sequence[tuple[Any, Floats]]) -> Floats:
    """Return the least-squares intersection of the rays through a pixel of each image, ``(3,)``, m."""
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
    placed: PlacedPhotos,
    shots: Mapping[str, Shot],
    origin: Floats,
    control_m: Floats | None,
    held: bool,
) -> Reconstruction:
    index = {point: n for n, point in enumerate(sorted(model.points3D))}
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda image: image.name)
    views = tuple(_view(image, shots[image.name].path, index) for image in images)
    measured = {shot.path: position for shot, position in zip(placed.shots, placed.positions, strict=True)}
    return Reconstruction(
        crs=placed.crs,
        origin=origin,
        views=views,
        missing=tuple(shot.path for shot in placed.shots if shot.path not in {view.path for view in views}),
        points=np.array([model.points3D[point].xyz for point in index]),
        reprojection_px=model.compute_mean_reprojection_error(),
        residuals=np.array([view.centre + origin - measured[view.path] for view in views]),
        control_m=control_m,
        focal_held=held,
        model=folders[0],
        root=folders[1],
    )


def _view(image: Any, path: Path, index: Mapping[int, int]) -> View:
    camera = image.camera
    visible = {index[p.point3D_id] for p in image.points2D if p.has_point3D()}
    return View(
        path=path,
        camera=_Camera(camera.model.name, camera.width, camera.height, tuple(camera.params.tolist())),
        rotation=image.cam_from_world().rotation.matrix(),
        centre=image.projection_center(),
        visible=np.array(sorted(visible), np.intp),
    )
