"""Poses and surface are reconstructed from rendered photographs of a synthetic hill."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from flexroad.catalog.lazy import lazy
from flexroad.tasks import TaskError
from flexroad.tools.prepare.photos import mvs_cpu, sfm, surface
from flexroad.tools.prepare.photos.exif import Control, place_photos, read_shot
from flexroad.tools.prepare.photos.sfm import Options, reconstruct
from flexroad.tools.prepare.photos.surface import poisson, write_ply
from tests import make_photos
from tests.gpu import REASON

pytestmark = [pytest.mark.slow, pytest.mark.soak("photos")]

QUICK = Options(image_size=640, features=2500, threads=2)
STEREO = mvs_cpu.Options(size=480, partners=3)
SPACING = 0.3


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return make_photos.photographs(tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def placed(photos):
    return place_photos([read_shot(photo.path) for photo in photos])


@pytest.fixture(scope="module")
def reconstruction(placed, tmp_path_factory):
    return reconstruct(placed, tmp_path_factory.mktemp("work"), QUICK)


@pytest.fixture(scope="module")
def cloud(reconstruction):
    clouds = []
    for number, view in enumerate(reconstruction.views):
        others = [reconstruction.views[other] for other in mvs_cpu.partners(reconstruction, number, STEREO)]
        clouds.append(mvs_cpu.photo_cloud(view, others, reconstruction.points[view.visible], STEREO))
    return mvs_cpu.merge(clouds, SPACING)


def centre_errors(reconstruction, photos):
    true = np.array([photo.centre for photo in photos])
    return np.abs(np.array([view.centre for view in reconstruction.views]) + reconstruction.origin - true)


def height_errors(points, origin):
    east, north, up = (points + origin).T
    return up - make_photos.ground(east, north)


def test_reconstruct_gives_true_poses(reconstruction, photos):
    assert [view.path for view in reconstruction.views] == [photo.path for photo in photos]
    assert not reconstruction.missing
    assert reconstruction.focal_held
    assert reconstruction.reprojection_px < 0.3
    assert centre_errors(reconstruction, photos).max() < 0.05
    for view, photo in zip(reconstruction.views, photos, strict=True):
        np.testing.assert_allclose(view.rotation, photo.rotation, atol=1e-3)
    assert np.quantile(np.abs(height_errors(reconstruction.points, reconstruction.origin)), 0.95) < 0.1


def test_reconstruct_control_points_correct_gnss_and_focal_length(placed, photos, tmp_path):
    plan = make_photos.CORNER + np.array([[25, 22], [46, 25], [30, 48], [44, 44], [35, 35]])
    points = np.column_stack([plan, make_photos.ground(*plan.T)])
    pixels = [{photo.path: tuple(photo.pixels(point[None])[0]) for photo in photos} for point in points]
    marks = tuple(
        {path: (x, y) for path, (x, y) in each.items() if 5 < x < make_photos.WIDTH - 5 and 5 < y < 475}
        for each in pixels
    )
    shots = tuple(replace(shot, focal_px=1.15 * shot.focal_px) for shot in placed.shots)
    wrong = replace(placed, shots=shots, positions=placed.positions + np.array([2, -1, 3]))
    reconstruction = reconstruct(wrong, tmp_path, QUICK, Control(tuple("abcde"), points, marks))
    assert not reconstruction.focal_held
    assert reconstruction.views[0].camera.focal_px == pytest.approx(make_photos.FOCAL, rel=5e-3)
    assert centre_errors(reconstruction, photos).max() < 0.15
    assert np.abs(reconstruction.control_m).max() < 0.05
    np.testing.assert_allclose(np.median(reconstruction.residuals, axis=0), [-2, 1, -3], atol=0.1)


def test_photo_cloud_has_true_heights_and_normals(reconstruction, cloud):
    errors = height_errors(cloud.points, reconstruction.origin)
    assert np.abs(np.median(errors)) < 0.05
    assert np.quantile(np.abs(errors), 0.95) < 0.15
    assert np.ptp(cloud.points[:, :2], axis=0).min() > 30
    east, north, _ = (cloud.points + reconstruction.origin).T
    step = 0.01
    slope = [
        (make_photos.ground(east + x, north + y) - make_photos.ground(east - x, north - y)) / (2 * step)
        for x, y in ((step, 0), (0, step))
    ]
    true = np.column_stack([-slope[0], -slope[1], np.ones(len(east))])
    cosine = np.sum(true * cloud.normals, axis=1) / np.linalg.norm(true, axis=1)
    assert np.degrees(np.arccos(np.median(cosine))) < 5


def test_patchmatch_has_true_heights(reconstruction, tmp_path):
    if not surface.has_gpu():
        pytest.skip(f"{REASON} and pycolmap-cuda12")
    cloud = surface.patchmatch(reconstruction, tmp_path, 2000)
    errors = height_errors(cloud.points, reconstruction.origin)
    assert np.abs(np.median(errors)) < 0.05
    assert np.quantile(np.abs(errors), 0.95) < 0.15
    assert np.ptp(cloud.points[:, :2], axis=0).min() > 30
    # Normals point up, to the cameras.
    assert np.median(cloud.normals[:, 2]) > 0.9


@pytest.mark.parametrize(
    ("built", "gpus", "expected"), [(False, 1, False), (True, 0, False), (True, 1, True)]
)
def test_patchmatch_needs_cuda_and_a_gpu(monkeypatch, built, gpus, expected):
    monkeypatch.setattr(sfm.colmap(), "has_cuda", built)
    monkeypatch.setattr("pycolmap.get_num_cuda_devices", lambda: gpus, raising=False)
    assert surface.has_gpu() == expected


def test_photo_cloud_has_colours_of_the_photographs(reconstruction, cloud, photos):
    texture = make_photos.texture()
    east, north, _ = (cloud.points + reconstruction.origin).T
    col, row = (
        ((axis - corner) / make_photos.TEXEL_M).astype(int)
        for axis, corner in zip((east, north), make_photos.CORNER, strict=True)
    )
    # Colours are averaged over the spacing of the merged cloud, so only low frequencies are compared.
    for band in range(3):
        assert np.corrcoef(texture[row, col, band], cloud.colours[:, band])[0, 1] > 0.5


def test_poisson_gives_true_heights_and_ends_at_the_points(reconstruction, cloud, tmp_path):
    mesh = poisson(cloud, SPACING, reconstruction.crs, reconstruction.origin, tmp_path, threads=1)
    used = mesh.vertices[np.unique(mesh.faces)]
    errors = height_errors(used, 0)
    assert np.abs(np.median(errors)) < 0.05
    assert np.quantile(np.abs(errors), 0.95) < 0.15
    low, high = (
        (cloud.points + reconstruction.origin).min(axis=0),
        (cloud.points + reconstruction.origin).max(axis=0),
    )
    assert (used.min(axis=0) > low - 10 * SPACING).all()
    assert (used.max(axis=0) < high + 10 * SPACING).all()
    assert mesh.coloured


def test_read_ply_returns_written_cloud(cloud, tmp_path):
    write_ply(tmp_path / "cloud.ply", cloud)
    result = surface.read_ply(tmp_path / "cloud.ply")
    np.testing.assert_allclose(result.points, cloud.points, atol=1e-5)
    np.testing.assert_array_equal(result.colours, cloud.colours)


def test_merge_gives_mean_of_each_cube():
    cloud = mvs_cpu.Cloud(
        np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.2, 0, 0]]),
        np.array([[0, 0, 1.0], [0, 0, 1], [1, 0, 0]]),
        np.array([[10, 0, 0], [20, 0, 0], [0, 0, 9]], np.uint8),
    )
    merged = mvs_cpu.merge([cloud, cloud], 0.5)
    np.testing.assert_allclose(merged.points, [[-0.2, 0, 0], [0.2, 0.1, 0.1]])
    np.testing.assert_allclose(merged.normals, [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(merged.colours, [[0, 0, 9], [15, 0, 0]])


def test_reconstruct_unrelated_photographs_are_an_error(tmp_path):
    rng = np.random.default_rng(0)
    for number in range(3):
        noise = rng.integers(0, 255, (240, 320, 3), np.uint8)
        centre = [*make_photos.CORNER + 10 * number, 140]
        Image.fromarray(noise).save(tmp_path / f"{number}.jpg", exif=make_photos.exif(centre))
    placed = place_photos([read_shot(path) for path in sorted(tmp_path.glob("*.jpg"))])
    (tmp_path / "work").mkdir()
    with pytest.raises(TaskError, match="none of the 3 photographs match.*--image-size 1280"):
        reconstruct(placed, tmp_path / "work", QUICK)


def test_reconstruct_names_photographs_not_placed(placed, photos, tmp_path):
    rng = np.random.default_rng(0)
    shots = list(placed.shots[:3])
    for number in range(4):
        path = tmp_path / f"other{number}.jpg"
        noise = rng.integers(0, 255, (240, 320, 3), np.uint8)
        Image.fromarray(noise).save(path, exif=make_photos.exif(photos[number].centre, model="Other"))
        shots.append(read_shot(path))
    (tmp_path / "work").mkdir()
    with pytest.raises(TaskError, match=r"3 of 7 photographs could be placed, not other0\.jpg, other1"):
        reconstruct(place_photos(shots), tmp_path / "work", QUICK)


def test_reconstruct_without_pycolmap_gives_install_command(placed, tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "pycolmap", lazy("pycolmap"))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(TaskError, match=r"pip install 'flexroad\[photogrammetry\]'"):
        reconstruct(placed, tmp_path, QUICK)


def test_colmap_names_a_missing_library(tmp_path, monkeypatch):
    # As pycolmap raises it.
    lines = (
        "try: raise ImportError('libSM.so.6: no such file')",
        "except ImportError as e: raise RuntimeError() from e",
    )
    (tmp_path / "pycolmap.py").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pycolmap", raising=False)
    with pytest.raises(TaskError, match=r"\(libSM.so.6: no such file\); install the library"):
        sfm.colmap()
