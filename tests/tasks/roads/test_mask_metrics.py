import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sklearn.metrics import f1_score, jaccard_score, precision_score, recall_score

from flexroad.catalog import Grid
from flexroad.tasks.roads.mask_metrics import edges, judge, together

shapes = st.tuples(st.integers(1, 12), st.integers(1, 12))


def grid(shape, cell=1.0):
    return Grid("EPSG:25832", 0.0, 0.0, cell, shape[1], shape[0])


@st.composite
def cases(draw):
    shape = draw(shapes)
    found, truth, known = (draw(arrays.arrays(bool, shape)) for _ in range(3))
    probability = draw(arrays.arrays(np.float32, shape, elements=st.integers(0, 100).map(lambda p: p / 100)))
    return found, truth, known, probability


@given(cases())
@settings(deadline=None)
def test_figures_and_curve_are_those_of_scikit_learn(case):
    found, truth, known, probability = case
    quality = judge(found, probability, truth, known, grid(found.shape))
    for name, peer in (
        ("iou", jaccard_score),
        ("precision", precision_score),
        ("recall", recall_score),
        ("f1", f1_score),
    ):
        # Where there is nothing to divide by they say 0 and we NaN.
        expected = peer(truth[known], found[known], zero_division=0) if known.any() else 0
        assert np.nan_to_num(getattr(quality, name)) == pytest.approx(expected), name
    thresholds, precision, recall = quality.curve()
    for i in (0, 37, 100):
        mask = probability >= thresholds[i] - 1e-6
        there = judge(mask, None, truth, known, grid(found.shape))
        assert precision[i] == pytest.approx(there.precision, nan_ok=True)
        assert recall[i] == pytest.approx(there.recall, nan_ok=True)


@given(cases(), cases())
@settings(deadline=None)
def test_tiles_add_up(a, b):
    parts = [judge(f, p, t, k, grid(f.shape)) for f, t, k, p in (a, b)]
    whole = together(parts)
    assert whole.right == sum(part.right for part in parts)
    assert whole.road_by_probability.sum() == whole.right + whole.missed
    assert whole.edge_m.size == sum(part.edge_m.size for part in parts)


@pytest.mark.parametrize("cell", [1.0, 0.2])
def test_a_road_found_aside_has_its_edges_off_by_that(cell):
    truth = np.zeros((40, 40), bool)
    truth[:, 10:18] = True
    known = np.ones_like(truth)
    quality = judge(np.roll(truth, 3, axis=1), None, truth, known, grid(truth.shape, cell))
    assert quality.edge_mean_m == pytest.approx(3 * cell)
    assert quality.edge_p95_m == pytest.approx(3 * cell)


def test_where_nothing_is_known_is_no_edge():
    mask = np.zeros((4, 6), bool)
    mask[:, 3:] = True
    known = np.ones_like(mask)
    np.testing.assert_array_equal(edges(mask, known), [[row, 2.5] for row in range(4)])
    known[1:] = False
    np.testing.assert_array_equal(edges(mask, known), [[0, 2.5]])
    assert np.isnan(judge(~known, None, known & False, known, grid(mask.shape)).edge_mean_m)
