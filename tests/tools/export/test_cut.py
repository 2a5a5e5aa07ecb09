"""Parts of surfaces against the surfaces themselves, evaluated by SciPy."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.surface import ExactNurbs, NurbsSurface, clamped_knots, uniform_knots
from flexroad.tools.export.step import cut, patch

BOUNDS = (295500.0, 5629250.0, 295750.0, 5629450.0)
WITHIN = (295512.3, 5629250.0, 295730.0, 5629444.4)


def surface(degree=(3, 2), clamped=False, weights=False, constant=1.0) -> NurbsSurface:
    rng = np.random.default_rng(5)
    n, m = 20, 17
    kind = (lambda k, p: clamped_knots(k, p)) if clamped else (lambda k, p: uniform_knots(0, k - p, p))
    w = np.exp(rng.uniform(-2, 2, (m, n))) if weights else np.full((m, n), constant)
    knots = kind(n, degree[0]), kind(m, degree[1])
    return NurbsSurface(
        "EPSG:25832", BOUNDS, degree, *knots, w * rng.normal(3, 2, (m, n)), w, 150.25, (295500.0, 5629250.0)
    )


def evaluated(nurbs: ExactNurbs, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return points of a NURBS by SciPy, ``(len(v), len(u), 3)``."""
    nu = BSpline(nurbs.knots_u, np.eye(nurbs.points.shape[1]), nurbs.degree[0])(u)
    nv = BSpline(nurbs.knots_v, np.eye(nurbs.points.shape[0]), nurbs.degree[1])(v)
    w = nurbs.points[..., 3:]
    homogeneous = np.einsum("ai,bj,ijc->abc", nv, nu, np.concatenate([nurbs.points[..., :3] * w, w], -1))
    return homogeneous[..., :3] / homogeneous[..., 3:]


@pytest.mark.parametrize("degree", [(3, 3), (1, 2), (5, 4)])
@pytest.mark.parametrize("clamped", [False, True])
@pytest.mark.parametrize("weights", [False, True])
@pytest.mark.parametrize("bounds", [WITHIN, BOUNDS, (295400.0, 5629300.0, 295600.0, 5629999.0)])
def test_patch_equals_surface_within_a_nanometre(degree, clamped, weights, bounds):
    whole = surface(degree, clamped, weights)
    nurbs, rational = patch(whole, bounds, whole.origin)
    assert rational == weights
    assert nurbs.degree == tuple(p + weights for p in degree)
    west, south, east, north = (
        *np.maximum(bounds[:2], BOUNDS[:2]),
        *np.minimum(bounds[2:], BOUNDS[2:]),
    )
    t = np.linspace(0, 1, 41)
    found = evaluated(nurbs, t, t)
    x, y = west + (east - west) * t, south + (north - south) * t
    np.testing.assert_allclose(found[..., 0], np.broadcast_to(x - 295500, (41, 41)), atol=1e-9)
    np.testing.assert_allclose(found[..., 1], np.broadcast_to((y - 5629250)[:, None], (41, 41)), atol=1e-9)
    # The surface's own heights have the rounding error of a northing, 1e-9 m, times the slope.
    steepest = max(np.abs(slope).max() for slope in whole.slope(*np.meshgrid(x, y)))
    np.testing.assert_allclose(found[..., 2], whole.lattice(x, y), rtol=0, atol=1e-9 * (1 + steepest))


def test_cut_is_clamped_and_has_the_knots_of_the_part():
    part = cut(surface(), WITHIN)
    assert part.bounds == WITHIN
    for knots, degree in ((part.knots_u, 3), (part.knots_v, 2)):
        np.testing.assert_array_equal(knots[: degree + 1], 0)
        np.testing.assert_array_equal(knots[-degree - 1 :], 1)
        assert ((knots > 0) & (knots < 1)).sum() == len(knots) - 2 * degree - 2
    # Knots are 250 / 17 m apart along easting; the part is from 12.3 m to 230 m.
    inner = 295500 + np.arange(1, 16) * 250 / 17
    np.testing.assert_allclose(295512.3 + part.knots_u[4:-4] * 217.7, inner, atol=1e-9)


def test_cut_at_knot_makes_no_narrow_span():
    knot = 295500 + 5 * 250 / 17
    part = cut(surface(), (knot + 1e-10, BOUNDS[1], BOUNDS[2], BOUNDS[3]))
    assert np.diff(part.knots_u)[np.diff(part.knots_u) > 0].min() > 0.05


def test_cut_in_one_span_has_as_few_points_as_possible():
    part = cut(surface(), (295501.0, 5629251.0, 295502.0, 5629252.0))
    assert part.A.shape == (3, 4)


def test_patch_equal_weights_other_than_1_is_not_rational():
    whole = surface(constant=2.5)
    nurbs, rational = patch(whole, WITHIN, whole.origin)
    assert not rational
    np.testing.assert_array_equal(nurbs.points[..., 3], 1)
    t = np.array([0.0, 0.3, 1.0])
    x, y = WITHIN[0] + 217.7 * t, WITHIN[1] + 194.4 * t
    np.testing.assert_allclose(evaluated(nurbs, t, t)[..., 2], surface(constant=2.5).lattice(x, y), atol=5e-9)


def test_cut_beyond_the_domain_is_refused():
    with pytest.raises(TaskError, match=r"bounds 0 0 1 1 lie beyond the surface's domain 295500 5629250"):
        cut(surface(), (0, 0, 1, 1))
