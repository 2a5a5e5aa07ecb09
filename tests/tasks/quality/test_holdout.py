"""Withheld squares of road do not enter the second fit, and the intervals of the estimate cover them."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.quality.estimate import INTERVAL
from flexroad.tasks.quality.holdout import INSET_M, holdout, withheld_squares
from flexroad.tasks.roads.dtm_validity import ground_to_fit
from flexroad.tools.prepare.points.to_rasters import Options
from flexroad.tools.synthetic import SceneOptions, make_scene
from flexroad.tools.synthetic.scene import scan
from tests.builders import given_heights, make_clusters, make_grid, make_mask, make_tile
from tests.make_clouds import rasterise

GRID = make_grid(250, 250)
EVERYWHERE = np.ones(GRID.shape, bool)


def test_withheld_squares_are_whole_inside_and_of_the_wanted_share():
    number = withheld_squares(EVERYWHERE, GRID, 0.2)
    squares, cells = np.unique(number[number >= 0], return_counts=True)
    assert set(cells) == {25}
    rows, cols = np.nonzero(number >= 0)
    assert min(rows.min(), cols.min(), 249 - rows.max(), 249 - cols.max()) >= INSET_M - 1
    inside = (250 - 2 * INSET_M) ** 2 / 25
    # Four standard deviations of a binomial distribution.
    assert len(squares) == pytest.approx(0.2 * inside, abs=4 * np.sqrt(0.2 * 0.8 * inside))


def test_withheld_squares_do_not_depend_on_tiling():
    moved = replace(GRID, west=GRID.west + 50)
    here = withheld_squares(EVERYWHERE, GRID, 0.2)[20:-20, 70:-20]
    there = withheld_squares(EVERYWHERE, moved, 0.2)[20:-20, 20:-70]
    np.testing.assert_array_equal(here, there)


def test_withheld_squares_need_road_cells():
    road = np.zeros(GRID.shape, bool)
    road[100:104] = True
    number = withheld_squares(road, GRID, 0.5)
    assert (number >= 0).any()
    for square in np.unique(number[number >= 0]):
        assert road[number == square].sum() >= 5


def test_holdout_without_squares_or_second_fit_counts_no_square():
    def refit(data, clusters):
        if not clusters.mask.any():
            raise AssertionError
        raise TaskError("fewer cells than control points")

    data, road, clusters = tile(1)
    assert np.isnan(holdout(data, road, clusters, refit, 0.3, 0.0)["holdout_squares"])
    assert holdout(data, road, clusters, refit, 0.3, 0.5)["holdout_squares"] == 0
    nowhere = replace(clusters, labels=np.zeros_like(clusters.labels))
    assert holdout(data, road, nowhere, refit, 0.3, 0.1)["holdout_squares"] == 0


def test_holdout_hides_squares_from_fit():
    data, road, clusters = tile(1)
    hidden = withheld_squares(clusters.mask, data.core, 0.2) >= 0

    def refit(rest, same):
        assert same is clusters
        assert np.isnan(rest.dsm[hidden]).all()
        assert np.isnan(rest.dtm[hidden]).all()
        np.testing.assert_array_equal(rest.dsm[~hidden], data.dsm[~hidden])
        return given_heights(ground_to_fit(data, clusters) + hidden, GRID)

    result = holdout(data, road, clusters, refit, 0.3, 0.2)
    assert result["holdout_squares"] > 10
    assert result["holdout_error_m"] == pytest.approx(1)
    assert result["holdout_covered"] == 0


@pytest.mark.slow
def test_intervals_cover_withheld_squares_of_scans_and_are_not_four_times_too_wide(monkeypatch):
    tiles = [tile(seed, scanned=True) for seed in range(20, 26)]
    assert covered(holdout(*one, refit, 0.3, 0.25) for one in tiles) > 0.85
    monkeypatch.setattr("flexroad.tasks.quality.holdout.INTERVAL", INTERVAL / 4)
    assert covered(holdout(*one, refit, 0.3, 0.25) for one in tiles) < 0.85


def refit(data, clusters):
    return smoothing_spline.fit(data, clusters, smoothing_spline.Options(bending_m3=30, spacing_m=3.6))


def covered(results: Iterable[dict[str, float]]) -> float:
    squares, shares = zip(*((one["holdout_squares"], one["holdout_covered"]) for one in results), strict=True)
    assert sum(squares) > 300
    return float(np.average(shares, weights=squares))


def tile(seed, scanned=False):
    scene = make_scene(GRID, seed, "suburban", SceneOptions(dsm_noise_m=(0.0, 0.0)))
    data, mask = make_tile(scene.dsm, scene.dtm), scene.reference_road
    if scanned:
        rasters = rasterise(scan(scene, per_m2=8, noise_m=0.03, seed=seed), GRID, Options(), None)
        data = replace(data, dsm=rasters.dsm, dtm=rasters.dtm, road_height=rasters.top.height)
    kept = mask & (np.abs(data.dsm - scene.reference) < 0.3)
    return data, make_mask(mask), make_clusters(kept)
