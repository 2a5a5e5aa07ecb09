"""Eighteen drone photographs, compared with the point cloud of other software (about a minute)."""

import laspy
import numpy as np
import pytest
import rasterio

from flexroad.catalog.grid import Grid
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tools.prepare.from_photos import PhotosOptions, prepare_photos
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.photos import mvs_cpu, sfm
from flexroad.tools.prepare.points import to_rasters

pytestmark = [pytest.mark.real, pytest.mark.slow, pytest.mark.soak("photos")]

GNSS_PLAN_M, GNSS_HEIGHT_M = 3.0, 5.0


@pytest.fixture(scope="module")
def published(real_data, tmp_path_factory):
    return prepare_photos(
        [real_data / "brighton_beach" / "images"],
        tmp_path_factory.mktemp("brighton"),
        PrepareOptions(cell_m=0.5),
        PhotosOptions(
            sfm=sfm.Options(image_size=1400, features=4096, threads=2, calibrate="held"),
            stereo=mvs_cpu.Options(size=800, partners=3),
            refine=False,
        ),
        to_rasters.Options(ground="filter", fill_m=0),
        SerialExecutor(),
        lambda line: None,
    )


def test_prepare_photos_places_all_within_gnss_accuracy(published):
    placed = published.notes[0]
    assert placed.startswith("18 of 18 photographs placed")
    words = placed.split()
    assert float(words[words.index("cameras") + 1]) < GNSS_PLAN_M
    assert float(words[words.index("and") + 1]) < GNSS_HEIGHT_M


def test_prepare_photos_surface_agrees_with_delivered_cloud(published, real_data):
    with rasterio.open(published.catalog.parent / "dsm.tif") as raster:
        dsm = raster.read(1).astype(float)
        grid = Grid("EPSG:32615", raster.bounds.left, raster.bounds.top, 0.5, raster.width, raster.height)
    cloud = laspy.read(real_data / "brighton_beach" / "model.laz")
    x, y, z = (np.asarray(axis) for axis in (cloud.x, cloud.y, cloud.z))
    inside = (x > grid.west) & (x < grid.east) & (y > grid.south) & (y < grid.north)
    reference = np.full(grid.shape, -np.inf)
    np.maximum.at(reference, grid.cells(x[inside], y[inside]), z[inside])
    both = np.isfinite(reference) & np.isfinite(dsm)
    assert both.sum() > 0.8 * np.isfinite(reference).sum()
    difference = (dsm - reference)[both]
    # Both have the absolute height of an uncorrected GNSS receiver.
    assert np.abs(np.median(difference)) < GNSS_HEIGHT_M
    assert _nmad(difference) < 0.6
    # Two calibrations of a lens differ by a quadratic surface; the residual is the error of the stereo.
    row, col = (axis[both] / 100 for axis in np.indices(grid.shape))
    bowl = np.stack([np.ones(len(difference)), col, row, col**2, col * row, row**2], axis=1)
    inlier = np.abs(difference - np.median(difference)) < 2
    fit = np.linalg.lstsq(bowl[inlier], difference[inlier], rcond=None)[0]
    residual = difference[inlier] - bowl[inlier] @ fit
    assert _nmad(residual) < 0.15


def _nmad(values):
    return 1.4826 * np.median(np.abs(values - np.median(values)))
