"""Flat patches, compared with least squares by NumPy."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.roads.flat_patches import flat_patches


@given(st.integers(0, 10_000))
@settings(max_examples=10)
def test_flat_patches_equal_least_squares(seed):
    rng = np.random.default_rng(seed)
    row, col = np.indices((40, 40))
    dsm = 0.05 * row - 0.02 * col + rng.normal(0, 0.08, row.shape) + (rng.random(row.shape) < 0.02)
    mask = rng.random(dsm.shape) < 0.97
    result, *_ = flat_patches(dsm, mask, 1.0, 0.1, 1e9)
    row, col = np.mgrid[-1:2, -1:2]
    design = np.column_stack([np.ones(9), row.ravel(), col.ravel()])
    for r, c in np.ndindex(dsm.shape):
        window = (slice(r - 1, r + 2), slice(c - 1, c + 2))
        whole = min(r, c) > 0 and mask[window].shape == (3, 3) and mask[window].all()
        if whole:
            residual = np.linalg.lstsq(design, dsm[window].ravel(), rcond=None)[1][0]
            assert result[r, c] == (residual / 6 <= 0.1**2)
        else:
            assert not result[r, c]
