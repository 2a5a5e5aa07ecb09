"""The plane against planes."""

import math

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import plane
from flexroad.tasks.types import RoadClusters, Surface, TileData

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 0.5, 60, 40)
E, N = np.meshgrid(GRID.eastings, GRID.northings)
TRUTH = 163 + 0.03 * (E - 295500) - 0.04 * (N - 5629480)


def fitted(dsm, dtm, road):
    return plane.fit(TileData("t", GRID, GRID, dsm, dtm), RoadClusters(GRID, road), plane.Options())


def road(rows=slice(10, 20)):
    labels = np.zeros(GRID.shape, np.int32)
    labels[rows] = 1
    return labels


def test_it_is_the_plane_of_the_road_cells():
    dsm = np.where(road() > 0, TRUTH, np.nan)
    dsm[12, 3:9] = np.nan
    surface = fitted(dsm, TRUTH + 100, road())
    assert isinstance(surface, Surface)
    assert not surface.from_dtm
    assert surface.bounds == GRID.hull
    np.testing.assert_allclose(surface.lattice(GRID.eastings, GRID.northings), TRUTH, atol=1e-9)
    np.testing.assert_allclose(surface.height(E[3], N[3]), TRUTH[3], atol=1e-9)
    expected = np.array([-0.03, 0.04, 1]) / math.hypot(0.03, 0.04, 1)
    np.testing.assert_allclose(surface.normal(E, N), np.broadcast_to(expected, (*E.shape, 3)), atol=1e-9)


def test_no_other_plane_is_nearer():
    noisy = TRUTH + np.random.default_rng(0).normal(0, 0.3, GRID.shape)
    surface = fitted(noisy, TRUTH, road(slice(None)))
    residual = noisy - surface.height(E, N)
    # Normal equations: residuals are orthogonal to everything a plane can add.
    for way in (np.ones_like(E), E - E.mean(), N - N.mean()):
        assert (residual * way).mean() == pytest.approx(0, abs=1e-9)


def test_without_road_heights_the_dtm_stands_in_and_it_is_told():
    for dsm, labels in ((TRUTH + 5, road(slice(0))), (np.full(GRID.shape, np.nan), road())):
        surface = fitted(dsm, TRUTH, labels)
        assert surface.from_dtm
        np.testing.assert_allclose(surface.height(E, N), TRUTH, atol=1e-9)


def test_one_cell_gives_a_level_plane_and_a_line_one_level_across():
    one = road(slice(0))
    one[7, 8] = 1
    np.testing.assert_allclose(fitted(TRUTH, TRUTH, one).height(E, N), TRUTH[7, 8], atol=1e-9)
    across = fitted(TRUTH, TRUTH, road(slice(7, 8)))
    np.testing.assert_allclose(across.slope, (0.03, 0), atol=1e-9)


def test_no_height_at_all_is_an_error():
    nothing = np.full(GRID.shape, np.nan)
    with pytest.raises(TaskError, match="neither the DSM on the road nor the DTM has a height"):
        fitted(nothing, nothing, road())
