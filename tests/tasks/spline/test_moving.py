"""Surfaces whose plan moves with the weights, against the sums of Eq. nurbs, and weights without bounds."""

import numpy as np
import pytest
import scipy.optimize

from flexroad.tasks.spline.moving import WEIGHTS, loss_by_variables, moving
from flexroad.tasks.spline.objective import objective
from flexroad.tasks.spline.space import clamped_space, surface_on
from flexroad.tasks.spline.surface import NurbsSurface, basis_matrix
from tests.builders import make_grid

GRID = make_grid(40, 50)
SPACE = clamped_space(GRID, 3, (8, 9))


def surface(w=None) -> NurbsSurface:
    rng = np.random.default_rng(4)
    z, w = rng.normal(0, 1, (9, 8)), rng.uniform(0.2, 5, (9, 8)) if w is None else w
    return surface_on(SPACE, GRID, GRID.hull, w * z, w, 150.0)


def lattice():
    return (part.ravel() for part in np.meshgrid(GRID.eastings, GRID.northings))


@pytest.mark.parametrize("uniform", [False, True])
def test_moved_equals_the_rational_sum_over_control_points(uniform):
    flat = surface()
    made = moving(flat, uniform)
    x, y = made.moved(*lattice())
    along_u, along_v = (
        basis_matrix(*part)[0] for part in ((SPACE.knots_u, 3, SPACE.u), (SPACE.knots_v, 3, SPACE.v))
    )
    if uniform:
        west, south, east, north = GRID.hull
        places = np.linspace(west, east, 8)[None, :], np.linspace(south, north, 9)[:, None]
    else:
        places = flat.control_points[..., 0], flat.control_points[..., 1]
    for moved, place, start in zip((x, y), places, made.origin, strict=True):
        expected = (along_v @ (flat.W * (place - start)) @ along_u.T) / (along_v @ flat.W @ along_u.T)
        np.testing.assert_allclose(moved, expected.ravel(), atol=1e-6)
    np.testing.assert_array_equal(made.height(*lattice()), flat.height(*lattice()))


def test_moved_with_unit_weights_stays_in_place():
    easting, northing = lattice()
    made = moving(surface(np.ones((9, 8))))
    x, y = made.moved(easting, northing)
    np.testing.assert_allclose(x + made.origin[0], easting, atol=1e-6)
    np.testing.assert_allclose(y + made.origin[1], northing, atol=1e-6)


def test_moved_edges_stay_exactly_on_the_edges_of_the_tile():
    west, south, east, north = GRID.hull
    made = moving(surface())
    x, y = made.moved(np.array([west, east, west + 7.3]), np.array([south + 3.1, south + 9.7, north]))
    assert (x[0], x[1], y[2]) == (west - made.origin[0], east - made.origin[0], north - made.origin[1])
    assert abs(x[2] - (west + 7.3 - made.origin[0])) > 0.1


@pytest.mark.parametrize("name", WEIGHTS)
def test_loss_gradient_equals_finite_differences(name):
    rng = np.random.default_rng(2)
    heights, factor = rng.normal(0, 3, GRID.shape), rng.uniform(0, 1, GRID.shape)
    weights = WEIGHTS[name]
    loss = loss_by_variables(objective(heights, factor, SPACE, 0.3, True), weights)
    variables = np.stack([rng.normal(0, 1, (9, 8)), weights[0] + rng.uniform(-0.4, 0.4, (9, 8))])
    _, gradient = loss(variables)

    def at(flat):
        return loss(flat.reshape(variables.shape))[0]

    np.testing.assert_allclose(
        gradient.ravel(), scipy.optimize.approx_fprime(variables.ravel(), at, 1e-7), rtol=2e-3, atol=2e-5
    )


def test_weights_start_at_one_and_softplus_is_positive_without_bound():
    for start, weights, *_ in WEIGHTS.values():
        assert weights(np.array(start)) == pytest.approx(1)
    values = WEIGHTS["softplus"][1](np.array([-30.0, 0.0, 500.0]))
    assert values[0] > 0
    assert values[2] == pytest.approx(500)
