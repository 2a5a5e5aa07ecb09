"""The basis against SciPy, the exported surface against geomdl, and the lattice that tiles share."""

import numpy as np
import pytest
from geomdl import NURBS
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from flexroad.tasks.spline.space import Lattice
from flexroad.tasks.spline.surface import (
    NurbsSurface,
    basis,
    basis_matrix,
    clamped_knots,
    exact,
    greville,
    uniform_knots,
)
from tests.builders import make_surface

BOUNDS = (295500.5, 5629250.5, 295749.5, 5629399.5)
DEGREES = range(1, 11)

spaces = st.integers(1, 10).flatmap(lambda p: st.tuples(st.just(p), st.integers(p + 1, p + 30)))
parameters = st.lists(st.floats(0, 1), min_size=1, max_size=20).map(np.array)


def surface(degree=(3, 3), points=(12, 14), seed=0, weights=True):
    n, m = (max(k, d + 1) for k, d in zip(points, degree, strict=True))
    return make_surface((m, n), degree, weights=weights, seed=seed, bounds=BOUNDS)


def points_inside(seed, count=200):
    rng = np.random.default_rng(seed)
    return rng.uniform(BOUNDS[0], BOUNDS[2], count), rng.uniform(BOUNDS[1], BOUNDS[3], count)


@given(spaces, parameters)
def test_greville_heights_reproduce_a_line(space, u):
    degree, points = space
    knots = clamped_knots(points, degree)
    values, slopes = basis_matrix(knots, degree, u)
    line = 3 * greville(knots, degree) - 1
    np.testing.assert_allclose(values @ line, 3 * u - 1, atol=1e-12)
    np.testing.assert_allclose(slopes @ line, 3, atol=1e-9)


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_and_slopes_equal_scipy(degree):
    knots = clamped_knots(degree + 9, degree)
    # Inner knots are left out: there the derivative of degree 1 is discontinuous.
    u = np.concatenate([[0.0, 1.0], np.random.default_rng(degree).uniform(0, 1, 100)])
    values, slopes = basis_matrix(knots, degree, u)
    peer = BSpline(knots, np.eye(degree + 9), degree)
    np.testing.assert_allclose(values, peer(u), atol=1e-13)
    np.testing.assert_allclose(slopes, peer.derivative()(u), atol=1e-10)


def test_clamped_knots_too_few_points_raises():
    with pytest.raises(ValueError, match="degree 5 needs at least 6 control points, not 5"):
        clamped_knots(5, 5)


@pytest.mark.parametrize("degree", [(1, 1), (3, 3), (2, 5), (10, 10)])
def test_height_and_lattice_equal_definition(degree):
    s = surface(degree)
    e, n = (np.sort(x)[:40] for x in points_inside(1))
    lattice = s.lattice(e, n)
    assert lattice.shape == (40, 40)
    np.testing.assert_allclose(s.height(e[None, :], n[:, None]), lattice, atol=1e-11)
    # The definition (Eq. nurbs), written out for one point.
    nu = BSpline(s.knots_u, np.eye(s.A.shape[1]), degree[0])((e[7] - BOUNDS[0]) / 249)
    nv = BSpline(s.knots_v, np.eye(s.A.shape[0]), degree[1])((n[5] - BOUNDS[1]) / 149)
    b = np.outer(nv, nu)
    np.testing.assert_allclose(lattice[5, 7], (b * s.W * (s.A / s.W + s.datum)).sum() / (b * s.W).sum())


@settings(max_examples=30)
@given(st.integers(2, 10), st.integers(2, 10), st.integers(0, 1000))
def test_slopes_equal_finite_differences(p, q, seed):
    s = surface((p, q), seed=seed, points=(12, 12))
    rng = np.random.default_rng(seed)
    e, n = rng.uniform(BOUNDS[0] + 1, BOUNDS[2] - 1, 50), rng.uniform(BOUNDS[1] + 1, BOUNDS[3] - 1, 50)
    h = 1e-3
    by_e, by_n = s.slope(e, n)
    for slope, x, y in ((by_e, h, 0), (by_n, 0, h)):
        numeric = (s.height(e + x, n + y) - s.height(e - x, n - y)) / (2 * h)
        np.testing.assert_allclose(slope, numeric, atol=2e-4, rtol=1e-3)


def test_normals_are_upward_and_orthogonal_to_surface():
    s = surface()
    e, n = points_inside(2)
    normals = s.normal(e, n)
    by_e, by_n = s.slope(e, n)
    zero, one = np.zeros_like(e), np.ones_like(e)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1)
    assert (normals[:, 2] > 0).all()
    for tangent in ((one, zero, by_e), (zero, one, by_n)):
        np.testing.assert_allclose((normals * np.stack(tangent, -1)).sum(-1), 0, atol=1e-12)


