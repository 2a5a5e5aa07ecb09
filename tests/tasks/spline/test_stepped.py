"""Kerbs and walls beside a straight road: both sides have their own height."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.pipeline.store.artefacts import decode, encode
from flexroad.tasks import sample
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.meshing.survey_limit import APART, breaklines
from flexroad.tasks.metrics.mesh_check import check
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.spline.stepped import SteppedSurface, between
from flexroad.tasks.spline.surface import NurbsSurface
from tests.builders import make_clusters, make_grid, make_mask, make_tile

GRID = make_grid(60, 60)
ROWS = np.arange(60)[:, None] * np.ones(60)
ROAD = np.abs(ROWS - 29.5) < 5
EDGE = np.abs(np.abs(ROWS - 29.5) - 5) < 1
"""The cells within 1 m of the edges of the road."""
VERGE = (np.abs(ROWS - 29.5) < 10) & ~ROAD
BESIDE = (np.abs(ROWS - 29.5) < 13) & ~ROAD
ROW, COL = np.indices((12, 15)).astype(float)
INSIDE = COL > 0


def tile(height, noise_m=0.02):
    """Return a level road between steps, its filtered road, and the true heights; the DTM is smoothed."""
    beyond = np.clip(np.abs(ROWS - 29.5) - 4.5, 0, None)
    truth = 100 + np.where(ROAD, 0.0, height)
    smoothed = 100 + height * np.clip(beyond / 2, 0, 1)
    dsm = truth + noise_m * np.random.default_rng(0).standard_normal(GRID.shape)
    return make_tile(dsm, smoothed), make_clusters(ROAD, dtm_invalid=VERGE, beside=BESIDE), truth


def fitted(data, clusters, steps=True):
    return smoothing_spline.fit(data, clusters, smoothing_spline.Options(steps=steps))


def heights(surface):
    return surface.lattice(GRID.eastings, GRID.northings)


def inner(cells):
    result = np.zeros_like(cells)
    result[1:-1, 1:-1] = cells[1:-1, 1:-1]
    return result


@pytest.mark.parametrize("height", [0.12, -0.12, 4.0, -4.0])
def test_steps_error_at_edge_is_halved_and_road_unchanged(height):
    data, clusters, truth = tile(height)
    smooth, stepped = fitted(data, clusters, steps=False), fitted(data, clusters)
    before, after = (np.abs(heights(s) - truth)[inner(EDGE)].mean() for s in (smooth, stepped))
    assert after < before / 2
    assert np.array_equal(stepped.A, smooth.A)
    assert np.array_equal(heights(stepped)[ROAD], heights(smooth)[ROAD])
    assert np.abs(heights(stepped) - truth)[inner(VERGE)].mean() < 0.03
    restored, *_ = decode(encode(stepped, {}, (), ""), "")
    assert type(restored) is type(stepped)
    assert heights(restored).tobytes() == heights(stepped).tobytes()


def test_steps_on_level_ground_are_noise():
    data, clusters, truth = tile(0.0)
    assert np.abs(heights(fitted(data, clusters)) - truth)[inner(VERGE)].max() < 0.05


def test_steps_hidden_cells_are_on_their_side_of_wall():
    data, clusters, truth = tile(4.0)
    hedge, car = (slice(22, 25), slice(20, 23)), (slice(25, 28), slice(40, 43))
    data.dsm[hedge] += 3.0
    data.dsm[car] = 101.6
    clusters.labels[car] = 0
    clusters.dtm_invalid[car] = True
    found = heights(fitted(data, clusters))
    assert np.abs(found - truth)[car].max() < 0.1
    rim = np.s_[22:24, [20, 22]]
    assert np.abs(found - truth)[rim].max() < 0.5


def test_height_on_the_border_is_that_of_the_spline():
    """Neighbours meet there: the heights are the common spline's."""
    data, clusters, _ = tile(4.0)
    surface = fitted(data, clusters)
    west, south, east, north = GRID.bounds
    along = np.linspace(0, 60, 241)
    for x, y in ((west, south + along), (east, south + along), (west + along, south), (west + along, north)):
        x, y = np.broadcast_arrays(x, y)
        assert surface.height(x, y).tobytes() == surface.smooth(x, y).tobytes()
    nodes = surface.lattice(np.linspace(west, east, 5), np.linspace(south, north, 5))
    expected = surface.smooth(np.linspace(west, east, 5), np.full(5, south))
    np.testing.assert_allclose(nodes[0], expected, rtol=0, atol=1e-9)
    assert np.abs(surface.steps[:, [0, -1]]).max() > 1
    inside = surface.height(*np.meshgrid(GRID.eastings, GRID.northings))
    np.testing.assert_allclose(inside, heights(surface), rtol=0, atol=1e-9)


def test_surface_without_verge_has_no_steps():
    data, clusters, _ = tile(4.0)
    assert type(fitted(data, make_clusters(clusters.mask))) is NurbsSurface


def test_ground_beside_the_road_is_the_dtm():
    """Grass is in the DSM; where neither has a height, the ground is between the cells around."""
    data, clusters, _ = tile(1.0, noise_m=0.0)
    bank = 100 + 0.1 * np.clip(np.abs(ROWS - 29.5) - 4.5, 0, None)
    void = (slice(20, 22), slice(30, 33))
    data = replace(data, dsm=bank + 0.15 * VERGE, dtm=bank.copy())
    data.dsm[void], data.dtm[void] = np.nan, np.nan
    found, far = heights(fitted(data, clusters)), inner(BESIDE & (np.abs(ROWS - 29.5) > 8))
    far[void] = False
    assert np.abs(found - bank)[far].max() < 1e-6
    assert np.abs(found - bank)[void].max() < 0.05


