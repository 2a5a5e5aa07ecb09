"""Dense stereo on the CPU: depth maps of photographs with given poses, merged to an oriented cloud.

For each photograph: rectification with its best partners (Fusiello et al., 2000), semi-global matching
(Hirschmüller, 2008; OpenCV), and selection of the depths that two pairs agree on. The result is
deterministic, but coarser than the result of PatchMatch stereo on a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.lazy import lazy
from flexroad.tasks import options as base
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare import images as images  # sets OpenCV's limit
from flexroad.tools.prepare.photos.sfm import Reconstruction, View, colmap

cv2 = lazy("cv2")

FEWEST_SHARED = 20
"""Smallest number of sparse points shared by the photographs of a pair."""
BEST_ANGLE_DEG, WIDEST_ANGLE_DEG = 12.0, 45.0
"""Range of the angle between rays: smaller angles give less accurate depths, larger angles fewer matches."""
NEARER, FARTHER = 0.25, 0.05
"""The range of depths of the sparse points is extended by these shares: crowns and roofs have few points."""
SMALLEST_PATCH = 2e-4
"""Patches of depth below this share of the image are removed: they are chance matches (crowns, water)."""


class Options(base.Options):
    """Options of dense stereo on the CPU."""

    size: int = Field(1200, ge=100, description="photographs are reduced to this width or height (px)")
    partners: int = Field(4, ge=2, description="number of other photographs that each one is matched with")
    agree_px: float = Field(1.0, gt=0, description="largest difference of parallax of depths that agree (px)")
    window_px: int = Field(5, ge=1, le=11, description="side of the matching window (px)")


@dataclass(frozen=True, eq=False)
class Cloud:
    """Oriented points with colours, relative to the reconstruction's origin."""

    points: Floats
    """``(n, 3)``, m."""
    normals: Floats
    """Unit vectors towards the cameras, ``(n, 3)``."""
    colours: NDArray[np.uint8]
    """Red, green, blue, ``(n, 3)``."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)


@dataclass(frozen=True)
class _Pinhole:
    """A camera without distortion: focal length, and position of the pixels on the image plane."""

    focal: float
    """Pixels."""
    left: float
    """Position of the left edge relative to the principal point (px)."""
    top: float
    """Position of the upper edge relative to the principal point (px)."""
    width: int
    height: int

    def rays(self) -> NDArray[np.float32]:
        """Return directions through the pixel centres, ``(h, w, 3)``, with z = 1."""
        x = (np.arange(self.width) + 0.5 + self.left) / self.focal
        y = (np.arange(self.height) + 0.5 + self.top) / self.focal
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two photographs rectified to a common camera, displaced along its rows."""

    rotation: Floats
    """World to the common camera, ``(3, 3)``; x points from the first photograph to the second."""
    base_m: float
    """Distance of the projection centres (m)."""
    first: _Pinhole
    second: _Pinhole
    parallaxes: int
    """Number of parallaxes to search (px); 0 is the farthest depth."""


def partners(reconstruction: Reconstruction, number: int, options: Options) -> list[int]:
    """Return the photographs to match with a photograph, best first, by shared points and angles of rays."""
    view = reconstruction.views[number]
    scores = {}
    for other, partner in enumerate(reconstruction.views):
        shared = np.intersect1d(view.visible, partner.visible, assume_unique=True)
        if other == number or len(shared) < FEWEST_SHARED:
            continue
        angle = _angle_deg(reconstruction.points[shared], view.centre, partner.centre)
        if angle < WIDEST_ANGLE_DEG:
            scores[other] = len(shared) * min(1.0, angle / BEST_ANGLE_DEG)
    return sorted(scores, key=lambda other: -scores[other])[: options.partners]


def photo_cloud(view: View, others: Sequence[View], points: Floats, options: Options) -> Cloud:
    """Return the dense cloud of a photograph: one oriented point per pixel on which its pairs agree.

    - `others`: its partners; with fewer than 2 the cloud is empty.
    - `points`: sparse points visible in the photograph, ``(n, 3)``, m; they limit the range of depths.
    """
    pixels = _pinhole(view, options.size)
    rays = pixels.rays()
    image = _read(view, options.size)
    pairs = [_rectify(view, other, points, pixels.focal) for other in others]
    depths: list[NDArray[np.float32]] = []
    errors: list[NDArray[np.float32]] = []
    for other, pair in zip(others, pairs, strict=True):
        depth = _match(view, image, other, _read(other, options.size), pair, options)
        depths.append(_to_view(rays, view, pair, depth))
        # Change of depth per pixel of parallax: depth^2 / (focal length * base).
        errors.append(depths[-1] ** 2 / np.float32(pixels.focal * pair.base_m))
    depth = _without_small_patches(
        _consistent(depths, errors, options.agree_px), max(pixels.focal * pair.base_m for pair in pairs)
    )
    world: Floats = rays @ view.rotation
    positions = view.centre + depth[..., None] * world
    normals, smooth = _normals(positions, world)
    colours, _ = _resampled(view, image, view.rotation, pixels)
    valid = np.isfinite(depth) & smooth
    return Cloud(positions[valid], normals[valid], np.ascontiguousarray(colours[valid][:, ::-1]))


