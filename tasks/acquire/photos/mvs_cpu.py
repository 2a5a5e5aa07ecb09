"""Dense stereo on the CPU: depth maps of photographs whose poses are known, merged to an oriented cloud.

For each photograph: rectify it with its best partners (Fusiello et al., 2000), match by semi-global
matching (Hirschmüller, 2008; OpenCV), keep depths that two pairs agree on. Coarser than PatchMatch stereo on
a GPU, but no part of it is random.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks import options as base
from flexroad.tasks.acquire.photos.sfm import Reconstruction, View, colmap
from flexroad.tasks.types import Bools, Floats

FEWEST_SHARED = 20
"""Sparse points two photographs must share to be a pair."""
BEST_ANGLE_DEG, WIDEST_ANGLE_DEG = 12.0, 45.0
"""Rays at a smaller angle meet less surely; at a wider one surfaces no longer look alike."""
NEARER, FARTHER = 0.25, 0.05
"""Parts of the depth that surfaces may lie before and behind the sparse points: crowns and roofs have few."""
SMALLEST_PATCH = 2e-4
"""Patches of depth smaller than this part of the picture are chance agreement, as in crowns and water."""


class Options(base.Options):
    """How photographs are matched pixel by pixel."""

    size: int = Field(1200, ge=100, description="photographs are reduced to this width or height (px)")
    partners: int = Field(4, ge=2, description="each photograph is matched with so many others")
    agree_px: float = Field(1.0, gt=0, description="depths of two pairs agree within so much parallax (px)")
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
class Pinhole:
    """Pixels without distortion: a focal length, and where the first one's corner lies on the image plane."""

    focal: float
    """Pixels."""
    left: float
    """Column of the principal point, negative: the corner's position (px)."""
    top: float
    width: int
    height: int

    def rays(self) -> NDArray[np.float32]:
        """Return directions through the pixels' centres, ``(h, w, 3)``, z = 1."""
        x = (np.arange(self.width) + 0.5 + self.left) / self.focal
        y = (np.arange(self.height) + 0.5 + self.top) / self.focal
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two photographs as one camera would have taken them, moved along its rows."""

    turn: Floats
    """World to the common camera, ``(3, 3)``; x runs from the first photograph to the second."""
    base_m: float
    one: Pinhole
    two: Pinhole
    parallaxes: int
    """Columns of parallax to search; 0 is the farthest depth."""


def partners(found: Reconstruction, which: int, options: Options) -> list[int]:
    """Return the photographs to match one with, best first: many shared points, seen at good angles."""
    view = found.views[which]
    scores = {}
    for other, partner in enumerate(found.views):
        shared = np.intersect1d(view.seen, partner.seen, assume_unique=True)
        if other == which or len(shared) < FEWEST_SHARED:
            continue
        angle = _angle_deg(found.points[shared], view.centre, partner.centre)
        if angle < WIDEST_ANGLE_DEG:
            scores[other] = len(shared) * min(1.0, angle / BEST_ANGLE_DEG)
    return sorted(scores, key=lambda other: -scores[other])[: options.partners]


def photo_cloud(view: View, others: Sequence[View], points: Floats, options: Options) -> Cloud:
    """Return what a photograph and its partners show, one oriented point per pixel they agree on.

    Parameters
    ----------
    view : View
        The photograph.
    others : Sequence of View
        Its partners, at least 2 for any point to be found.
    points : Floats
        Sparse points the photograph shows, ``(n, 3)``, m: they bound the depths.
    options : Options
        Size and tolerance.

    Raises
    ------
    TaskError
        If pycolmap is missing.
    """
    pixels = _pinhole(view, options.size)
    rays = pixels.rays()
    image = _read(view, options.size)
    pairs = [_rectify(view, other, points, pixels.focal) for other in others]
    depths: list[NDArray[np.float32]] = []
    errors: list[NDArray[np.float32]] = []
    for other, pair in zip(others, pairs, strict=True):
        depth = _match(view, image, other, _read(other, options.size), pair, options)
        depths.append(_onto(rays, view, pair, depth))
        # Depth per pixel of parallax is depth squared over focal length and base.
        errors.append(depths[-1] ** 2 / np.float32(pixels.focal * pair.base_m))
    depth = _patches(
        _agreed(depths, errors, options.agree_px), max(pixels.focal * pair.base_m for pair in pairs)
    )
    world: Floats = rays @ view.rotation
    places = view.centre + depth[..., None] * world
    normals, smooth = _normals(places, world)
    colours, _ = _seen(view, image, view.rotation, pixels)
    known = np.isfinite(depth) & smooth
    return Cloud(places[known], normals[known], np.ascontiguousarray(colours[known][:, ::-1]))


def merge(clouds: Sequence[Cloud], spacing_m: float) -> Cloud:
    """Return one point per cube of ``spacing_m`` that holds any: the mean of those in it."""
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

    mixed = mean(normals)
    mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-9)
    return Cloud(mean(points), mixed, np.rint(mean(colours)).astype(np.uint8))


def ground_pixel_m(found: Reconstruction, size: int) -> float:
    """Return what a pixel of photographs reduced to ``size`` covers on the ground, the median (m)."""
    sizes = []
    for view in found.views:
        depth = (found.points[view.seen] - view.centre) @ view.rotation[2]
        sizes.append(float(np.median(depth)) / _pinhole(view, size).focal)
    return float(np.median(sizes))


def _angle_deg(points: Floats, one: Floats, two: Floats) -> float:
    a, b = points - one, points - two
    cosine = np.sum(a * b, axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return float(np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1)))))


def _scale(view: View, size: int) -> float:
    return min(1.0, size / max(view.camera.width, view.camera.height))


def _pinhole(view: View, size: int) -> Pinhole:
    camera, scale = view.camera, _scale(view, size)
    width, height = round(camera.width * scale), round(camera.height * scale)
    return Pinhole(camera.focal_px * scale, -width / 2, -height / 2, width, height)


def _read(view: View, size: int) -> NDArray[np.uint8]:
    """Return the photograph, reduced, as it lies on the sensor: blue, green, red."""
    import cv2

    from flexroad.tasks.errors import TaskError

    # The tag of orientation is for viewers; the poses are those of the sensor.
    image = cv2.imread(str(view.path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise TaskError(f"{view.path} cannot be read any more", file=str(view.path))
    scale = _scale(view, size)
    width, height = round(view.camera.width * scale), round(view.camera.height * scale)
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def _rectify(view: View, other: View, points: Floats, focal: float) -> Pair:
    base = other.centre - view.centre
    length = float(np.linalg.norm(base))
    x = base / length
    z = view.rotation[2] + other.rotation[2]
    z = z - (z @ x) * x
    z /= np.linalg.norm(z)
    turn = np.stack([x, np.cross(z, x), z])
    depth = (points - view.centre) @ z
    near, far = np.percentile(depth, [1, 99]) * (1 - NEARER, 1 + FARTHER)
    parallaxes = 16 * math.ceil(focal * length * (1 / near - 1 / far) / 16)
    a, b = _frame(view, turn, focal), _frame(other, turn, focal)
    top, bottom = max(a[1], b[1]), min(a[3], b[3])
    # The second's columns are moved by the parallax of the farthest depth, and the first columns have room
    # for that of the nearest one.
    farthest = focal * length / far
    left, right = a[0] - parallaxes, a[2]
    width, height = math.ceil(right - left), max(math.ceil(bottom - top), 1)
    return Pair(
        turn,
        length,
        Pinhole(focal, left, top, width, height),
        Pinhole(focal, left - farthest, top, width, height),
        parallaxes,
    )


def _frame(view: View, turn: Floats, focal: float) -> tuple[float, float, float, float]:
    """Return left, top, right, bottom of a photograph in the common camera (px)."""
    camera = view.camera
    x, y = camera.width / 2 / camera.focal_px, camera.height / 2 / camera.focal_px
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) @ view.rotation @ turn.T
    seen = focal * corners[:, :2] / corners[:, 2:]
    return *seen.min(axis=0).tolist(), *seen.max(axis=0).tolist()


def _seen(
    view: View, image: NDArray[np.uint8], turn: Floats, pixels: Pinhole
) -> tuple[NDArray[np.uint8], Bools]:
    """Return a photograph on other pixels and which of them it shows, ``(h, w, 3)`` and ``(h, w)``."""
    import cv2

    camera = view.camera
    directions = pixels.rays().reshape(-1, 3) @ (view.rotation @ turn.T).T
    ahead = directions[:, 2] > 0.1
    directions[~ahead] = (0, 0, 1)
    lens = colmap().Camera(
        model=camera.model, width=camera.width, height=camera.height, params=list(camera.params)
    )
    where = lens.img_from_cam(directions.astype(np.float64))
    scale = np.array([image.shape[1] / camera.width, image.shape[0] / camera.height])
    where = (where * scale - 0.5).reshape(pixels.height, pixels.width, 2).astype(np.float32)
    inside = ahead.reshape(where.shape[:2]) & (where >= 0).all(-1)
    inside &= (where[..., 0] <= image.shape[1] - 1) & (where[..., 1] <= image.shape[0] - 1)
    return np.asarray(cv2.remap(image, where, None, cv2.INTER_LINEAR)), inside


def _match(
    view: View,
    image: NDArray[np.uint8],
    other: View,
    partner: NDArray[np.uint8],
    pair: Pair,
    options: Options,
) -> NDArray[np.float32]:
    """Return depths of a pair's first photograph along the common camera's z, ``(h, w)``; NaN unknown."""
    import cv2

    first, inside = _seen(view, image, pair.turn, pair.one)
    second, shown = _seen(other, partner, pair.turn, pair.two)
    window = options.window_px
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=pair.parallaxes,
        blockSize=window,
        # OpenCV's own advice for its two penalties, for one channel.
        P1=8 * window**2,
        P2=32 * window**2,
        disp12MaxDiff=1,
        uniquenessRatio=8,
        speckleWindowSize=80,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    grey = [cv2.cvtColor(each, cv2.COLOR_BGR2GRAY) for each in (first, second)]
    parallax = matcher.compute(*grey).astype(np.float32) / 16
    # Where the partner shows nothing, or at the end of the search, the matcher still has an answer.
    column = np.arange(pair.one.width) - np.rint(parallax).astype(np.intp)
    there = np.take_along_axis(shown, np.clip(column, 0, pair.one.width - 1), axis=1) & (column >= 0)
    known = inside & there & (parallax > 0) & (parallax < pair.parallaxes - 1)
    apart = parallax + np.float32(pair.one.left - pair.two.left)
    with np.errstate(divide="ignore"):
        return np.where(known, np.float32(pair.one.focal * pair.base_m) / apart, np.float32(np.nan))


def _onto(
    rays: NDArray[np.float32], view: View, pair: Pair, depth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return depths along a photograph's own z at its own pixels, ``(h, w)``.

    Both cameras stand at one place, so where a ray goes does not depend on the depth.
    """
    import cv2

    turned = rays @ (pair.turn @ view.rotation.T).T.astype(np.float32)
    at = turned[..., :2] / turned[..., 2:] * pair.one.focal - (pair.one.left, pair.one.top) - 0.5
    sampled = cv2.remap(
        depth,
        at.astype(np.float32),
        None,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=np.nan,
    )
    return np.asarray(sampled / turned[..., 2], np.float32)


