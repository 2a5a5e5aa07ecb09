import math
from itertools import pairwise

import numpy as np
import pytest
import shapely

from flexroad.catalog import Grid
from flexroad.tools.synthetic import Kind, block
from flexroad.tools.synthetic.crossings import (
    CROSS_M,
    DECK_M,
    MAIN_M,
    SPACING_M,
    CrossingOptions,
    Crossings,
    make_crossings,
)

CLEAN = CrossingOptions(density=0, dsm_noise_m=0, dtm_noise_m=0)
DECKS, TUNNELS = CrossingOptions(tunnels=0), CrossingOptions(tunnels=1)
RAGGED = (Kind.CROWN, Kind.RAIL)
AROUND = (499_900, 5_599_900, 500_400, 5_600_400)
GRID = Grid("EPSG:25832", 500_000, 5_600_120, 1.0, 120, 120)
"""Crossing 0 lies in it."""


def axis(world, level):
    """Return the piece of the main road on a level that is nearest to the corner of the block."""
    lines = [shapely.LineString(road.points) for road in world.roads(AROUND) if road.level == level]
    return min(lines, key=lambda line: line.distance(shapely.Point(500_040, 5_600_040)))


def on(line, along, across=0.0):
    """Return easting and northing of points along a line and to its left (m)."""
    (x, y), (to_x, to_y) = line.coords
    u = np.array([to_x - x, to_y - y]) / line.length
    along, across = np.broadcast_arrays(along, across)
    return x + along * u[0] - across * u[1], y + along * u[1] + across * u[0]


@pytest.mark.parametrize(("options", "level"), [(DECKS, 1), (TUNNELS, -1)])
@pytest.mark.parametrize("seed", range(0, 50, 7))
def test_clearance_is_that_of_the_options_where_the_roads_cross(seed, options, level):
    world = Crossings(seed, options.model_copy(update={"clearance_m": (6.5, 6.5)}))
    line = axis(world, level)
    at = on(line, line.length / 2)
    between = world.height(level, *at) - world.height(0, *at)
    assert between == pytest.approx(level * 6.5, abs=1e-9)


@pytest.mark.parametrize(("options", "level"), [(DECKS, 1), (TUNNELS, -1)])
@pytest.mark.parametrize("seed", range(0, 50, 5))
def test_levels_meet_at_the_ends_of_decks_and_tunnels(seed, options, level):
    world = Crossings(seed, options)
    line = axis(world, level)
    across = np.linspace(-MAIN_M, MAIN_M, 33) * 0.999
    for inside, outside in ((1e-5, -1e-5), (line.length - 1e-5, line.length + 1e-5)):
        here = world.height(level, *on(line, inside, across))
        beyond = world.height(0, *on(line, outside, across))
        np.testing.assert_allclose(here, beyond, atol=1e-5)
        assert np.isnan(world.height(level, *on(line, outside, across))).all()
    # Approaches are as smooth as the road: no embankment's slope reaches onto them.
    s = np.linspace(-30, -1e-5, 300)
    grade = np.diff(world.height(0, *on(line, s, 3.9))) / np.diff(s)
    assert np.abs(grade).max() < 0.16
    assert np.abs(np.diff(grade)).max() < 0.002


@pytest.mark.parametrize("seed", range(0, 50, 5))
def test_road_below_a_deck_is_free_of_banks_and_walls(seed):
    world = Crossings(seed, CrossingOptions(tunnels=0, wall_m=(2, 2), slopes=float(seed % 4 > 0)))
    line = axis(world, 1)
    crossing = next(
        road
        for road in (shapely.LineString(road.points) for road in world.roads(AROUND) if not road.level)
        if road.crosses(line)
    )
    t = np.linspace(0, crossing.length, 721)
    heights = np.stack([world.height(0, *on(crossing, t, side)) for side in (-CROSS_M, 0, CROSS_M)])
    fall = 0.025 * (math.hypot(CROSS_M, 0.5) - 0.5)
    np.testing.assert_allclose(heights[[0, 2]] - heights[1], -fall, atol=1e-4)
    assert np.abs(np.diff(heights[1]) / np.diff(t)).max() < 0.12
    clear = world.height(1, *on(crossing, t)) - heights[1]
    assert np.nanmin(clear) > 4.5
    end = shapely.LineString(np.column_stack(on(line, 0.0, np.array([-DECK_M, DECK_M]))))
    away = end.distance(crossing) - CROSS_M
    assert away > 10 if seed % 4 else away == pytest.approx(2.0, abs=1e-6)


