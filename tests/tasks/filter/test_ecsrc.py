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

KEEP_ALL = Options(min_area_m2=0, keep_largest=None)


def cluster(mask, dsm, options=KEEP_ALL, cell=1.0) -> RoadClusters:
    mask, dsm = np.asarray(mask, bool), np.asarray(dsm, float)
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, cell, mask.shape[1], mask.shape[0])
    data = TileData("t", grid, grid, dsm, dsm)
    return ecsrc(data, RoadMask(grid, grid, mask, np.zeros_like(mask)), options)


def streets(rng, n=60, share=0.25):
    """Return a mask with blobs of road and a DSM of hills with steps like those of crowns and cars."""
    field = gaussian_filter(rng.standard_normal((n, n)), 2)
    ground = gaussian_filter(rng.standard_normal((n, n)), 6) * 20
    objects = (gaussian_filter(rng.standard_normal((n, n)), 1) > 0.3) * rng.uniform(0, 3, (n, n))
    return field > np.quantile(field, 1 - share), 150 + ground + objects


masks = arrays.arrays(bool, st.tuples(st.integers(1, 14), st.integers(1, 14)))
# Multiples of 1/8 m are exact in binary: adding a constant or comparing with a threshold does not round.
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
@settings(max_examples=300)
def test_ecsrc_any_input_equals_algorithm_1(case, options, cell):
    mask, dsm = case
    result = cluster(mask, dsm, options, cell)
    np.testing.assert_array_equal(result.labels, oracle.labels(mask, dsm, cell, options))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("options", [Options(), Options(theta_z_m=0.1, min_area_m2=5, keep_largest=4)])
def test_ecsrc_streets_equals_algorithm_1(seed, options):
    mask, dsm = streets(np.random.default_rng(seed))
    result = cluster(mask, dsm, options)
    assert result.labels.max() > 0
    np.testing.assert_array_equal(result.labels, oracle.labels(mask, dsm, 1.0, options))


@given(cases())
def test_merge_without_growth_gives_same_labels(case):
    mask, dsm = case
    heights = oracle.points(mask, dsm)
    expected = oracle.merge(heights, {point: n for n, point in enumerate(heights)}, 2.0, 0.5, 1.0)
    expected = oracle.clean(expected, 1.0, 0, None)
    result = cluster(mask, dsm, Options(theta_xy_m=2.0, min_area_m2=0, keep_largest=None)).labels
    assert {point: result[point] for point in heights} == expected


@given(cases(), thresholds, st.integers(-400, 4000))
def test_ecsrc_constant_added_keeps_labels(case, options, constant):
    mask, dsm = case
    np.testing.assert_array_equal(
        cluster(mask, dsm, options).labels, cluster(mask, dsm + constant, options).labels
    )


@given(cases(), st.sampled_from([np.flipud, np.fliplr, np.transpose]))
def test_ecsrc_mirrored_tile_gives_mirrored_clusters(case, mirror):
    mask, dsm = case
    mirrored = mirror(cluster(mask, dsm).labels)
    of_mirrored = cluster(mirror(mask), mirror(dsm)).labels
    pairs = set(zip(mirrored.ravel().tolist(), of_mirrored.ravel().tolist(), strict=True))
    assert len(pairs) == len(set(mirrored.ravel())) == len(set(of_mirrored.ravel()))


def test_merge_bridges_gaps_up_to_threshold():
    mask = np.zeros((3, 30), bool)
    mask[1, [0, 10, 21]] = True
    assert cluster(mask, np.zeros(mask.shape)).labels[1, [0, 10, 21]].tolist() == [1, 1, 2]


def test_merge_needs_one_near_pair_of_cells():
    ramp = np.arange(12.0)[None, :] * 0.5
    mask = np.ones((1, 12), bool)
    assert cluster(mask, ramp).labels.max() == 1
    assert (
        cluster(mask, ramp * 1.1, Options(theta_xy_m=1, min_area_m2=0, keep_largest=None)).labels.max() == 12
    )


def test_ecsrc_roof_above_street_is_dropped():
    mask = np.zeros((40, 40), bool)
    mask[10:16] = True
    dsm = np.full(mask.shape, 150.0)
    dsm[10:13, 20:25] = 156.0
    result = cluster(mask, dsm, Options())
    np.testing.assert_array_equal(result.mask, mask & (dsm == 150))


def test_min_area_is_in_square_metres():
    mask = np.zeros((40, 60), bool)
    mask[:10, :5] = mask[20:30, 10:15] = mask[20:30, 40:44] = True
    options = Options(min_area_m2=50, theta_xy_m=1)
    assert cluster(mask, np.zeros(mask.shape), options).mask.sum() == 100
    half = Options(min_area_m2=0.5, theta_xy_m=0.1)
    assert cluster(mask, np.zeros(mask.shape), half, cell=0.1).mask.sum() == 100


def test_keep_largest_equal_sizes_keeps_first_cluster():
    mask = np.zeros((1, 40), bool)
    mask[0, [0, 1, 15, 16, 30, 31, 32]] = True
    options = Options(min_area_m2=0, keep_largest=2)
    assert np.flatnonzero(cluster(mask, np.zeros(mask.shape), options).labels == 1).tolist() == [0, 1]
    assert np.flatnonzero(cluster(mask, np.zeros(mask.shape), options).labels == 2).tolist() == [30, 31, 32]


def test_off_keeps_every_road_cell_with_height():
    mask, dsm = streets(np.random.default_rng(0))
    dsm[::7] = np.nan
    result = cluster(mask, dsm, Options(method="off"))
    np.testing.assert_array_equal(result.labels, mask & ~np.isnan(dsm))
    assert result.labels.dtype == np.int32


@pytest.mark.parametrize("variant", ["paper", "off"])
def test_ecsrc_empty_mask_gives_no_cluster(variant):
    assert not cluster(np.zeros((5, 5)), np.zeros((5, 5)), Options(method=variant)).mask.any()


def test_ecsrc_small_cluster_is_dropped():
    mask = np.zeros((5, 5), bool)
    mask[2, 2] = True
    assert not cluster(mask, np.zeros((5, 5)), Options()).mask.any()
