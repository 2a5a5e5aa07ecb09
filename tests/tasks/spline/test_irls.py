"""The convex solver against exact optima; its parts against dense matrices and known integrals."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from flexroad.tasks.fit import nurbs, smoothing_spline
from flexroad.tasks.spline import irls
from flexroad.tasks.spline.objective import objective
from flexroad.tasks.spline.space import clamped_space
from flexroad.tasks.spline.stencil import bending_energy, from_lines, line_width, multiply, to_lines
from flexroad.tasks.spline.surface import basis_matrix, dense
from tests.builders import NORTH, WEST, make_clusters, make_grid, make_street

UNIFORM_L1 = {"lambda_terrain": 1.0, "huber_m": 0.0, "bending_m3": 100.0}
"""Options of an L1 loss with equal weights for road and terrain."""


def space(n, m, shape, degree=3, cell=1.0):
    return clamped_space(make_grid(*shape[::-1], cell), degree, (n, m))


def noisy_heights(shape, seed=0):
    """Return heights of waves with noise, outliers and a hole."""
    rng = np.random.default_rng(seed)
    heights = np.sin(np.indices(shape) / 4).sum(axis=0) + rng.normal(0, 0.05, shape)
    heights[rng.random(shape) < 0.1] += 2
    heights[2:5, 3:9] = np.nan
    return heights


def convex_loss(shape=(24, 20), n=7, m=8, degree=3, bending=0.0, huber_m=0.0):
    spline_space = space(n, m, shape, degree)
    factors = np.where(np.random.default_rng(1).random(shape) < 0.5, 1.0, 0.3)
    bending = bending + np.zeros((n, degree + 1, degree + 1, line_width(m, degree)))
    loss, held = objective(noisy_heights(shape), factors, spline_space), np.zeros((m, n), bool)
    return irls.HuberObjective(loss, held, bending, huber_m)


def energy_of(stencil, z, degree=3):
    """Return the energy of a stencil at control heights, and its gradient."""
    lines, gradient = to_lines(z, degree), to_lines(np.zeros_like(z), degree)
    multiply(stencil, lines, gradient, (0.0,) * (degree + 1))
    gradient = from_lines(gradient, len(z), degree)
    return np.vdot(gradient, z) / 2, gradient


def design_matrix(loss):
    """Return the basis functions at all cells, ``(H * W, m * n)``."""
    o, (m, n) = loss.objective, loss.held.shape
    return np.kron(dense(o.start_v, o.along_v, m), dense(o.start_u, o.along_u.T, n))


@pytest.mark.parametrize("cells", [(40, 31), (80, 61)])
def test_bending_energy_uses_curvature_in_metres(cells):
    """z = 0.01 x^2 + 0.02 xy - 0.03 y^2 has z_xx = 0.02, z_xy = 0.02, z_yy = -0.06 everywhere."""
    rows, cols = cells
    spline_space = space(9, 11, cells, cell=2.0)
    x, y = np.meshgrid(2.0 * np.arange(cols), 2.0 * np.arange(rows)[::-1])
    along_u = basis_matrix(spline_space.knots_u, 3, spline_space.u)[0]
    along_v = basis_matrix(spline_space.knots_v, 3, spline_space.v)[0]
    stiffness = np.full(cells, 5.0)
    stiffness[:, : cols // 2] = 1.0
    bending = bending_energy(stiffness, spline_space)
    for ground, curvature in (
        (0.01 * x**2 + 0.02 * x * y - 0.03 * y**2, 0.02**2 + 2 * 0.02**2 + 0.06**2),
        (3 + 0.1 * x - 0.2 * y, 0.0),
    ):
        z = np.linalg.pinv(along_v) @ ground @ np.linalg.pinv(along_u).T
        assert energy_of(bending, z)[0] == pytest.approx(stiffness.sum() * curvature, rel=1e-6, abs=1e-9)


def test_bending_energy_grows_with_stiffness_and_square_of_height():
    stiffness, z = np.random.default_rng(0).random((20, 24)), np.random.default_rng(1).normal(size=(6, 7))
    bending, thrice = (bending_energy(share * stiffness, space(7, 6, (20, 24))) for share in (1, 3))
    energy, gradient = energy_of(bending, z)
    assert energy_of(thrice, 2 * z)[0] == pytest.approx(12 * energy)
    h, direction = 1e-6, np.random.default_rng(2).normal(size=z.shape)
    numeric = (energy_of(bending, z + h * direction)[0] - energy_of(bending, z - h * direction)[0]) / (2 * h)
    assert np.vdot(gradient, direction) == pytest.approx(numeric, rel=1e-6)


@pytest.mark.parametrize("degree", [1, 2, 3, 6])
def test_irls_l1_reaches_linear_programming_optimum(degree):
    loss = convex_loss(degree=degree)
    z, losses = irls.minimise(loss, np.zeros(loss.held.shape), 100, 1e-7)
    o = loss.objective
    design, size = design_matrix(loss), np.prod(loss.held.shape)
    sides = np.hstack([design, np.eye(len(design)), -np.eye(len(design))])
    cost = np.concatenate([np.zeros(size), o.factor.ravel(), o.factor.ravel()])
    free = [(None, None)] * size + [(0, None)] * (2 * len(design))
    exact = linprog(cost, A_eq=sides, b_eq=o.target.ravel(), bounds=free).fun
    assert exact <= losses[-1] <= 1.003 * exact
    assert loss(z) == pytest.approx(losses[-1], rel=1e-9)


def test_irls_wide_huber_equals_least_squares():
    loss = convex_loss(huber_m=1e4)
    z, _ = irls.minimise(loss, np.zeros(loss.held.shape), 20, 1e-12)
    root = np.sqrt(loss.objective.factor.ravel())
    design = root[:, None] * design_matrix(loss)
    exact = np.linalg.lstsq(design, root * loss.objective.target.ravel(), rcond=None)[0]
    np.testing.assert_allclose(z.ravel(), exact, atol=1e-4)


@pytest.mark.parametrize(("huber_m", "more"), [(0.003, 5), (0.1, 0), (1.0, 0)])
def test_irls_huber_near_newton_reaches_same_minimum_in_few_steps(huber_m, more, monkeypatch):
    """Also where nearly all differences are above the limit, so that Newton's steps are too long."""
    bending = bending_energy(np.full((24, 20), 1e-3), space(7, 8, (24, 20)))
    loss = convex_loss(huber_m=huber_m, bending=bending)
    start = np.zeros(loss.held.shape)
    (_, fast), (exact, _) = (irls.minimise(loss, start, 200, tolerance) for tolerance in (1e-8, 0.0))
    monkeypatch.setattr(irls, "OUTLIERS", 1.0)
    (_, plain), (slow_z, slow) = (irls.minimise(loss, start, 200, tolerance) for tolerance in (1e-8, 0.0))
    assert len(fast) <= len(plain) + more
    assert fast[-1] == pytest.approx(slow[-1], rel=1e-7)
    np.testing.assert_allclose(exact, slow_z, atol=1e-3)
    assert (np.diff(fast) <= 0).all()


