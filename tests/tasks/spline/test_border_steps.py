"""The ground beside a road goes on across the border of two tiles, at equal heights in both."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from flexroad.catalog.borders import border_of
from flexroad.pipeline.store.artefacts import decode, encode
from flexroad.tasks import sample
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.metrics.mesh_check import check
from flexroad.tasks.types import RoadClusters, RoadMask, TileData
from tests.builders import make_frame, make_grid

SIZE, AROUND_M, STEP_M = 60, 40, 0.3
TILES = [make_grid(SIZE, SIZE, west=500000.0 + SIZE * k, north=5600060.0) for k in (0, 1)]
EDGE = TILES[1].west
WORLD = make_grid(220, 160, west=499950.0, north=5600110.0)
OPTIONS = smoothing_spline.Options()
ALONG = {
    "across the edge": lambda x, y: np.abs(y - 5600030) < 5,
    "beside the edge": lambda x, y: (x > EDGE) & (x < EDGE + 8),
}
"""Where the road is."""


def ground(x, y, where):
    """The true height: a level road, and ground above it beside."""
    return 100 + np.where(ALONG[where](x, y), 0.0, STEP_M)


@cache
def world(where):
    x, y = np.meshgrid(WORLD.eastings, WORLD.northings)
    road = ALONG[where](x, y)
    away = distance_transform_edt(~road)
    dsm = ground(x, y, where) + 0.01 * np.random.default_rng(0).standard_normal(WORLD.shape)
    beside = ~road & (away < 9)
    return dsm, ground(x, y, where), road, ~road & (away < 6), beside


def part(where, grid, core=None):
    core = core or grid
    window = WORLD.window(grid)
    dsm, dtm, road, verge, beside = (values[window] for values in world(where))
    data = TileData("t", grid, core, dsm, dtm)
    mask = RoadMask(grid, core, road, np.zeros_like(road))
    return data, mask, RoadClusters(grid, road.astype(np.int32), verge, beside)


@cache
def frame_of(where, tile):
    return make_frame(lambda grid: part(where, grid), tile, AROUND_M, OPTIONS)


@cache
def fitted(where, number):
    tile = TILES[number]
    data, _, clusters = part(where, tile.buffered(20), tile)
    return smoothing_spline.fit(data, clusters, OPTIONS, frame_of(where, tile))


ON_EDGE = 5600000 + np.linspace(0, SIZE, 10 * SIZE + 1)


def test_ground_goes_on_across_the_edge():
    surface, y = fitted("across the edge", 0), 5600000 + np.arange(1, SIZE - 1) + 0.5
    true = ground(EDGE, y, "across the edge")
    near = np.abs(y - 5600030) < 12
    assert np.abs(surface.height(EDGE, y) - true)[near].max() < 0.05
    assert np.abs(surface.smooth(EDGE, y) - true)[near].max() > 0.2
    on_road = ALONG["across the edge"](EDGE, y)
    assert np.array_equal(surface.height(EDGE, y)[on_road], surface.smooth(EDGE, y)[on_road])


def test_edge_of_a_road_along_the_border_is_not_moved():
    surface = fitted("beside the edge", 0)
    assert surface.steps[:, -1].mean() == pytest.approx(STEP_M, abs=0.05)
    assert np.array_equal(surface.height(EDGE, ON_EDGE), surface.smooth(EDGE, ON_EDGE))


def test_corners_have_the_height_of_the_spline():
    surface = fitted("across the edge", 0)
    west, south, east, north = TILES[0].bounds
    x, y = np.array([west, east, west, east]), np.array([south, south, north, north])
    assert np.array_equal(surface.height(x, y), surface.smooth(x, y))


@pytest.mark.parametrize("method", ["dynamic", "uniform"])
def test_meshes_meet_with_steps_away_from_the_road(method):
    found = []
    for number, tile in enumerate(TILES):
        _, mask, clusters = part("across the edge", tile.buffered(20), tile)
        options = sample.Options(method=method)
        surface = fitted("across the edge", number)
        mesh = sample.sample(surface, mask, clusters, options, frame_of("across the edge", tile))
        check(mesh)
        points = mesh.vertices + mesh.origin
        found.append(points[points[:, 0] == EDGE][:, 1:])
    west, east = (points[np.argsort(points[:, 0])] for points in found)
    assert np.array_equal(west, east)
    y, z = west.T
    np.testing.assert_allclose(np.interp([5600020, 5600040], y, z), 100 + STEP_M, rtol=0, atol=0.05)
    near = np.abs(y - 5600030) < 6
    np.testing.assert_allclose(z[near], fitted("across the edge", 0).smooth(EDGE, y[near]), rtol=0, atol=2e-4)


def test_edge_is_stored_without_loss():
    edge = frame_of("across the edge", TILES[0]).east
    restored, *_ = decode(encode(edge, {}, (), ""), "")
    assert np.array_equal(restored.steps, edge.steps)
    assert np.array_equal(restored.road_m, edge.road_m)


def test_edge_without_steps_has_none():
    tile = TILES[0]
    border = border_of(tile, AROUND_M)[7]
    frame = frame_of("across the edge", tile)
    options = OPTIONS.model_copy(update={"steps": False})
    made = part("across the edge", border.grid), border, (frame.south_east, frame.north_east), options
    assert smoothing_spline.edge(*made[0], *made[1:]).steps is None