def test_deck_is_flat_rectangle_of_its_area():
    world = Crossings(3, DECKS)
    (deck,) = (area for area in world.areas(1, AROUND) if area.contains(axis(world, 1).centroid))
    line = axis(world, 1)
    assert deck.area == pytest.approx(2 * DECK_M * line.length)
    east, north = np.meshgrid(np.arange(499_980, 500_160) + 0.5, np.arange(5_599_980, 5_600_160) + 0.5)
    inside = shapely.contains_xy(deck, east, north)
    assert np.array_equal(np.isfinite(world.height(1, east, north)), inside)
    assert not world.areas(-1, AROUND).size
    # Crowned by 2.5% of the distance from the axis, rounded in the middle.
    middle = world.height(1, *on(line, line.length / 2))
    side = world.height(1, *on(line, line.length / 2, 4.0))
    assert middle - side == pytest.approx(0.025 * (math.hypot(4, 0.5) - 0.5), abs=1e-9)


def test_roads_join_and_have_the_level_of_their_place():
    world = Crossings(5, CrossingOptions(tunnels=0.5))
    main = [road for road in world.roads(AROUND) if road.width_m == 2 * MAIN_M]
    assert [road.level for road in main[1::3]][:3] in ([1, -1, 1], [-1, 1, -1])
    for before, after in pairwise(main):
        np.testing.assert_array_equal(before.points[-1], after.points[0])
    lengths = [math.dist(*road.points) for road in main]
    assert sum(lengths[:3]) == pytest.approx(SPACING_M)
    for road in main:
        heights = world.height(road.level, *road.points.mean(axis=0))
        assert np.isfinite(heights)
        if road.level:
            assert abs(heights - world.height(0, *road.points.mean(axis=0))) > 5.5 - 1e-9
    assert world.roads((0, 0, 100, 100)) == []


def test_scene_without_noise_shows_the_top_level_and_a_terrain_without_decks():
    scene = make_crossings(GRID, 1, CLEAN)
    deck = np.isfinite(scene.levels[1])
    assert deck.sum() == pytest.approx(Crossings(1, CLEAN).areas(1, GRID.bounds)[0].area, rel=0.1)
    np.testing.assert_array_equal(scene.dsm[deck], scene.levels[1][deck])
    np.testing.assert_array_equal(scene.dsm[~deck], scene.levels[0][~deck])
    np.testing.assert_array_equal(scene.reference, scene.dsm)
    assert np.array_equal(scene.kind == Kind.DECK, deck)
    assert (scene.dsm - scene.dtm)[deck].max() > 4.5
    assert np.array_equal(scene.road_mask, scene.reference_road)


def test_terrain_model_below_a_deck_is_linear_between_its_sides():
    world = Crossings(1, DECKS)
    line = axis(world, 1)
    s = np.linspace(0.01, line.length - 0.01, 50)
    left, right = (world.height(0, *on(line, s, side)) for side in (6.5, -6.5))
    for across in (-5.0, 0.0, 3.0):
        share = (across + 6.5) / 13
        expected = right + share * (left - right)
        np.testing.assert_allclose(world.terrain_model(*on(line, s, across)), expected, atol=1e-6)
    beside = on(line, s, 7.0)
    np.testing.assert_array_equal(world.terrain_model(*beside), world.height(0, *beside))


def test_scene_over_a_tunnel_shows_the_ground_above_it():
    scene = make_crossings(GRID, 2, CLEAN.model_copy(update={"tunnels": 1.0}))
    tunnel = np.isfinite(scene.levels[-1])
    assert tunnel.sum() > 50
    assert 1 not in scene.levels
    np.testing.assert_array_equal(scene.dsm, scene.levels[0])
    assert (scene.levels[0] - scene.levels[-1])[tunnel].min() > 3.5
    # Only the crossing road is visible on it.
    assert 0.2 < scene.reference_road[tunnel].mean() < 1


def test_scenes_of_neighbouring_tiles_join():
    quiet = CrossingOptions(dsm_noise_m=0, dtm_noise_m=0)
    tiles = [grid for _, grid in block(4, size_m=60)]
    whole = Grid.holding(tiles)
    both = make_crossings(whole, 4, quiet)
    for tile in tiles:
        part, window = make_crossings(tile, 4, quiet), whole.window(tile)
        for level, heights in part.levels.items():
            np.testing.assert_allclose(heights, both.levels[level][window], atol=1e-9)
        for car in (Kind.PARKED_CAR, Kind.DECK):
            # Gaps in crowns and parapets are drawn per tile.
            visible = ~np.isin(part.kind, RAGGED) & ~np.isin(both.kind[window], RAGGED)
            assert np.array_equal((part.kind == car)[visible], (both.kind[window] == car)[visible])


def test_scene_has_cars_and_parapets_but_no_car_on_a_deck_from_the_road_below():
    scene = make_crossings(GRID, 1, CrossingOptions(dsm_noise_m=0, dtm_noise_m=0))
    assert (scene.kind == Kind.RAIL).sum() > 3
    cars = scene.kind == Kind.PARKED_CAR
    assert cars.sum() > 30
    assert (scene.dsm - scene.reference)[cars].max() < 1.6
