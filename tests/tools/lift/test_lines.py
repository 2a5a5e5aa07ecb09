"""Lines on known surfaces: their points, vertices, and grades."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.tools.lift.lines import Line, vertices

X, Y = np.array([0.0, 30, 30]), np.array([0.0, 0, 40])


def test_points_lie_on_the_line_at_most_a_step_apart():
    line = Line.of(X, Y, step=0.7)
    np.testing.assert_allclose(np.hypot(np.diff(line.x), np.diff(line.y)), np.diff(line.s), atol=1e-12)
    assert np.diff(line.s).max() <= 0.7
    assert line.s[line.own].tolist() == [0, 30, 70]
    assert np.column_stack([line.x, line.y])[line.own].tolist() == np.column_stack([X, Y]).tolist()


def test_lengths_are_metres_whatever_the_unit():
    line = Line.of(X / 100, Y / 200, metres=(100.0, 200.0))
    assert line.s[line.own] == pytest.approx([0, 30, 70])


@pytest.mark.parametrize("vertices", [1, 2])
def test_a_line_of_one_place_has_no_grade(vertices):
    line = Line.of(np.full(vertices, 3.0), np.full(vertices, 4.0))
    assert line.own.all()
    assert line.needed(np.zeros(vertices), 0.01).tolist() == list(range(vertices))
    assert np.isnan(line.grades(np.zeros(vertices), 0.1)[0])


@pytest.mark.parametrize("tolerance", [0.1, 0.005])
def test_a_line_needs_vertices_where_it_leaves_the_heights(tolerance):
    line = Line.of(X, Y)
    z = 100 + np.sin(line.s / 8) * (line.s < 30)
    needed = line.needed(z, tolerance)
    assert set(np.flatnonzero(line.own)) <= set(needed.tolist())
    assert np.abs(np.interp(line.s, line.s[needed], z[needed]) - z).max() <= tolerance + 1e-9
    assert line.needed(z, tolerance, add=False).tolist() == np.flatnonzero(line.own).tolist()


def test_a_line_beyond_the_surface_keeps_its_vertices_and_gets_one_at_the_limit():
    line = Line.of(X, Y)
    z = np.where((line.s > 10) & (line.s <= 35), 5 + 0.1 * line.s, np.nan)
    assert line.s[line.needed(z, 1e-6)].tolist() == [0, 10.5, 30, 35, 70]


def test_the_steepest_place_of_each_stretch_is_listed():
    line = Line.of(X, Y)
    slope = np.select([line.s < 10, line.s < 20, line.s < 50, line.s < 60], [0.08, 0.01, 0.02, -0.12], 0.0)
    z = np.concatenate([[0], np.cumsum(slope[:-1] * np.diff(line.s))])
    grade, places = line.grades(z, 0.05)
    assert grade == pytest.approx(0.12)
    assert [place.value for place in places] == pytest.approx([0.08, 0.12])
    assert [(places[0].y, places[1].x)] == [(0, 30)]
    assert 0 < places[0].x < 10
    assert 20 < places[1].y < 30
    assert line.grades(z, None)[1] == ()
    assert line.grades(np.where(line.s < 30, z, np.nan), 0.05)[0] == pytest.approx(0.08)


def test_the_length_of_places_is_that_of_the_line_around_them():
    line = Line.of(X, Y)
    assert line.length_where(np.ones(len(line.s), bool)) == pytest.approx(70)
    assert line.length_where(line.s <= 10) == pytest.approx(10.25)


def test_a_line_with_wrong_coordinates_has_a_bounded_number_of_points():
    line = Line.of(np.array([0, 1e308, 5.0, 6.0, 1e12]), np.zeros(5))
    assert line.own.sum() == 5
    assert len(line.x) <= 1_000_010


@given(st.integers(0, 10**6), st.integers(2, 60), st.floats(0.01, 1))
def test_any_line_stays_within_the_tolerance_with_the_points_that_it_had(seed, number, tolerance):
    rng = np.random.default_rng(seed)
    s, z = np.cumsum(rng.random(number)), np.cumsum(rng.normal(0, 0.2, number))
    kept = rng.random(number) < 0.1
    kept[[0, -1]] = True
    chosen = vertices(s, z, kept, tolerance)
    assert set(np.flatnonzero(kept)) <= set(chosen.tolist())
    assert np.abs(np.interp(s, s[chosen], z[chosen]) - z).max() <= tolerance + 1e-9


def test_a_straight_line_needs_no_vertex_between_those_that_it_had():
    s = np.arange(50.0)
    kept = np.isin(s, [0, 20, 49])
    assert vertices(s, 5 + 0.1 * s, kept, 1e-6).tolist() == [0, 20, 49]
