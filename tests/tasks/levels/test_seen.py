"""Surfaces of several levels on synthetic crossings with known heights, and what each level sees of them."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from flexroad.pipeline.store.artefacts import encode
from flexroad.tasks.levels.seen import level_data, level_road, top_mask
from flexroad.tasks.roads.rasterise import cells
from tests.builders import make_grid
from tests.make_crossings import Survey, block

LARGEST_M = {"deck": 0.02, "under": 0.06, "near": 0.06, "beside": 0.08}
"""Largest mean errors of a deck, the road below it, and the ground near it and beside it."""


def check_errors(survey, core):
    errors, before = survey.errors(survey.tile(core)), survey.errors(survey.tile(core, levels=False))
    for name, most in LARGEST_M.items():
        assert errors[name] <= most, (name, errors)
    for name in ("approach", "other"):
        assert errors[name] <= before[name] + 0.001, (name, errors, before)
    assert before["under"] > 3


@pytest.mark.parametrize("seed", [0, pytest.param(3, marks=pytest.mark.slow)])
def test_levels_have_their_true_heights(tmp_path, seed):
    core = block(80)
    check_errors(Survey.of(tmp_path, seed, core, tunnels=0), core)


@pytest.mark.parametrize("seed", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_tunnel_has_its_true_height(tmp_path, seed):
    core = block(80)
    survey = Survey.of(tmp_path, seed, core, tunnels=1)
    errors, before = survey.errors(survey.tile(core)), survey.errors(survey.tile(core, levels=False))
    assert errors["tunnel"] <= 0.06
    assert errors["near"] <= 0.06
    assert errors["approach"] <= 0.03
    assert errors["other"] <= before["other"] + 0.001


def quarters(core):
    """Return the four tiles of half the size, by column and row."""
    n, size = core.width // 2, core.width // 2 * core.cell
    return {
        (i, j): make_grid(n, n, core.cell, core.west + i * size, core.north - (1 - j) * size)
        for i in (0, 1)
        for j in (0, 1)
    }


def check_borders(survey, core):
    """Check that the levels of neighbours meet, and return the number of points on decks or tunnels."""
    tiles = quarters(core)
    results = {key: survey.tile(tile) for key, tile in tiles.items()}
    along = np.random.default_rng(1).uniform(0, core.width / 2, 500)
    on_levels = 0
    for (one, other), vertical in (
        (((0, 0), (1, 0)), True),
        (((0, 1), (1, 1)), True),
        (((0, 0), (0, 1)), False),
        (((1, 0), (1, 1)), False),
    ):
        west, south, *_ = tiles[other].exact_bounds
        x, y = (np.full(500, west), south + along) if vertical else (west + along, np.full(500, south))
        first, second = results[one], results[other]
        np.testing.assert_allclose(first.surface.normal(x, y), second.surface.normal(x, y), rtol=0, atol=1e-9)
        shared = {level.number: level for level in first.road.levels}
        places = {0: np.ones(500, bool)} | {level.number: level.covers(x, y) for level in second.road.levels}
        for number, here in places.items():
            if number:
                np.testing.assert_array_equal(here, shared[number].covers(x, y))
                on_levels += here.sum()
            heights = (result.surface.at(number).height(x[here], y[here]) for result in (first, second))
            np.testing.assert_array_equal(*(np.round(height * 2**12) for height in heights))
    return on_levels


@pytest.mark.parametrize("tunnels", [0, 1])
def test_neighbours_meet_on_every_level(tmp_path, tunnels):
    core = block(100)
    assert check_borders(Survey.of(tmp_path, 2, core, tunnels=tunnels), core) > 0


@pytest.mark.slow
@pytest.mark.soak("levels")
@pytest.mark.parametrize("seed", range(50))
def test_random_crossings_have_their_true_heights_and_meet(tmp_path, seed):
    core = block(100)
    survey = Survey.of(tmp_path, seed, core, tunnels=0)
    check_errors(survey, core)
    check_borders(survey, core)


def test_tile_neighbour_and_edge_find_the_same_abutments(tmp_path):
    core = block(100)
    survey = Survey.of(tmp_path, 0, core, tunnels=0)
    levels = [level for tile in (core, *quarters(core).values()) for level in survey.tile(tile).road.levels]
    assert len(levels) == 5
    abutments, *others = (shapely.normalize(level.abutments) for level in levels)
    assert len(abutments.geoms) == 2
    assert all(shapely.equals_exact(abutments, other) for other in others)


def test_tile_without_decks_has_the_bytes_of_one_without_the_option(tmp_path):
    core = block(60)
    survey = Survey.of(tmp_path, 0, core, lambda lines: [replace(line, level=0) for line in lines], tunnels=0)
    with_option, without = survey.tile(core), survey.tile(core, levels=False)
    assert with_option.road.mask.any()
    for name in ("road", "clusters", "surface"):
        one, other = getattr(with_option, name), getattr(without, name)
        assert encode(one, {}, (), "") == encode(other, {}, (), "")


def test_levels_see_their_own_heights(tmp_path):
    core = block(80)
    survey = Survey.of(tmp_path, 0, core, tunnels=0)
    result = survey.tile(core)
    (level,) = result.road.levels
    grid = result.data.grid
    x, y = np.meshgrid(grid.eastings, grid.northings)
    deck = level.covers(x, y)
    ground, above = (level_data(result.data, result.clusters, number) for number in (0, 1))
    assert np.isnan(ground.dsm[deck]).all()
    np.testing.assert_array_equal(above.dsm[deck], result.data.dsm[deck])
    assert np.isnan(above.dtm[deck]).all()
    np.testing.assert_array_equal(level_road(result.road, 1).mask, deck)
    assert top_mask(result.clusters)[deck].mean() > 0.9
    # The approach is the deck's, not the ground's.
    taken = level.weight(x, y) >= 1
    assert not result.clusters.mask[taken].any()


def test_raster_of_a_level_is_kept_and_not_changed_by_its_users(tmp_path):
    core = block(80)
    result = Survey.of(tmp_path, 0, core, tunnels=0).tile(core)
    (level,) = result.road.levels
    first = level_road(result.road, 1).mask
    np.testing.assert_array_equal(first, cells(np.array([level.areas]), result.data.grid))
    first[:] = False
    assert level_road(result.road, 1).mask.any()
    # Without the empty cells around it.
    kept = sum(part.size for _, part in level.rasters.values())
    assert kept < 0.2 * len(level.rasters) * first.size