def _agreed(
    depths: Sequence[NDArray[np.float32]], errors: Sequence[NDArray[np.float32]], tolerance_px: float
) -> NDArray[np.float32]:
    """Return the weighted mean of the depths that another pair confirms, NaN where none does."""
    best = np.full(depths[0].shape, np.nan, np.float32)
    support = np.ones(best.shape, np.int8)
    for depth, error in zip(depths, errors, strict=True):
        total, weight, count = np.zeros_like(best), np.zeros_like(best), np.zeros(best.shape, np.int8)
        for each, its in zip(depths, errors, strict=True):
            near = np.abs(each - depth) <= tolerance_px * np.maximum(its, error)
            with np.errstate(invalid="ignore", divide="ignore"):
                w = np.where(near, 1 / np.square(its), np.float32(0))
            total += np.where(near, w * each, 0)
            weight += w
            count += near
        better = count > support
        best[better] = total[better] / weight[better]
        support[better] = count[better]
    return best


def _patches(depth: NDArray[np.float32], parallax_m: float) -> NDArray[np.float32]:
    """Return the depths without small patches; a patch ends where the parallax jumps by two pixels."""
    import cv2

    # In 1/16 of a pixel, as the matcher counts.
    parallax = np.nan_to_num(16 * parallax_m / depth, nan=0).clip(0, 32767).astype(np.int16)
    cv2.filterSpeckles(parallax, 0, int(SMALLEST_PATCH * parallax.size), 32)
    return np.where(parallax > 0, depth, np.float32(np.nan))


def _normals(places: Floats, world: Floats) -> tuple[Floats, Bools]:
    """Return unit normals towards the camera and where they are known: where the neighbours are."""
    across, down = np.full_like(places, np.nan), np.full_like(places, np.nan)
    across[:, 2:-2] = places[:, 4:] - places[:, :-4]
    down[2:-2] = places[4:] - places[:-4]
    normals = np.cross(down, across)
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    away = np.sum(normals * world, axis=-1, keepdims=True) > 0
    normals = np.where(away, -normals, normals)
    return normals, np.asarray(np.isfinite(normals).all(axis=-1))
