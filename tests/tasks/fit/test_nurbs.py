"""The NURBS fit on known ground; its gradient against autograd and finite differences."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import nurbs, plane
from flexroad.tasks.spline import adam
from flexroad.tasks.spline.objective import objective
from flexroad.tasks.spline.space import clamped_space
from tests.builders import NORTH, WEST, make_clusters, make_grid, make_street
from tests.gpu import needs_gpu


def wave(e, s):
    return 160 + 0.02 * e + 1.5 * np.sin(e / 30) * np.cos(s / 35)


tile = partial(make_street, wave)


def options(**changes):
    return nurbs.Options(**{"control_points": (15, 15), **changes})


def fitted(data, clusters, **changes):
    return nurbs.fit(data, clusters, options(**changes))


def on_cells(surface, data):
    return surface.lattice(data.grid.eastings, data.grid.northings)


def random_objective(degree=3, free=True, rows=40, cols=33):
    rng = np.random.default_rng(degree)
    heights = rng.normal(0, 2, (rows, cols))
    heights[5:9, 3:20] = np.nan
    factor = np.where(rng.random(heights.shape) < 0.3, 1.0, 0.7)
    space = clamped_space(make_grid(cols, rows), degree, (degree + 5, degree + 7))
    start = rng.normal(0, 1, (2, degree + 7, degree + 5))
    return objective(heights, factor, space, 0.3, free), start


def test_loss_equals_paper_equations():
    """Eqs. loss_terrain and loss_ctrl, summed cell by cell and point by point on the fitted surface."""
    data, clusters, _ = tile(noise=0.1)
    data.dsm[50, 10:20] = np.nan
    data.dtm[3, 4] = np.nan
    opts = options(lambda_terrain=0.5, lambda_reg=0.2, iterations=7)
    surface = nurbs.fit(data, clusters, opts)
    z, s = surface.A / surface.W, on_cells(surface, data)
    loss, count = 0.0, 0
    for i, j in np.ndindex(s.shape):
        road = clusters.labels[i, j] > 0
        difference = abs((data.dsm if road else data.dtm)[i, j] - s[i, j])
        if np.isfinite(difference):
            loss, count = loss + (1.0 if road else 0.5) * difference, count + 1
    reg = 0.0
    for i, j in np.ndindex(z.shape):
        around = [
            z[a, b] for a in range(i - 1, i + 2) for b in range(j - 1, j + 2)
            if (a, b) != (i, j) and 0 <= a < z.shape[0] and 0 <= b < z.shape[1]
        ]  # fmt: skip
        reg += (max(z[i, j] - p for p in around) - min(z[i, j] - p for p in around)) ** 2
    space = nurbs.space_of(data, opts)
    evaluate = nurbs.objective_of(data, clusters.mask, space, surface.datum, opts)
    value, _ = evaluate(np.stack([z, np.log(surface.W)]))
    assert value == pytest.approx(loss / count + 0.2 * reg / z.size, rel=1e-10)


@pytest.mark.parametrize("free", [True, False])
@pytest.mark.parametrize("degree", [1, 2, 3, 6, 10])
def test_gradient_equals_autograd(degree, free):
    loss_function, at = random_objective(degree, free)
    loss, gradient = loss_function(at)
    variables = torch.tensor(at).requires_grad_()
    peer = adam.torch_loss(loss_function, at.shape[1:], "cpu")(variables)
    peer.backward()
    assert loss == pytest.approx(peer.item(), rel=1e-12)
    np.testing.assert_allclose(gradient, variables.grad.numpy(), rtol=1e-9, atol=1e-14)
    assert gradient[1].any() == free


def test_fit_engines_give_same_surface():
    data, clusters, _ = tile(noise=0.05)
    a, b = (fitted(data, clusters, engine=engine, iterations=100) for engine in ("numba", "torch"))
    np.testing.assert_allclose(on_cells(a, data), on_cells(b, data), atol=1e-5)
    np.testing.assert_allclose(a.W, b.W, rtol=1e-4)
    assert not np.allclose(a.W, 1)


def test_adam_stops_when_loss_is_stable():
    steps = []

    def flat(x):
        steps.append(1)
        return 1.0, np.zeros_like(x)

    def falling(x):
        return 1.0 - x[0], -np.ones_like(x)

    adam.minimise(flat, np.zeros(3), np.full(3, np.inf), 0.1, 50)
    assert len(steps) == 1 + adam.STOP_WINDOW
    assert len(adam.minimise(falling, np.zeros(3), np.full(3, np.inf), 0.1, 50)[1]) == 51


@pytest.mark.parametrize(("engine", "last"), [("numba", False), ("numba", True), ("torch", False)])
def test_minimise_returns_variables_of_lowest_loss_or_of_last_step(engine, last):
    loss_function, at = random_objective()
    limit = np.full((2, 1, 1), 2.0)
    if engine == "torch":
        best, losses = adam.minimise_with_torch(loss_function, at, limit, 5.0, 20, "cpu")
    else:
        best, losses = adam.minimise(loss_function, at, limit, 5.0, 20, last=last)
    assert len(losses) == 21
    assert losses[-1] > min(losses)
    assert loss_function(best)[0] == pytest.approx(losses[-1] if last else min(losses), rel=1e-12)


def test_fit_unbounded_weights_exceed_the_bounds(monkeypatch):
    monkeypatch.setattr(adam, "STOP_TOLERANCE", 0)
    data, clusters, _ = tile(noise=1.0)
    changes = {"learning_rate": 1.0, "iterations": 60}
    softplus = fitted(data, clusters, weights="softplus", **changes)
    assert (softplus.W.min() > 0, softplus.W.max() > 10) == (True, True)
    unbounded = fitted(data, clusters, weights="unbounded", plan="moving", **changes)
    assert unbounded.W.min() < 0


def test_fit_moving_plan_has_the_heights_of_the_fixed_plan():
    data, clusters, _ = tile(noise=0.1)
    fixed, moving = (fitted(data, clusters, weights="softplus", plan=plan) for plan in ("fixed", "moving"))
    np.testing.assert_array_equal(on_cells(moving, data), on_cells(fixed, data))


def test_fit_level_start_without_steps_is_level():
    data, clusters, _ = tile()
    heights = on_cells(fitted(data, clusters, start="level", iterations=0), data)
    np.testing.assert_allclose(heights, heights[0, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"weights": "unbounded"}, "need"),
        ({"weights": "softplus", "engine": "torch"}, "need"),
        ({"result": "last", "engine": "torch"}, "need"),
        ({"device": "cuda"}, "device cuda needs engine torch"),
        (
            {"degree": 5, "control_points": (5, 35)},
            "degree 5 needs more control points each way than 5 x 35",
        ),
    ],
)
def test_options_that_do_not_go_together_raise(changes, message):
    with pytest.raises(ValidationError, match=message):
        options(**changes)


@pytest.mark.parametrize("engine", ["numba", "torch"])
def test_fit_free_weights_stay_within_bounds(engine, monkeypatch):
    monkeypatch.setattr(adam, "STOP_TOLERANCE", 0)
    data, clusters, _ = tile(noise=1.0)
    surface = fitted(data, clusters, engine=engine, learning_rate=1.0, iterations=60)
    assert surface.W.max() == pytest.approx(10)
    assert surface.W.min() == pytest.approx(0.1)


def test_fit_exact_start_is_kept():
    for slope, reg in ((0, 0.01), (0.02, 0)):
        data, clusters, truth = make_street(lambda e, s, slope=slope: 163 + slope * e + slope / 2 * s)
        surface = fitted(data, clusters, lambda_reg=reg)
        np.testing.assert_allclose(on_cells(surface, data), truth, atol=1e-8)
        expected = np.array([-slope, slope / 2, 1]) / math.hypot(slope, slope / 2, 1)
        np.testing.assert_allclose(surface.normal(WEST + 50, NORTH - 50), expected, atol=1e-9)


@pytest.mark.parametrize("degree", [1, 2, 3, 6, 10])
def test_fit_any_degree_recovers_wave(degree):
    data, clusters, truth = tile(noise=0.02)
    surface = fitted(data, clusters, degree=degree, control_points=(20, 24), iterations=120)
    assert surface.degree == (degree, degree)
    assert surface.A.shape == (24, 20)
    assert abs(on_cells(surface, data) - truth).mean() < 0.03


def test_fit_shifted_tile_gives_shifted_surface():
    data, clusters, _ = tile(noise=0.05)
    moved_grid = replace(data.grid, west=WEST + 320000, north=NORTH - 5e6)
    moved = replace(data, grid=moved_grid, core=moved_grid, dsm=data.dsm + 2000, dtm=data.dtm + 2000)
    a = on_cells(fitted(data, clusters, iterations=50), data)
    b = on_cells(fitted(moved, replace(clusters, grid=moved_grid), iterations=50), moved)
    np.testing.assert_allclose(b - 2000, a, atol=1e-6)


@settings(max_examples=15)
@given(st.integers(10, 60), st.integers(10, 60), st.integers(1, 4), st.integers(5, 8), st.integers(5, 8))
def test_fit_any_tile_shape_and_grid(rows, cols, degree, n, m):
    data, clusters, truth = tile(shape=(rows, cols))
    surface = fitted(data, clusters, degree=degree, control_points=(n, m), iterations=30)
    assert surface.A.shape == (m, n)
    assert surface.bounds == data.grid.hull
    assert abs(on_cells(surface, data) - truth).mean() < 0.5


def test_fit_with_little_data_follows_what_there_is():
    data, clusters, truth = tile(noise=0.02)
    empty, one = (make_clusters(np.zeros(truth.shape, bool)) for _ in range(2))
    one.labels[50, 50] = 1
    for road in (empty, one):
        assert abs(on_cells(fitted(data, road), data) - truth).mean() < 0.03
    point = on_cells(fitted(data, one, terrain=False), data)
    np.testing.assert_allclose(point, data.dsm[50, 50], atol=1e-9)
    flat = on_cells(plane.fit(data, empty, plane.Options()), data)
    np.testing.assert_allclose(on_cells(fitted(data, empty, terrain=False), data), flat, atol=1e-9)
    no_dtm = replace(data, dtm=np.full_like(data.dtm, np.nan))
    assert abs(on_cells(fitted(no_dtm, clusters), data) - truth)[clusters.mask].mean() < 0.05


def test_fit_without_terrain_ignores_dtm():
    data, clusters, truth = tile(noise=0.02)
    other_dtm = replace(data, dtm=data.dtm + 50 * np.random.default_rng(5).random(data.dtm.shape))
    a, b = (fitted(d, clusters, terrain=False) for d in (data, other_dtm))
    np.testing.assert_array_equal(a.A, b.A)
    assert a.datum == b.datum
    assert abs(on_cells(a, data) - truth)[clusters.mask].mean() < 0.05


def test_fit_needs_cells_for_its_control_points():
    data, clusters, _ = tile(shape=(10, 10))
    with pytest.raises(TaskError, match="10 x 10 cells are fewer than 15 x 15 control points"):
        fitted(data, clusters)
    with pytest.raises(TaskError, match="10 x 10 cells are fewer than 9000001 x 9000001 control points"):
        fitted(data, clusters, spacing_m=1e-6)
    for rows, points, message in (
        (5, 8, "50 cells with a height are fewer than 8 x 8 control points"),
        (0, 4, "no filtered road cell has a DSM height to start from.* empty too"),
    ):
        known = np.arange(10)[:, None] < rows
        few = replace(data, dsm=np.where(known, data.dsm, np.nan), dtm=np.where(known, data.dtm, np.nan))
        with pytest.raises(TaskError, match=message):
            fitted(few, clusters, control_points=(points, points))
    assert fitted(*tile(shape=(81, 41))[:2], spacing_m=10, iterations=1).A.shape == (9, 5)
    assert fitted(*tile(shape=(81, 41))[:2], spacing_m=40, iterations=1).A.shape == (4, 4)
    row, road, _ = tile(shape=(1, 400))
    with pytest.raises(TaskError, match="at least 2 x 2 cells, not 400 x 1"):
        fitted(row, road, control_points=(4, 4))


@pytest.mark.parametrize(
    ("gpus", "device", "devices"), [(0, "cuda", "cpu"), (1, "cuda:1", "cpu or cuda:0"), (0, "cuda:0", "cpu")]
)
def test_fit_missing_device_raises(monkeypatch, gpus, device, devices):
    monkeypatch.setattr("torch.cuda.device_count", lambda: gpus)
    data, clusters, _ = tile()
    with pytest.raises(
        TaskError, match=f"no device '{device}' on this machine; set fit.device to {devices}$"
    ):
        fitted(data, clusters, engine="torch", device=device)


@pytest.mark.parametrize("device", ["cuda", "cuda:0"])
def test_fit_on_gpu_gives_same_surface(device):
    needs_gpu()
    data, clusters, _ = tile(noise=0.05)
    a = fitted(data, clusters, iterations=100)
    b = fitted(data, clusters, iterations=100, engine="torch", device=device)
    np.testing.assert_allclose(on_cells(a, data), on_cells(b, data), atol=1e-5)