def merge(clouds: Sequence[Cloud], spacing_m: float) -> Cloud:
    """Return one point per occupied cube of side ``spacing_m``: the mean of its points."""
    points, normals, colours = (
        np.concatenate([getattr(cloud, name) for cloud in clouds])
        for name in ("points", "normals", "colours")
    )
    cube = np.floor(points / spacing_m).astype(np.int64)
    cube -= cube.min(axis=0)
    size = cube.max(axis=0) + 1
    key = (cube[:, 0] * size[1] + cube[:, 1]) * size[2] + cube[:, 2]
    _, member, count = np.unique(key, return_inverse=True, return_counts=True)

    def mean(values: NDArray[Any]) -> Floats:
        return np.column_stack([np.bincount(member, axis) for axis in values.T]) / count[:, None]

    merged_normals = mean(normals)
    merged_normals /= np.maximum(np.linalg.norm(merged_normals, axis=1, keepdims=True), 1e-9)
    return Cloud(mean(points), merged_normals, np.rint(mean(colours)).astype(np.uint8))


def ground_pixel_m(reconstruction: Reconstruction, size: int) -> float:
    """Return the median size on the ground of a pixel of photographs reduced to ``size`` (m)."""
    sizes = []
    for view in reconstruction.views:
        depth = (reconstruction.points[view.visible] - view.centre) @ view.rotation[2]
        sizes.append(float(np.median(depth)) / _pinhole(view, size).focal)
    return float(np.median(sizes))


def _angle_deg(points: Floats, first: Floats, second: Floats) -> float:
    a, b = points - first, points - second
    cosine = np.sum(a * b, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def _scale(view: View, size: int) -> float:
    return min(1.0, size / max(view.camera.width, view.camera.height))


def _pinhole(view: View, size: int) -> _Pinhole:
    camera, scale = view.camera, _scale(view, size)
    width, height = round(camera.width * scale), round(camera.height * scale)
    return _Pinhole(camera.focal_px * scale, -width / 2, -height / 2, width, height)


def _read(view: View, size: int) -> NDArray[np.uint8]:
    """Return the reduced photograph in sensor orientation, ``(h, w, 3)``: blue, green, red."""
    try:
        # The poses are poses of the sensor, so the orientation tag is ignored.
        image = cv2.imread(str(view.path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        # More pixels than the limit of `images`.
        image = None
    if image is None:
        raise TaskError(f"{view.path} can no longer be read", file=str(view.path))
    scale = _scale(view, size)
    width, height = round(view.camera.width * scale), round(view.camera.height * scale)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def _rectify(view: View, other: View, points: Floats, focal: float) -> _Pair:
    base = other.centre - view.centre
    length = float(np.linalg.norm(base))
    x = base / length
    z = view.rotation[2] + other.rotation[2]
    z = z - (z @ x) * x
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z])
    depth = (points - view.centre) @ z
    near, far = np.percentile(depth, [1, 99]) * (1 - NEARER, 1 + FARTHER)
    parallaxes = 16 * math.ceil(focal * length * (1 / near - 1 / far) / 16)
    a, b = _frame(view, rotation, focal), _frame(other, rotation, focal)
    top, bottom = max(a[1], b[1]), min(a[3], b[3])
    # The columns of the second photograph are shifted by the parallax of the farthest depth; the first
    # columns leave space for the parallax of the nearest depth.
    farthest = focal * length / far
    left, right = a[0] - parallaxes, a[2]
    width, height = math.ceil(right - left), max(math.ceil(bottom - top), 1)
    return _Pair(
        rotation,
        length,
        _Pinhole(focal, left, top, width, height),
        _Pinhole(focal, left - farthest, top, width, height),
        parallaxes,
    )


def _frame(view: View, rotation: Floats, focal: float) -> tuple[float, float, float, float]:
    """Return left, top, right, bottom of a photograph in the image plane of the common camera (px)."""
    camera = view.camera
    x, y = camera.width / 2 / camera.focal_px, camera.height / 2 / camera.focal_px
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) @ view.rotation @ rotation.T
    projected = focal * corners[:, :2] / corners[:, 2:]
    return *projected.min(axis=0).tolist(), *projected.max(axis=0).tolist()


def _resampled(
    view: View, image: NDArray[np.uint8], rotation: Floats, pixels: _Pinhole
) -> tuple[NDArray[np.uint8], Bools]:
    """Return a photograph resampled to other pixels, ``(h, w, 3)``, and which it covers, ``(h, w)``."""
    camera = view.camera
    directions = pixels.rays().reshape(-1, 3) @ (view.rotation @ rotation.T).T
    ahead = directions[:, 2] > 0.1
    directions[~ahead] = (0, 0, 1)
    lens = colmap().Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )
    position = lens.img_from_cam(directions.astype(np.float64))
    scale = np.array([image.shape[1] / camera.width, image.shape[0] / camera.height])
    position = (position * scale - 0.5).reshape(pixels.height, pixels.width, 2).astype(np.float32)
    inside = ahead.reshape(position.shape[:2]) & (position >= 0).all(-1)
    inside &= (position[..., 0] <= image.shape[1] - 1) & (position[..., 1] <= image.shape[0] - 1)
    return np.asarray(cv2.remap(image, position, None, cv2.INTER_LINEAR)), inside