tile = partial(make_street, shape=(90, 90))


def fitted(data, clusters, **changes):
    options = smoothing_spline.Options(**{"spacing_m": 89 / 24, **UNIFORM_L1, **changes})
    return smoothing_spline.fit(data, clusters, options)


def on_cells(surface, data):
    return surface.lattice(data.grid.eastings, data.grid.northings)


def test_fit_plane_is_reproduced_across_void():
    data, clusters, truth = tile(lambda e, s: 160 + 0.1 * e - 0.05 * s)
    data.dtm[:30, 20:60] = np.nan
    surface = fitted(data, clusters)
    np.testing.assert_allclose(on_cells(surface, data), truth, atol=1e-4)
    np.testing.assert_array_equal(surface.W, 1.0)


def test_fit_void_has_no_effect_elsewhere():
    data, clusters, _ = tile(lambda e, s: 160 + np.sin(e / 9), noise=0.1)
    whole = on_cells(fitted(data, clusters), data)
    data.dtm[65:] = np.nan
    assert abs(on_cells(fitted(data, clusters), data) - whole)[:50].max() < 3e-3


def test_fit_noisy_road_is_smoother_than_paper_fit():
    def roughness(heights):
        return np.abs(np.diff(heights[40:50], 2, axis=1)).mean()

    data, clusters, truth = tile(lambda e, s: 160 + 2 * np.sin(e / 25) + np.cos(s / 30), noise=0.1)
    by_irls = on_cells(fitted(data, clusters), data)
    by_adam = on_cells(nurbs.fit(data, clusters, nurbs.Options(control_points=(25, 25))), data)
    errors = [abs(heights - truth)[40:50].mean() for heights in (by_irls, by_adam)]
    assert errors[0] < 0.75 * errors[1]
    assert roughness(by_irls) < 0.75 * roughness(by_adam)


