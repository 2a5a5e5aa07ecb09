"""Distances to the nearest cell of a mask, against scipy's distance transform."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.ndimage import distance_transform_edt

from flexroad.tasks.roads.distances import distances, filled, within

MASKS = arrays.arrays(bool, st.tuples(st.integers(1, 24), st.integers(1, 24)))


@pytest.mark.parametrize("shape", [(40, 37), (1, 30), (30, 1)])
@pytest.mark.parametrize("share", [0.0005, 0.02, 0.5, 1.0])
def test_distances_random_mask_equal_distance_transform(shape, share):
    rng = np.random.default_rng(7)
    mask, wanted = rng.random(shape) < share, rng.random(shape) < 0.6
    mask[rng.integers(shape[0]), rng.integers(shape[1])] = True
    np.testing.assert_array_equal(distances(wanted, mask), distance_transform_edt(~mask)[wanted])
    assert np.isinf(distances(wanted, np.zeros_like(mask))).all()


@pytest.mark.parametrize("share", [0.01, 0.1, 0.5, 0.9])
def test_filled_gaps_equal_feature_transform(share):
    """Also where several values are equally near."""
    rng = np.random.default_rng(3)
    values = rng.permutation(60 * 41).reshape(60, 41).astype(float)
    missing = rng.random(values.shape) >= share
    gaps = np.where(missing, np.nan, values)
    nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
    np.testing.assert_array_equal(filled(gaps), values[tuple(nearest)])
    assert np.isnan(filled(np.full_like(gaps, np.nan))).all()


@given(MASKS, st.sampled_from([1.0, 0.5, 0.2, 0.1]), st.sampled_from([0.0, 0.3, 0.7, 1.0, 2.5, 50.0]))
def test_within_measures_between_cell_centres(mask, cell, reach):
    if mask.any():
        distance = distance_transform_edt(~mask) * cell
        np.testing.assert_array_equal(within(mask, cell, reach), distance <= reach + 1e-6)
    else:
        assert not within(mask, cell, reach).any()
