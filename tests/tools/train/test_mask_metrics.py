import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sklearn.metrics import f1_score, jaccard_score, precision_score, recall_score

from flexroad.catalog import Grid
from flexroad.tools.train.mask_metrics import edges, judge, together

shapes = st.tuples(st.integers(1, 12), st.integers(1, 12))


def grid(shape, cell=1.0):
    return Grid("EPSG:25832", 0.0, 0.0, cell, shape[1], shape[0])


@st.composite
def cases(draw):
    shape = draw(shapes)
    result, truth, known = (draw(arrays.arrays(bool, shape)) for _ in range(3))
    probability = draw(arrays.arrays(np.float32, shape, elements=st.integers(0, 100).map(lambda p: p / 100)))
    return result, truth, known, probability


@given(cases())
def test_judge_figures_and_curve_match_scikit_learn(case):
    result, truth, known, probability = case
    quality = judge(result, probability, truth, known, grid(result.shape))
    for name, peer in (
        ("iou", jaccard_score),
        ("precision", precision_score),
        ("recall", recall_score),
        ("f1", f1_score),
    ):
        # For a division by 0 scikit-learn gives 0, FlexRoad NaN.
        expected = peer(truth[known], result[known], zero_division=0) if known.any() else 0
        assert np.nan_to_num(getattr(quality, name)) == pytest.approx(expected), name
    thresholds, precision, recall = quality.curve()
    for i in (0, 37, 100):
        mask = probability >= thresholds[i] - 1e-6
        at_threshold = judge(mask, None, truth, known, grid(result.shape))
        assert precision[i] == pytest.approx(at_threshold.precision, nan_ok=True)
        assert recall[i] == pytest.approx(at_threshold.recall, nan_ok=True)


@given(cases(), cases())
def test_together_adds_counts_of_tiles(a, b):
    parts = [judge(f, p, t, k, grid(f.shape)) for f, t, k, p in (a, b)]
    whole = together(parts)
    assert whole.right == sum(part.right for part in parts)
    assert whole.road_by_probability.sum() == whole.right + whole.missed
    assert whole.edge_m.size == sum(part.edge_m.size for part in parts)


@pytest.mark.parametrize("cell", [1.0, 0.2])
def test_judge_shifted_road_edge_distance_is_shift(cell):
    truth = np.zeros((40, 40), bool)
    truth[:, 10:18] = True
    known = np.ones_like(truth)
    quality = judge(np.roll(truth, 3, axis=1), None, truth, known, grid(truth.shape, cell))
    assert quality.edge_mean_m == pytest.approx(3 * cell)
    assert quality.edge_p95_m == pytest.approx(3 * cell)


def test_edges_need_two_valid_cells():
    mask = np.zeros((4, 6), bool)
    mask[:, 3:] = True
    known = np.ones_like(mask)
    np.testing.assert_array_equal(edges(mask, known), [[row, 2.5] for row in range(4)])
    known[1:] = False
    np.testing.assert_array_equal(edges(mask, known), [[0, 2.5]])
    assert np.isnan(judge(~known, None, known & False, known, grid(mask.shape)).edge_mean_m)