def test_fit_soft_terrain_follows_bank_beside_road(monkeypatch):
    """A bank of 2 m beside the road: with uniform stiffness it would be smoothed into the road's edge."""
    data, clusters, truth = tile(lambda e, s: 160 + 2 / (1 + np.exp(-(s - 58) / 1.5)) + 0 * e)
    bank = np.s_[52:66]
    errors = []
    for share in (0.01, 1):
        monkeypatch.setattr(smoothing_spline, "TERRAIN_BENDING", share)
        errors.append(abs(on_cells(fitted(data, clusters, bending_m3=1000), data) - truth)[bank].mean())
    assert errors[0] < 0.5 * errors[1]


def test_fit_without_road_or_terrain_follows_other_data():
    data, clusters, truth = tile(lambda e, s: 160 + np.sin(e / 20), noise=0.02)
    no_road = make_clusters(np.zeros_like(clusters.mask))
    assert abs(on_cells(fitted(data, no_road), data) - truth).mean() < 0.05
    road_only = on_cells(fitted(data, clusters, lambda_terrain=0), data)
    assert abs(road_only - truth)[clusters.mask].mean() < 0.05
    assert np.isfinite(road_only).all()


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (nurbs, nurbs.Options(control_points=(9, 9), iterations=40, learning_rate=0.5)),
        (smoothing_spline, smoothing_spline.Options(spacing_m=39 / 8, bending_m3=1.0)),
        (smoothing_spline, smoothing_spline.Options(spacing_m=39 / 8, huber_m=0, lambda_terrain=1)),
    ],
    ids=["adam", "huber", "absolute"],
)
@settings(max_examples=25)
@given(seed=st.integers(0, 2**31), road=st.floats(0, 1), missing=st.floats(0, 0.8), scale=st.floats(-3, 3))
def test_fit_any_input_has_no_pole_and_bounded_weights(method, options, seed, road, missing, scale):
    """Any mask and DSM: the surface stays within its control heights and near the data."""
    rng = np.random.default_rng(seed)
    data, clusters, _ = tile(lambda e, s: 160 + 0 * e, shape=(40, 40))
    heights = np.clip(10**scale * rng.standard_t(2, (2, 40, 40)), -3000, 3000)
    heights[rng.random(heights.shape) < missing] = np.nan
    clusters.labels[:] = np.kron(rng.random((5, 5)) < road, np.ones((8, 8)))
    data = replace(data, dsm=heights[0], dtm=heights[1])
    surface = method.fit(data, clusters, options)
    assert surface.W.min() >= 0.1 - 1e-12
    assert surface.W.max() <= 10 + 1e-12
    control = surface.A / surface.W + surface.datum
    result = surface.lattice(np.linspace(WEST, WEST + 40, 157), np.linspace(NORTH, NORTH - 40, 157)[3:-3])
    inner = result[:, 3:-3]
    slack = 1e-9 * (1 + np.abs(control).max())
    assert control.min() - slack <= inner.min()
    assert inner.max() <= control.max() + slack
    spread = np.nanmax(heights) - np.nanmin(heights)
    steps = options.iterations if method is nurbs else 0
    # Control points outside the tile continue its slope; their heights alone mean nothing.
    assert np.abs(inner - np.nanmedian(heights)).max() <= 3 * spread + steps
