"""The basis against SciPy, the exported surface against geomdl, other properties against algebra."""

from dataclasses import fields

import numpy as np
import pytest
from geomdl import NURBS
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from flexroad.tasks.spline.surface import NurbsSurface, basis, basis_matrix, clamped_knots, exact, greville
from flexroad.tasks.types import Surface

BOUNDS = (295500.5, 5629250.5, 295749.5, 5629399.5)
DEGREES = range(1, 11)

spaces = st.integers(1, 10).flatmap(lambda p: st.tuples(st.just(p), st.integers(p + 1, p + 30)))
parameters = st.lists(st.floats(0, 1), min_size=1, max_size=20).map(np.array)


def surface(degree=(3, 3), points=(12, 14), seed=0, weights=True):
    rng = np.random.default_rng(seed)
    n, m = (max(k, d + 1) for k, d in zip(points, degree, strict=True))
    W = np.exp(rng.uniform(-np.log(10), np.log(10), (m, n))) if weights else np.ones((m, n))
    return NurbsSurface(
        crs="EPSG:25832",
        bounds=BOUNDS,
        degree=degree,
        knots_u=clamped_knots(n, degree[0]),
        knots_v=clamped_knots(m, degree[1]),
        A=W * rng.normal(0, 3, (m, n)),
        W=W,
        datum=163.25,
        origin=(295500.0, 5629250.0),
    )


def points_inside(seed, count=200):
    rng = np.random.default_rng(seed)
    return rng.uniform(BOUNDS[0], BOUNDS[2], count), rng.uniform(BOUNDS[1], BOUNDS[3], count)


@given(spaces, parameters)
def test_basis_sums_to_one(space, u):
    degree, points = space
    start, values, slopes = basis(clamped_knots(points, degree), degree, u)
    assert (start >= 0).all()
    assert (start + degree < points).all()
    assert (values >= -1e-15).all()
    np.testing.assert_allclose(values.sum(axis=1), 1, atol=1e-13)
    np.testing.assert_allclose(slopes.sum(axis=1), 0, atol=1e-10)


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


def test_surface_satisfies_protocol_with_plain_fields():
    s = surface()
    assert isinstance(s, Surface)
    assert all(isinstance(getattr(s, f.name), np.ndarray | str | int | float | tuple) for f in fields(s))


def test_coefficients_row_zero_is_in_south():
    s = surface(weights=False)
    west, south, east, north = BOUNDS
    corners = s.lattice(np.array([west, east]), np.array([south, north])) - s.datum
    np.testing.assert_allclose(corners, s.A[[0, 0, -1, -1], [0, -1, 0, -1]].reshape(2, 2), atol=1e-12)


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
    np.testing.assert_allclose(
        by_e, (s.height(e + h, n) - s.height(e - h, n)) / (2 * h), atol=2e-4, rtol=1e-3
    )
    np.testing.assert_allclose(
        by_n, (s.height(e, n + h) - s.height(e, n - h)) / (2 * h), atol=2e-4, rtol=1e-3
    )


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