def _match(
    view: View,
    image: NDArray[np.uint8],
    other: View,
    partner: NDArray[np.uint8],
    pair: _Pair,
    options: Options,
) -> NDArray[np.float32]:
    """Return depths of the first photograph along the common camera's z, ``(h, w)``, m; NaN if unmatched."""
    first, inside = _resampled(view, image, pair.rotation, pair.first)
    second, covered = _resampled(other, partner, pair.rotation, pair.second)
    window = options.window_px
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=pair.parallaxes,
        blockSize=window,
        # OpenCV's recommendation for the two penalties with one channel.
        P1=8 * window**2,
        P2=32 * window**2,
        disp12MaxDiff=1,
        uniquenessRatio=8,
        speckleWindowSize=80,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    grey = [cv2.cvtColor(photo, cv2.COLOR_BGR2GRAY) for photo in (first, second)]
    parallax = matcher.compute(*grey).astype(np.float32) / 16
    # The matcher also returns values outside the partner and at the end of the search range.
    column = np.arange(pair.first.width) - np.rint(parallax).astype(np.intp)
    in_partner = np.take_along_axis(covered, np.clip(column, 0, pair.first.width - 1), axis=1) & (column >= 0)
    valid = inside & in_partner & (parallax > 0) & (parallax < pair.parallaxes - 1)
    disparity = parallax + np.float32(pair.first.left - pair.second.left)
    with np.errstate(divide="ignore"):
        return np.where(valid, np.float32(pair.first.focal * pair.base_m) / disparity, np.float32(np.nan))


def _to_view(
    rays: NDArray[np.float32], view: View, pair: _Pair, depth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return depths along the photograph's z at its own pixels, ``(h, w)``, m.

    Both cameras have the same centre, so the pixel that a ray hits does not depend on the depth.
    """
    directions = rays @ (pair.rotation @ view.rotation.T).T.astype(np.float32)
    position = (
        directions[..., :2] / directions[..., 2:] * pair.first.focal - (pair.first.left, pair.first.top) - 0.5
    )
    sampled = cv2.remap(
        depth,
        position.astype(np.float32),
        None,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=np.nan,
    )
    return np.asarray(sampled / directions[..., 2], np.float32)


def _consistent(
    depths: Sequence[NDArray[np.float32]], errors: Sequence[NDArray[np.float32]], tolerance_px: float
) -> NDArray[np.float32]:
    """Return the weighted mean of the depths that at least two pairs agree on, ``(h, w)``; NaN elsewhere."""
    best = np.full(depths[0].shape, np.nan, np.float32)
    support = np.ones(best.shape, np.int8)
    for depth, error in zip(depths, errors, strict=True):
        total, weight, count = np.zeros_like(best), np.zeros_like(best), np.zeros(best.shape, np.int8)
        for candidate, candidate_error in zip(depths, errors, strict=True):
            near = np.abs(candidate - depth) <= tolerance_px * np.maximum(candidate_error, error)
            with np.errstate(invalid="ignore", divide="ignore"):
                w = np.where(near, 1 / np.square(candidate_error), np.float32(0))
            total += np.where(near, w * candidate, 0)
            weight += w
            count += near
        better = count > support
        best[better] = total[better] / weight[better]
        support[better] = count[better]
    return best


def _without_small_patches(depth: NDArray[np.float32], parallax_m: float) -> NDArray[np.float32]:
    """Return the depths without small patches; a patch ends where the parallax jumps by two pixels."""
    # In 1/16 of a pixel, the unit of the matcher.
    parallax = np.nan_to_num(16 * parallax_m / depth, nan=0).clip(0, 32767).astype(np.int16)
    cv2.filterSpeckles(parallax, 0, int(SMALLEST_PATCH * parallax.size), 32)
    return np.where(parallax > 0, depth, np.float32(np.nan))


def _normals(positions: Floats, world: Floats) -> tuple[Floats, Bools]:
    """Return unit normals towards the camera, ``(h, w, 3)``, and where they are valid, ``(h, w)``."""
    across, down = np.full_like(positions, np.nan), np.full_like(positions, np.nan)
    across[:, 2:-2] = positions[:, 4:] - positions[:, :-4]
    down[2:-2] = positions[4:] - positions[:-4]
    normals = np.cross(down, across)
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    away = np.sum(normals * world, axis=-1, keepdims=True) > 0
    normals = np.where(away, -normals, normals)
    return normals, np.asarray(np.isfinite(normals).all(axis=-1))
