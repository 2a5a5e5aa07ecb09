"""Triangulations with given edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.meshing.triangulate import constrained, delaunay


def edges_of(faces):
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return set(map(tuple, pairs.tolist()))


def doubled_areas(points, faces):
    a, b, c = (points[faces[:, k]] for k in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def crosses(p, q, r, s):
    def side(a, b, c):
        return np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    return side(p, q, r) * side(p, q, s) < 0 and side(r, s, p) * side(r, s, q) < 0


def test_constrained_long_edge_through_lattice_is_there():
    x, y = np.meshgrid(np.arange(11.0), np.arange(11.0))
    points = np.vstack([np.stack([x, y], axis=-1).reshape(-1, 2), [0.3, 0.4], [9.7, 8.1]])
    ends = len(points) - 2, len(points) - 1
    faces = constrained(points, np.array([ends]))
    assert ends not in edges_of(delaunay(points))
    assert ends in edges_of(faces)
    assert doubled_areas(points, faces).min() > 0
    assert doubled_areas(points, faces).sum() == pytest.approx(200)


def test_constrained_segment_through_points_is_several_edges():
    points = np.array(
        [[0, 0], [3, 0], [3, 2], [0, 2], [1, 1], [2, 1], [0, 1], [3, 1], [1.5, 1.2], [1.5, 0.8]], float
    )
    edges = edges_of(constrained(points, np.array([[6, 7]])))
    assert {(4, 6), (4, 5), (5, 7)} <= edges


def test_constrained_without_segments_is_delaunay():
    points = np.random.default_rng(0).uniform(0, 10, (50, 2))
    np.testing.assert_array_equal(constrained(points, np.empty((0, 2), int)), delaunay(points))


def test_constrained_crossing_segment_is_left_out():
    points = np.array([[0, 0], [4, 0], [4, 4], [0, 4], [2, 1], [2, 3], [1, 2], [3, 2]], float)
    faces = constrained(points, np.array([[4, 5], [6, 7]]))
    assert ((4, 5) in edges_of(faces)) != ((6, 7) in edges_of(faces))
    assert doubled_areas(points, faces).sum() == 32


@settings(deadline=None, max_examples=150)
@given(seed=st.integers(0, 2**31), count=st.integers(3, 60), on_lattice=st.booleans())
def test_constrained_has_all_segments_that_do_not_cross(seed, count, on_lattice):
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 12, (count, 2)).astype(float) if on_lattice else rng.uniform(0, 12, (count, 2))
    points = np.unique(np.vstack([points, [[0, 0], [12, 0], [12, 12], [0, 12]]]), axis=0)
    segments = []
    for a, b in rng.integers(0, len(points), (40, 2)).tolist():
        line = points[b] - points[a]
        off = np.abs(line[0] * (points - points[a])[:, 1] - line[1] * (points - points[a])[:, 0])
        along = ((points - points[a]) @ line) / max(line @ line, 1e-9)
        hits = ((off < 1e-9) & (along > 0) & (along < 1)).any()
        if a != b and not hits and not any(crosses(*points[[a, b]], *points[list(s)]) for s in segments):
            segments.append((min(a, b), max(a, b)))
    faces = constrained(points, np.array(segments).reshape(-1, 2))
    assert set(segments) <= edges_of(faces)
    areas = doubled_areas(points, faces)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(288)
    assert set(np.unique(faces)) == set(range(len(points)))
