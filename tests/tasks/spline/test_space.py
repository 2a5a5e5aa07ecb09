"""The lattice shared by tiles: equal values on common knots, to the last bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.tasks.spline.space import Lattice
from flexroad.tasks.spline.surface import NurbsSurface, basis, basis_matrix, exact, uniform_knots


@pytest.mark.parametrize("degree", range(2, 8))
def test_basis_at_knot_is_equal_from_both_sides(degree):
    """A line is the end of one tile's domain and the start of the next one's."""
    knots = np.array([17.0])
    left = basis(uniform_knots(0, 17, degree), degree, knots)
    right = basis(uniform_knots(17, 40, degree), degree, knots)
    for ours, theirs in zip(left[1:], right[1:], strict=True):
        assert ours[0, 0] == theirs[0, -1] == 0
        assert ours[0, 1:].tobytes() == theirs[0, :-1].tobytes()


@pytest.mark.parametrize("degree", [2, 3, 5])
def test_uniform_basis_does_not_depend_on_domain(degree):
    t = np.linspace(7, 9, 41)
    (_, *ours), (_, *theirs) = (basis(uniform_knots(*ends, degree), degree, t) for ends in ((0, 20), (7, 9)))
    assert [part[:-1].tobytes() for part in ours] == [part[:-1].tobytes() for part in theirs]


def surface(column, row, control, n, m, p=3, size=(250.0, 200.0)):
    """The tile of a block whose control points are a part of the block's."""
    west, south = 295500 + column * size[0], 5629250 + row * size[1]
    a = control[row * m : row * m + m + p, column * n : column * n + n + p]
    knots = uniform_knots(0, n, p), uniform_knots(0, m, p)
    bounds = west, south, west + size[0], south + size[1]
    return NurbsSurface("EPSG:25832", bounds, (p, p), *knots, a, np.ones_like(a), 0.0, (west, south))


@settings(max_examples=30)
@given(st.integers(0, 2**31), st.integers(4, 70), st.integers(4, 70), st.integers(2, 5))
def test_surfaces_with_common_points_meet_exactly(seed, n, m, p):
    rng = np.random.default_rng(seed)
    control = 300 + 50 * rng.normal(size=(2 * m + p, 2 * n + p))
    tiles = {(c, r): surface(c, r, control, n, m, p) for c in (0, 1) for r in (0, 1)}
    along = rng.uniform(0, 1, 50)
    for one, other, (x, y) in (
        ((0, 0), (1, 0), (np.full(50, 295750.0), 5629250 + 200 * along)),
        ((0, 0), (0, 1), (295500 + 250 * along, np.full(50, 5629450.0))),
        ((0, 0), (1, 1), (np.array([295750.0]), np.array([5629450.0]))),
    ):
        a, b = tiles[one], tiles[other]
        np.testing.assert_array_equal(a.height(x, y), b.height(x, y))
        np.testing.assert_array_equal(a.normal(x, y), b.normal(x, y))


def test_surface_on_uniform_knots_exports_exactly():
    rng = np.random.default_rng(0)
    ours = surface(0, 0, 300 + rng.normal(size=(12, 14)), n=11, m=9)
    nurbs = exact(ours)
    t = np.linspace(0, 1, 23)
    along_u, along_v = (
        basis_matrix(knots, degree, t)[0]
        for knots, degree in zip((nurbs.knots_u, nurbs.knots_v), nurbs.degree, strict=True)
    )
    x, y, z, w = np.moveaxis(nurbs.points, -1, 0)
    weight = along_v @ w @ along_u.T
    at = [along_v @ (part * w) @ along_u.T / weight for part in (x, y, z)]
    np.testing.assert_allclose(at[0], np.broadcast_to(250 * t, (23, 23)), atol=1e-9)
    np.testing.assert_allclose(at[1], np.broadcast_to(200 * t[:, None], (23, 23)), atol=1e-9)
    heights = ours.lattice(ours.bounds[0] + 250 * t, ours.bounds[1] + 200 * t)
    np.testing.assert_allclose(at[2], heights, atol=1e-9)
    assert (nurbs.knots_u[0], nurbs.knots_u[-1]) == (0, 1)


@pytest.mark.parametrize(("spacing", "intervals"), [(3.6, (70, 56)), (250, (3, 3)), (2.5, (100, 80))])
def test_lattice_spacing_is_at_most_the_given_one(spacing, intervals):
    lattice = Lattice.of((250, 200), 1.0, 3, spacing)
    assert lattice.intervals == intervals
    assert max(lattice.unit_m) <= max(spacing, 250 / 3)


def test_lattice_lines_over_a_distance():
    lattice = Lattice.of((250, 200), 1.0, 3, 30.0)
    assert lattice.lines_within(99.5) == (3, 3)
    assert lattice.lines_over(99.5) == (4, 4)
    assert Lattice.of((250, 200), 1.0, 3, 5.0).lines_over(100.0) == (20, 20)


def test_lattice_part_has_cells_between_its_lines():
    lattice = Lattice.of((250, 200), 1.0, 3, 5.0)
    space, (rows, cols) = lattice.part((300, 400), start=(280, 60), u=(-4, 10), v=(0, 6))
    assert (rows, cols) == (slice(250, 280), slice(40, 110))
    assert space.points == (14 + 3, 6 + 3)
    assert space.unit_m == (5.0, 5.0)
    np.testing.assert_allclose(space.u, (np.arange(-20, 50) + 0.5) / 5)
    np.testing.assert_allclose(space.v, (np.arange(30)[::-1] + 0.5) / 5)
