"""The error estimate follows what a surface leaves of larger pieces of ground, not single wrong cells."""

import numpy as np
import pytest

from flexroad.tasks.quality.estimate import DSM_DTM_TOLERANCE_M, FACTOR, LEAST_M, error_estimate

SHAPE = (60, 60)
ROAD = np.ones(SHAPE, bool)
NOTHING = np.zeros(SHAPE)


def estimate(residual, road=ROAD, cell=1.0):
    return error_estimate(residual, NOTHING, NOTHING, road & np.isfinite(residual), road, cell)


@pytest.mark.parametrize("offset", [0.0, 0.05, -0.2])
def test_constant_residual_is_misfit(offset):
    np.testing.assert_allclose(estimate(np.full(SHAPE, offset)), LEAST_M + FACTOR * abs(offset), atol=1e-12)


def test_noise_of_cells_averages_out():
    noise = 0.05 * np.random.default_rng(0).standard_normal(SHAPE)
    assert estimate(noise).mean() < LEAST_M + 0.3 * FACTOR * 0.05


def test_single_cells_far_off_count_as_heights_of_the_same_ground_at_most():
    far = np.random.default_rng(1).random(SHAPE) < 0.1
    found = estimate(np.where(far, 4.0, 0.0)).mean()
    assert found == pytest.approx(LEAST_M + 0.1 * FACTOR * DSM_DTM_TOLERANCE_M, rel=0.1)
    assert found == pytest.approx(estimate(np.where(far, 40.0, 0.0)).mean())


def test_patch_far_off_is_estimated_larger_than_single_cells():
    patch = np.zeros(SHAPE)
    patch[20:40, 20:40] = 4.0
    assert estimate(patch)[28:32, 28:32].min() == pytest.approx(LEAST_M + FACTOR * DSM_DTM_TOLERANCE_M)


def test_cells_without_height_rise_with_distance_to_the_nearest():
    residual = np.zeros(SHAPE)
    residual[:, 30:] = np.nan
    found = estimate(residual)
    assert found[:, :30] == pytest.approx(LEAST_M)
    assert (np.diff(found[30, 30:]) > 0).all()


def test_tile_without_heights_has_the_difference_of_heights_of_the_same_ground():
    assert (estimate(np.full(SHAPE, np.nan)) == DSM_DTM_TOLERANCE_M).all()