def test_height_beyond_domain_is_linear():
    s = surface()
    west, south, east, north = BOUNDS
    by_e, by_n = s.slope(east, north)
    expected = s.height(east, north) + 0.5 * by_e + 0.25 * by_n
    np.testing.assert_allclose(s.height(east + 0.5, north + 0.25), expected)
    np.testing.assert_allclose(s.lattice(np.array([east + 0.5]), np.array([north + 0.25])), [[expected]])
    mid = (south + north) / 2
    steps = s.height(west - np.array([0.0, 0.25, 0.5]), mid)
    np.testing.assert_allclose(steps[2] - steps[1], steps[1] - steps[0], atol=1e-10)
    assert abs(steps[1] - steps[0]) > 1e-6


@pytest.mark.parametrize("degree", DEGREES)
def test_exact_equals_surface(degree):
    s = surface((degree, degree), points=(35, 20))
    patch = exact(s)
    n, m = s.A.shape[::-1]
    assert patch.points.shape == (2 * m - degree, 2 * n - degree, 4)
    assert (patch.points[..., 3] > 0).all()
    rng = np.random.default_rng(degree)
    u, v = np.append(rng.uniform(0, 1, 200), [0, 1]), np.append(rng.uniform(0, 1, 200), [1, 0])
    nu = BSpline(patch.knots_u, np.eye(patch.points.shape[1]), degree + 1)(u)
    nv = BSpline(patch.knots_v, np.eye(patch.points.shape[0]), degree + 1)(v)
    w = patch.points[..., 3:]
    x, y, z, w = np.einsum("ki,kj,ijc->ck", nv, nu, np.concatenate([patch.points[..., :3] * w, w], -1))
    np.testing.assert_allclose(x / w, BOUNDS[0] - s.origin[0] + 249 * u, atol=1e-11)
    np.testing.assert_allclose(y / w, BOUNDS[1] - s.origin[1] + 149 * v, atol=1e-11)
    heights = s.height(BOUNDS[0] + 249 * u, BOUNDS[1] + 149 * v)
    # An easting has a rounding error of 6e-11 m, a northing of 9e-10 m, and slopes here reach 20.
    np.testing.assert_allclose(z / w, heights, atol=2e-8)
    parameters = s._height(s._at_points(u, v), np.zeros_like(u), np.zeros_like(v))
    np.testing.assert_allclose(z / w, parameters, atol=1e-11)


@pytest.mark.parametrize("degree", [1, 3])
def test_exact_evaluated_by_geomdl_equals_surface(degree):
    s = surface((degree, degree), points=(9, 7))
    patch = exact(s)
    peer = NURBS.Surface()
    peer.degree_u, peer.degree_v = patch.degree
    homogeneous = patch.points.copy()
    homogeneous[..., :3] *= homogeneous[..., 3:]
    peer.ctrlpts2d = homogeneous.transpose(1, 0, 2).tolist()
    peer.knotvector_u, peer.knotvector_v = patch.knots_u.tolist(), patch.knots_v.tolist()
    for u, v in [(0.0, 0.0), (0.123, 0.77), (0.5, 0.5), (0.9, 0.31), (1.0, 1.0)]:
        x, y, z = peer.evaluate_single((u, v))
        height = s.height(s.origin[0] + x, s.origin[1] + y)
        assert z == pytest.approx(float(height), abs=1e-7)
        assert x == pytest.approx(0.5 + 249 * u, abs=1e-10)


def test_control_points_unit_weights_define_surface():
    s = surface(weights=False)
    points = s.control_points
    assert points.shape == (*s.A.shape, 4)
    nu, _ = basis_matrix(s.knots_u, 3, np.array([0.4]))
    nv, _ = basis_matrix(s.knots_v, 3, np.array([0.7]))
    x, y, z, w = np.einsum("ki,kj,ijc->ck", nv, nu, points)[:, 0]
    assert x == pytest.approx(BOUNDS[0] + 0.4 * 249)
    assert y == pytest.approx(BOUNDS[1] + 0.7 * 149)
    assert z == pytest.approx(float(s.height(x, y)), abs=1e-9)
    assert w == pytest.approx(1)


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


def tile_of_block(column, row, control, n, m, p=3, size=(250.0, 200.0)):
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
    tiles = {(c, r): tile_of_block(c, r, control, n, m, p) for c in (0, 1) for r in (0, 1)}
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
    ours = tile_of_block(0, 0, 300 + rng.normal(size=(12, 14)), n=11, m=9)
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
