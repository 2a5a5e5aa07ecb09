"""Heights that roads are fitted to, and the fit on synthetic scans with a scanner's noise."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from flexroad.catalog import Grid
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.quality import assess
from flexroad.tasks.roads.road_height import dsm_offset, with_road_heights
from flexroad.tasks.types import RoadClusters, TileData
from flexroad.tools.prepare.points.to_rasters import Options as Rastering
from flexroad.tools.synthetic import SceneOptions, make_scene
from flexroad.tools.synthetic.scene import scan
from tests.builders import filtered, make_frame
from tests.make_clouds import rasterise

GRID = Grid("EPSG:25832", 500000, 5600300, 1.0, 300, 300)
AROUND_M = 75
CORE = Grid("EPSG:25832", 500000 + AROUND_M, 5600300 - AROUND_M, 1.0, 150, 150)
NOISE_M = 0.03


def flat(road, excess, deck=0.0):
    """A plane with a DSM above it, by cell, and a DTM without its deck."""
    ground = 100 + 0.03 * np.arange(GRID.width) + np.zeros(GRID.shape)
    return TileData("t", GRID, GRID, ground + deck + excess, ground), RoadClusters(
        GRID, road.astype(np.int32)
    )


def test_dsm_offset_is_local_median_on_open_road():
    rng = np.random.default_rng(0)
    excess = np.where(np.arange(300) < 150, 0.02, 0.08) + rng.normal(0, 0.02, GRID.shape)
    road = np.zeros(GRID.shape, bool)
    road[100:110], road[:, 20:26], road[:, 250:256] = True, True, True
    # Cars that the filter kept, a deck, and DSM without road say nothing.
    excess[100:104, 30:60] += 0.5
    excess[~road] = 7.0
    data, clusters = flat(road, excess, deck=np.where(np.arange(300)[:, None] > 280, 5.0, 0.0))
    offset = dsm_offset(data, clusters.mask)
    assert np.abs(offset - 0.02)[:, :100][road[:, :100]].max() < 0.01
    assert np.abs(offset - 0.08)[:, 200:][road[:, 200:]].max() < 0.01
    assert np.isfinite(offset).all()
    # Without open road it is 0.
    assert not dsm_offset(data, np.zeros_like(road)).any()


def test_dsm_offset_of_part_equals_that_of_whole_inside():
    rng = np.random.default_rng(1)
    data, clusters = flat(np.ones(GRID.shape, bool), rng.normal(0.04, 0.03, GRID.shape))
    whole = dsm_offset(data, clusters.mask)
    grid = Grid(GRID.crs, GRID.west + 30, GRID.north - 20, 1.0, 230, 250)
    cut = GRID.window(grid)
    part = replace(data, grid=grid, core=grid, dsm=data.dsm[cut], dtm=data.dtm[cut])
    inner = np.s_[70:-70, 70:-70]
    np.testing.assert_allclose(dsm_offset(part, clusters.mask[cut])[inner], whole[cut][inner], atol=1e-12)


def test_with_road_heights_changes_filtered_road_alone():
    road = np.zeros(GRID.shape, bool)
    road[:50] = True
    data, clusters = flat(road, 0.05)
    assert with_road_heights(data, clusters) is data
    layer = data.dsm - 0.04
    layer[0, 0] = np.nan
    fitted = with_road_heights(replace(data, road_height=layer), clusters)
    expected = np.where(road, layer, data.dsm)
    expected[0, 0] = data.dsm[0, 0]
    np.testing.assert_array_equal(fitted.dsm, expected)
    np.testing.assert_allclose(
        with_road_heights(replace(data, offset_dsm=True), clusters).dsm, data.dsm - 0.05 * road
    )


def scanned(seed, stratum):
    scene = make_scene(GRID, seed, stratum, SceneOptions(dsm_noise_m=(0.0, 0.0), scars_m=0.0))
    rasters = rasterise(scan(scene, 12, NOISE_M), GRID, Rastering(), None)
    data = TileData("t", GRID, CORE, rasters.dsm, rasters.dtm, scene.road_mask)
    return scene, data, rasters.top.height


def surface_of(data):
    """Fit the corners, the edges and the tile, as in a run."""
    options = smoothing_spline.Options()
    frame = make_frame(partial(filtered, data), CORE, AROUND_M, options)
    return smoothing_spline.fit(data, filtered(data, GRID, CORE)[2], options, frame)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "stratum"), [(3, "urban"), (4, "suburban"), (5, "rural")])
def test_road_of_noisy_scan_is_unbiased_with_layer_and_offset_and_not_with_dsm(seed, stratum):
    scene, data, layer = scanned(seed, stratum)
    core = GRID.window(CORE)
    kept = filtered(data, GRID, CORE)[2].mask[core] & scene.reference_road[core]
    truth = scene.reference[core]
    rim = np.ones(CORE.shape, bool)
    rim[8:-8, 8:-8] = False
    bias, at_rim = {}, {}
    for name, chosen in (
        ("dsm", data),
        ("layer", replace(data, road_height=layer)),
        ("offset", replace(data, offset_dsm=True)),
    ):
        off = surface_of(chosen).lattice(CORE.eastings, CORE.northings) - truth
        bias[name], at_rim[name] = off[kept].mean(), off[kept & rim].mean()
    assert bias["dsm"] > 1.3 * NOISE_M
    assert abs(bias["layer"]) < 0.005
    assert abs(bias["offset"]) < 0.01
    # The control points on the border are fitted to the same heights.
    assert abs(at_rim["layer"]) < 0.01 < at_rim["dsm"]


@pytest.mark.slow
def test_assess_compares_with_the_heights_that_the_road_was_fitted_to():
    _, data, layer = scanned(3, "urban")
    for chosen, excess in ((data, 0.0), (replace(data, road_height=layer), 1.6 * NOISE_M)):
        _, road, clusters = filtered(chosen, GRID, CORE)
        surface = smoothing_spline.fit(chosen, clusters, smoothing_spline.Options())
        quality = assess.assess(chosen, road, clusters, surface, assess.Options())
        assert abs(quality.residual_median_m) < 0.004
        assert quality.dsm_excess_m == pytest.approx(excess, abs=0.01)
