import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.ndimage import gaussian_filter

from flexroad.catalog.grid import Grid
from flexroad.tasks.filter.ecsrc import Options, ecsrc
from flexroad.tasks.types import RoadClusters, RoadMask, TileData
from tests.tasks.filter import ecsrc_oracle as oracle

EVERYTHING = Options(min_area_m2=0, keep_largest=None)


def cluster(mask, dsm, options=EVERYTHING, cell=1.0) -> RoadClusters:
    mask, dsm = np.asarray(mask, bool), np.asarray(dsm, float)
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, cell, mask.shape[1], mask.shape[0])
    data = TileData("t", grid, grid, dsm, dsm)
    return ecsrc(data, RoadMask(grid, grid, mask, np.zeros_like(mask)), options)


def streets(rng, n=60, share=0.25):
    """Blobs of road over rolling ground with steps, as crowns and cars make them."""
    field = gaussian_filter(rng.standard_normal((n, n)), 2)
    ground = gaussian_filter(rng.standard_normal((n, n)), 6) * 20
    objects = (gaussian_filter(rng.standard_normal((n, n)), 1) > 0.3) * rng.uniform(0, 3, (n, n))
    return field > np.quantile(field, 1 - share), 150 + ground + objects


masks = arrays.arrays(bool, st.tuples(st.integers(1, 14), st.integers(1, 14)))
# Heights in 1/8 m are exact in binary: a constant can be added and thresholds hit without rounding.
heights = st.one_of(st.integers(0, 24).map(lambda eighths: eighths / 8), st.just(np.nan))
thresholds = st.builds(
    Options,
    theta_xy_m=st.sampled_from([0.0, 1.0, 1.5, 2.0, 5.0, 10.0]),
    theta_z_m=st.sampled_from([0.125, 0.5, 1.0]),
    min_area_m2=st.sampled_from([0.0, 1.0, 3.0, 12.5]),
    keep_largest=st.sampled_from([None, 1, 3]),
)


@st.composite
def cases(draw):
    mask = draw(masks)
    return mask, draw(arrays.arrays(float, mask.shape, elements=heights))


@given(cases(), thresholds, st.sampled_from([1.0, 0.5, 0.2]))
@settings(max_examples=300, deadline=None)
def test_labels_are_those_of_algorithm_1(case, options, cell):
    mask, dsm = case
    found = cluster(mask, dsm, options, cell)
    np.testing.assert_array_equal(found.labels, oracle.labels(mask, dsm, cell, options))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("options", [Options(), Options(theta_z_m=0.1, min_area_m2=5, keep_largest=4)])
def test_labels_are_those_of_algorithm_1_on_streets(seed, options):
    mask, dsm = streets(np.random.default_rng(seed))
    found = cluster(mask, dsm, options)
    assert found.labels.max() > 0
    np.testing.assert_array_equal(found.labels, oracle.labels(mask, dsm, 1.0, options))


@given(cases())
@settings(deadline=None)
def test_growth_is_implied_by_the_merge(case):
    mask, dsm = case
    heights = oracle.points(mask, dsm)
    alone = oracle.merge(heights, {point: n for n, point in enumerate(heights)}, 2.0, 0.5, 1.0)
    alone = oracle.clean(alone, 1.0, 0, None)
    found = cluster(mask, dsm, Options(theta_xy_m=2.0, min_area_m2=0, keep_largest=None)).labels
    assert {point: found[point] for point in heights} == alone


@given(cases(), thresholds, st.integers(-400, 4000))
@settings(deadline=None)
def test_a_constant_height_changes_nothing(case, options, constant):
    mask, dsm = case
    np.testing.assert_array_equal(
        cluster(mask, dsm, options).labels, cluster(mask, dsm + constant, options).labels
    )


@given(cases(), st.sampled_from([np.flipud, np.fliplr, np.transpose]))
@settings(deadline=None)
def test_a_mirrored_tile_has_mirrored_clusters(case, turn):
    mask, dsm = case
    here = turn(cluster(mask, dsm).labels)
    there = cluster(turn(mask), turn(dsm)).labels
    pairs = set(zip(here.ravel().tolist(), there.ravel().tolist(), strict=True))
    assert len(pairs) == len(set(here.ravel())) == len(set(there.ravel()))


def test_gaps_up_to_the_threshold_are_bridged():
    mask = np.zeros((3, 30), bool)
    mask[1, [0, 10, 21]] = True
    assert cluster(mask, np.zeros(mask.shape)).labels[1, [0, 10, 21]].tolist() == [1, 1, 2]


def test_any_pair_merges_clusters_that_lie_far_apart_elsewhere():
    ramp = np.arange(12.0)[None, :] * 0.5
    mask = np.ones((1, 12), bool)
    assert cluster(mask, ramp).labels.max() == 1
    assert (
        cluster(mask, ramp * 1.1, Options(theta_xy_m=1, min_area_m2=0, keep_largest=None)).labels.max() == 12
    )


def test_a_roof_above_the_street_is_dropped():
    mask = np.zeros((40, 40), bool)
    mask[10:16] = True
    dsm = np.full(mask.shape, 150.0)
    dsm[10:13, 20:25] = 156.0
    found = cluster(mask, dsm, Options())
    np.testing.assert_array_equal(found.mask, mask & (dsm == 150))


def test_area_is_in_square_metres():
    mask = np.zeros((40, 60), bool)
    mask[:10, :5] = mask[20:30, 10:15] = mask[20:30, 40:44] = True
    options = Options(min_area_m2=50, theta_xy_m=1)
    assert cluster(mask, np.zeros(mask.shape), options).mask.sum() == 100
    half = Options(min_area_m2=0.5, theta_xy_m=0.1)
    assert cluster(mask, np.zeros(mask.shape), half, cell=0.1).mask.sum() == 100


def test_of_equal_clusters_the_first_is_kept():
    mask = np.zeros((1, 40), bool)
    mask[0, [0, 1, 15, 16, 30, 31, 32]] = True
    options = Options(min_area_m2=0, keep_largest=2)
    assert np.flatnonzero(cluster(mask, np.zeros(mask.shape), options).labels == 1).tolist() == [0, 1]
    assert np.flatnonzero(cluster(mask, np.zeros(mask.shape), options).labels == 2).tolist() == [30, 31, 32]


def test_off_keeps_every_road_cell_with_a_height():
    mask, dsm = streets(np.random.default_rng(0))
    dsm[::7] = np.nan
    found = cluster(mask, dsm, Options(method="off"))
    np.testing.assert_array_equal(found.labels, mask & ~np.isnan(dsm))
    assert found.labels.dtype == np.int32


@pytest.mark.parametrize("variant", ["paper", "off"])
def test_no_road_has_no_cluster(variant):
    assert not cluster(np.zeros((5, 5)), np.zeros((5, 5)), Options(method=variant)).mask.any()


def test_what_is_too_small_leaves_nothing():
    mask = np.zeros((5, 5), bool)
    mask[2, 2] = True
    assert not cluster(mask, np.zeros((5, 5)), Options()).mask.any()
