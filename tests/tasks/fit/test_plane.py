"""The fitted plane against known planes."""

import math

import numpy as np
import pytest

from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import plane
from tests.builders import make_clusters, make_grid, make_tile

GRID = make_grid(60, 40, 0.5)
E, N = np.meshgrid(GRID.eastings, GRID.northings)
TRUTH = 163 + 0.03 * (E - 295500) - 0.04 * (N - 5629480)


def fitted(dsm, dtm, road):
    return plane.fit(make_tile(dsm, dtm, 0.5), make_clusters(road, 0.5), plane.Options())


def road(rows=slice(10, 20)):
    labels = np.zeros(GRID.shape, np.int32)
    labels[rows] = 1
    return labels


def test_fit_road_on_plane_returns_that_plane():
    dsm = np.where(road() > 0, TRUTH, np.nan)
    dsm[12, 3:9] = np.nan
    surface = fitted(dsm, TRUTH + 100, road())
    assert not surface.from_dtm
    assert surface.bounds == GRID.hull
    np.testing.assert_allclose(surface.lattice(GRID.eastings, GRID.northings), TRUTH, atol=1e-9)
    np.testing.assert_allclose(surface.height(E[3], N[3]), TRUTH[3], atol=1e-9)
    expected = np.array([-0.03, 0.04, 1]) / math.hypot(0.03, 0.04, 1)
    np.testing.assert_allclose(surface.normal(E, N), np.broadcast_to(expected, (*E.shape, 3)), atol=1e-9)


def test_fit_residuals_satisfy_normal_equations():
    noisy = TRUTH + np.random.default_rng(0).normal(0, 0.3, GRID.shape)
    surface = fitted(noisy, TRUTH, road(slice(None)))
    residual = noisy - surface.height(E, N)
    # Normal equations: residuals are orthogonal to every plane.
    for plane_term in (np.ones_like(E), E - E.mean(), N - N.mean()):
        assert (residual * plane_term).mean() == pytest.approx(0, abs=1e-9)


def test_fit_without_road_heights_uses_dtm_and_sets_flag():
    for dsm, labels in ((TRUTH + 5, road(slice(0))), (np.full(GRID.shape, np.nan), road())):
        surface = fitted(dsm, TRUTH, labels)
        assert surface.from_dtm
        np.testing.assert_allclose(surface.height(E, N), TRUTH, atol=1e-9)


def test_fit_degenerate_road_is_level_where_undetermined():
    one_cell = road(slice(0))
    one_cell[7, 8] = 1
    np.testing.assert_allclose(fitted(TRUTH, TRUTH, one_cell).height(E, N), TRUTH[7, 8], atol=1e-9)
    across = fitted(TRUTH, TRUTH, road(slice(7, 8)))
    np.testing.assert_allclose(across.slope, (0.03, 0), atol=1e-9)


def test_fit_without_any_height_raises():
    no_heights = np.full(GRID.shape, np.nan)
    with pytest.raises(TaskError, match="neither the DSM on the road nor the DTM has a height"):
        fitted(no_heights, no_heights, road())