def test_hidden_road_has_no_steps():
    """The filter dropped it, and its DTM is not the road's: the spline continues the road."""
    data, clusters, _ = tile(1.0)
    crown = (slice(26, 33), slice(20, 40))
    data.dsm[crown], data.dtm[crown], clusters.labels[crown] = 108.0, 101.0, 0
    clusters.dtm_invalid[crown] = True
    plain, stepped = (heights(fitted(data, clusters, steps)) for steps in (False, True))
    assert np.array_equal(stepped[crown], plain[crown])
    assert not np.array_equal(stepped, plain)


@pytest.mark.parametrize("height", [0.12, 4.0, -4.0])
def test_mesh_has_edges_of_steps(height):
    data, clusters, truth = tile(height)
    errors = []
    for steps in (False, True):
        options = sample.Options(breaklines=steps)
        mesh = sample.sample(fitted(data, clusters, steps), make_mask(ROAD), clusters, options)
        check(mesh)
        errors.append(np.abs(drape(mesh, GRID) + mesh.origin[2] - truth)[EDGE & (np.abs(ROWS.T - 29.5) < 27)])
    assert errors[1].mean() < errors[0].mean() / 2
    assert errors[1].max() < max(0.1, abs(height) / 10)


def test_steps_are_measured_from_the_heights_that_the_road_is_fitted_to():
    data, clusters, truth = tile(0.0, noise_m=0.0)
    lifted = replace(data, dsm=data.dsm + 0.05, road_height=truth)
    assert np.abs(heights(fitted(lifted, clusters)) - truth)[inner(ROAD | VERGE)].max() < 1e-3


@pytest.mark.parametrize("method", ["dynamic", "uniform"])
def test_mesh_without_breaklines_has_a_smooth_road_and_the_ground_beside(method):
    data, clusters, truth = tile(0.5)
    plain, stepped = (
        sample.sample(fitted(data, clusters, steps), make_mask(ROAD), clusters, sample.Options(method=method))
        for steps in (False, True)
    )
    check(stepped)
    of_plain, of_stepped = (drape(mesh, GRID) + mesh.origin[2] for mesh in (plain, stepped))
    inside = inner(ROAD & (np.abs(ROWS - 29.5) < 4))
    np.testing.assert_allclose(of_stepped[inside], of_plain[inside], rtol=0, atol=0.006)
    far = inner(BESIDE & (np.abs(ROWS - 29.5) > 8) & (np.abs(ROWS.T - 29.5) < 27))
    assert np.abs(of_stepped - truth)[far].mean() < np.abs(of_plain - truth)[far].mean()


def test_breaklines_without_dynamic_sampling_are_refused():
    with pytest.raises(ValueError, match="method uniform has no breaklines; choose method dynamic"):
        sample.Options(method="uniform", breaklines=True)


def test_part_without_a_known_value_is_zero():
    values = np.where(INSIDE, np.nan, 7.0)
    assert not between(values, INSIDE)[INSIDE].any()


@given(st.integers(0, 999), st.floats(0.1, 0.9))
@settings(max_examples=30)
def test_each_filled_value_is_the_mean_of_its_neighbours(seed, share):
    rng = np.random.default_rng(seed)
    cells = INSIDE & (rng.random(ROW.shape) < 0.8)
    known = rng.normal(size=ROW.shape)
    unknown = cells & (rng.random(ROW.shape) < share)
    filled = between(np.where(unknown, np.nan, known), cells)
    np.testing.assert_array_equal(filled[~unknown], known[~unknown])
    for row, col in np.argwhere(unknown):
        away = np.abs(ROW - row) + np.abs(COL - col)
        beside = filled[cells & (away == 1)]
        assert abs(filled[row, col] - (beside.mean() if beside.size else 0.0)) < 1e-5


CELLS = make_grid(30, 30)
LOCAL = (0.0, 0.0, 30.0, 30.0)
NOISE = 0.1 * np.random.default_rng(0).standard_normal(CELLS.shape)
HIGH = np.zeros(CELLS.shape, bool)
HIGH[10:20] = True


def level(steps) -> SteppedSurface:
    """A level spline with steps."""
    knots = np.array([0.0, 0, 1, 1])
    spline = {"crs": CELLS.crs, "bounds": CELLS.exact_bounds, "degree": (1, 1), "datum": 0.0}
    spline |= {"knots_u": knots, "knots_v": knots, "A": np.full((2, 2), 100.0), "W": np.ones((2, 2))}
    steps = np.asarray(steps, np.float32)
    spline |= {"south_north": np.zeros((2, CELLS.width)), "west_east": np.zeros((2, CELLS.height))}
    return SteppedSurface(**spline, origin=CELLS.origin, steps=steps, cells=CELLS)


def test_noise_of_single_cells_has_no_line():
    assert breaklines(level(NOISE), LOCAL)[0].is_empty


@pytest.mark.parametrize("step", [0.3, -4.0])
def test_edge_with_noise_has_two_lines_with_its_heights(step):
    lines, height = breaklines(level(np.where(HIGH, step, 0.0) + 0.3 * NOISE), LOCAL)
    _, low, _, high = lines.bounds
    assert (low, high) == pytest.approx((10 - APART / 2, 20 + APART / 2))
    # Two lines around a block that ends one cell from the border of the tile.
    assert lines.length == pytest.approx(2 * 2 * (28 + 10), rel=0.05)
    sides = np.array([[15.5, 20 - APART / 2], [15.5, 20 + APART / 2]])
    np.testing.assert_allclose(height(sides), [100 + step, 100], atol=0.2)
