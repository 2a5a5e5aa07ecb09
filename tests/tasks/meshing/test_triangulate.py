"""Triangulations with given edges."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.meshing.triangulate import constrained, delaunay, squares


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


def test_constrained_segment_through_points_is_several_edges():
    points = np.array(
        [[0, 0], [3, 0], [3, 2], [0, 2], [1, 1], [2, 1], [0, 1], [3, 1], [1.5, 1.2], [1.5, 0.8]], float
    )
    edges = edges_of(constrained(points, np.array([[6, 7]])))
    assert {(4, 6), (4, 5), (5, 7)} <= edges


def test_constrained_crossing_segment_is_left_out():
    points = np.array([[0, 0], [4, 0], [4, 4], [0, 4], [2, 1], [2, 3], [1, 2], [3, 2]], float)
    faces = constrained(points, np.array([[4, 5], [6, 7]]))
    assert ((4, 5) in edges_of(faces)) != ((6, 7) in edges_of(faces))
    assert doubled_areas(points, faces).sum() == 32


@settings(max_examples=150)
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


def nodes(rows: int, columns: int, step: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def deepest_in_circle(points, faces) -> float:
    """Return the largest in-circle determinant of a face and the vertex across an edge; 0 if Delaunay's."""
    edges = {}
    for face in faces.tolist():
        for k in range(3):
            assert (face[k], face[k - 2]) not in edges
            edges[face[k], face[k - 2]] = face[k - 1]
    pairs = [(*edge, apex, edges[edge[::-1]]) for edge, apex in edges.items() if edge[::-1] in edges]
    if not pairs:
        return 0.0
    a, b, c, d = points[np.array(pairs)].transpose(1, 0, 2)
    rows = [np.column_stack([p - d, ((p - d) ** 2).sum(axis=1)]) for p in (a, b, c)]
    # Positive where d lies strictly inside the circle of a, b and c, which are counter-clockwise.
    return float(np.linalg.det(np.stack(rows, axis=1)).max())


def test_full_lattice_is_cut_from_north_west_to_south_east():
    points = nodes(4, 6, 0.3)
    found = squares(points, (0.0, 0.0), 0.3)
    assert found.full[:3, :5].all()
    assert found.full.sum() == 15
    faces = {frozenset(face) for face in found.faces.tolist()}
    assert {frozenset([0, 1, 6]), frozenset([1, 6, 7])} < faces
    assert len(found.faces) == len(faces) == 30
    assert sorted(found.inner.tolist()) == [7, 8, 9, 10, 13, 14, 15, 16]


@pytest.mark.parametrize("lacking", [0, 4, 20, 24])
def test_square_without_a_corner_is_one_face_and_needs_no_point_opposite(lacking):
    points = np.delete(nodes(5, 5, 1.0), lacking, axis=0)
    found = squares(points, (0.0, 0.0), 1.0)
    assert len(found.faces) == 15 * 2 + 1
    assert doubled_areas(points, found.faces).min() == 1.0
    assert len(found.inner) == 9
    assert found.contains(points[found.faces].mean(axis=1)).all()
    x, y = nodes(5, 5, 1.0)[lacking]
    assert not found.contains(np.array([[x + np.sign(2 - x) / 3, y + np.sign(2 - y) / 3]])).any()


def test_square_beside_a_point_off_the_lattice_is_left_to_the_search():
    points = np.vstack([nodes(8, 8, 1.0), [[3.4, 3.5]]])
    full = squares(points, (0.0, 0.0), 1.0).full[:7, :7]
    assert not full[2:5, 2:5].any()
    assert full.sum() == 49 - 9


def test_second_point_near_a_node_is_kept():
    points = np.vstack([nodes(8, 8, 1.0), [[3.000002, 3.0]]])
    faces = delaunay(points, [((0.0, 0.0), 1.0)])
    assert set(np.unique(faces)) == set(range(len(points)))


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**31),
    step=st.sampled_from([1.0, 0.5, 0.3]),
    share=st.sampled_from([0.2, 0.7, 0.95, 1.0]),
    foreign=st.sampled_from([0, 1, 8]),
)
def test_triangulation_with_lattices_is_delaunay(seed, step, share, foreign):
    rng = np.random.default_rng(seed)
    size = 21
    fine = nodes(size, size, step)
    fine = fine[rng.random(len(fine)) < share]
    coarse = nodes(5, 5, 5 * step)
    edge = (size - 1) * step
    points = np.vstack([fine, coarse, rng.uniform(0, edge, (foreign, 2))])
    points = np.unique(points.round(6), axis=0)
    points = points[np.lexsort((points[:, 0], points[:, 1]))]
    lattices = [((0.0, 0.0), step), ((0.0, 0.0), 5 * step)]
    faces = delaunay(points, lattices)
    areas = doubled_areas(points, faces)
    assert areas.min() > 0
    assert areas.sum() == pytest.approx(2 * edge**2)
    assert set(np.unique(faces)) == set(range(len(points)))
    assert len(faces) == len(delaunay(points))
    assert deepest_in_circle(points, faces) < 1e-4 * step**4
    np.testing.assert_array_equal(faces, delaunay(points, lattices))


def test_segment_through_full_squares_is_an_edge():
    points = nodes(20, 20, 1.0)
    faces = constrained(points, np.array([[0, 2 * 20 + 1]]), [((0.0, 0.0), 1.0)])
    assert any({0, 41} <= set(face) for face in faces.tolist())
    assert doubled_areas(points, faces).min() > 0
    assert doubled_areas(points, faces).sum() == pytest.approx(2 * 19**2)
