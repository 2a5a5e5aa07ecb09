import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.ndimage import gaussian_filter

from flexroad.tasks.filter.ecsrc import Options, ecsrc
from flexroad.tasks.types import RoadClusters
from tests.builders import make_mask, make_tile
from tests.tasks.filter import ecsrc_oracle as oracle

KEEP_ALL = Options(min_area_m2=0, keep_largest=None)


def cluster(mask, dsm, options=KEEP_ALL, cell=1.0) -> RoadClusters:
    return ecsrc(make_tile(dsm, cell=cell), make_mask(mask, cell), options)


def streets(rng, n=60, share=0.25):
    """Return a mask with blobs of road and a DSM of hills with steps as at crowns and cars."""
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


def test_ecsrc_roof_above_street_is_dropped_and_gaps_up_to_the_threshold_are_bridged():
    """Known answers, in case that both implementations are wrong in the same way."""
    gaps = np.zeros((3, 30), bool)
    gaps[1, [0, 10, 21]] = True
    assert cluster(gaps, np.zeros(gaps.shape)).labels[1, [0, 10, 21]].tolist() == [1, 1, 2]
    mask = np.zeros((40, 40), bool)
    mask[10:16] = True
    dsm = np.full(mask.shape, 150.0)
    dsm[10:13, 20:25] = 156.0
    result = cluster(mask, dsm, Options())
    np.testing.assert_array_equal(result.mask, mask & (dsm == 150))


def test_off_keeps_every_road_cell_with_height():
    mask, dsm = streets(np.random.default_rng(0))
    dsm[::7] = np.nan
    result = cluster(mask, dsm, Options(method="off"))
    np.testing.assert_array_equal(result.labels, mask & ~np.isnan(dsm))
    assert result.labels.dtype == np.int32
    assert not cluster(np.zeros((5, 5), bool), np.zeros((5, 5)), Options(method="off")).mask.any()
