"""Kerbs and walls beside a straight road: both sides have their own height."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.pipeline.store.artefacts import decode, encode
from flexroad.tasks import sample
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.metrics.mesh_check import check
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.spline.stepped import between
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import RoadClusters, RoadMask, TileData

GRID = Grid("EPSG:25832", 500000.0, 5600060.0, 1.0, 60, 60)
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
    clusters = RoadClusters(GRID, ROAD.astype(np.int32), VERGE, BESIDE)
    return TileData("t", GRID, GRID, dsm, smoothed), clusters, truth


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
    """Neighbours meet there: the heights are those of the common spline."""
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


def test_steps_height_equals_lattice():
    data, clusters, _ = tile(4.0)
    surface = fitted(data, clusters)
    x, y = np.meshgrid(GRID.eastings, GRID.northings)
    np.testing.assert_allclose(surface.height(x, y), heights(surface), rtol=0, atol=1e-9)


def test_surface_without_verge_has_no_steps():
    data, clusters, _ = tile(4.0)
    assert type(fitted(data, RoadClusters(GRID, clusters.labels))) is NurbsSurface


def test_ground_beside_the_road_is_the_dtm():
    """Grass is in the DSM; where neither has a height, the ground is between that of the cells around."""
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


def test_stepped_surface_is_stored_without_loss():
    data, clusters, _ = tile(4.0)
    surface = fitted(data, clusters)
    restored, *_ = decode(encode(surface, {}, (), ""), "")
    assert type(restored) is type(surface)
    assert isinstance(restored, NurbsSurface)
    assert heights(restored).tobytes() == heights(surface).tobytes()


@pytest.mark.parametrize("height", [0.12, 4.0, -4.0])
def test_mesh_has_edges_of_steps(height):
    data, clusters, truth = tile(height)
    nothing = np.zeros_like(ROAD)
    road = RoadMask(GRID, GRID, ROAD, nothing)
    errors = []
    for steps in (False, True):
        options = sample.Options(breaklines=steps)
        mesh = sample.sample(fitted(data, clusters, steps), road, clusters, options)
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
    road = RoadMask(GRID, GRID, ROAD, np.zeros(GRID.shape, bool))
    plain, stepped = (
        sample.sample(fitted(data, clusters, steps), road, clusters, sample.Options(method=method))
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


def test_plane_with_a_hole_is_filled_with_the_plane():
    plane = 3 + 0.2 * ROW - 0.1 * COL
    hole = (ROW > 3) & (ROW < 8) & (COL > 4) & (COL < 10)
    np.testing.assert_allclose(between(np.where(hole, np.nan, plane), INSIDE), plane, atol=1e-6)


def test_cells_outside_have_no_effect():
    values = np.where(COL == 1, 5.0, np.where(INSIDE, np.nan, 1e6))
    np.testing.assert_allclose(between(values, INSIDE)[INSIDE], 5.0, atol=1e-5)


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
