"""Meshes of tiles with several levels meet on abutments, and on the borders of tiles."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely

from flexroad.tasks.metrics.mesh_check import faults
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.sample import Options, sample
from tests.crossing import GROUND_M, RISE, WEST, Crossing
from tests.mesh_union import Union

PLACES = {
    "in one tile": Crossing(),
    "over a border": Crossing((60.0, 30.0)),
    "over a corner": Crossing((60.0, 60.0), angle=45.0),
    "acute": Crossing((61.0, 30.0), angle=83.0),
    "abutment on a border": Crossing((50.0, 30.0)),
    "abutment near a border": Crossing((53.0, 30.0)),
    "abutment crosses a border": Crossing((30.0, 59.0), width=8.0),
    "side on a border": Crossing((30.0, 56.0)),
    "tunnel": Crossing((58.0, 33.0), angle=20.0, number=-1),
}
CASES = pytest.mark.parametrize("crossing", PLACES.values(), ids=PLACES.keys())


@cache
def meshes(crossing):
    options = Options()
    return [sample(*tile[:3], options, tile.frame) for tile in crossing.tiles()]


def absolute(mesh):
    """Vertices of a mesh in coordinates that float32 holds, and its faces."""
    places = mesh.vertices.astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(places, mesh.vertices, atol=1e-4)
    return mesh.vertices + mesh.origin, mesh.faces


def at_abutments(mesh, level):
    """Vertices on the abutments: their place in plan and their height, as a GLB has it."""
    near = shapely.dwithin(level.abutments, shapely.points(mesh.vertices[:, :2] + mesh.origin[:2]), 0.02)
    return {tuple(vertex) for vertex in mesh.vertices[near].astype(np.float32).tolist()}


@CASES
def test_levels_are_height_fields_with_common_vertices_on_abutments(crossing):
    number, level, count = crossing.number, crossing.level, 0
    for mesh in meshes(crossing):
        assert all(faults(mesh.at(k)) == () for k in mesh.numbers)
        if number in mesh.numbers:
            of_ground, of_deck = (at_abutments(mesh.at(k), level) for k in (0, number))
            assert of_ground == of_deck
            count += len(of_deck)
    assert count >= 4


@CASES
def test_levels_have_no_open_edge_over_borders(crossing):
    parts, number = meshes(crossing), crossing.number
    for k in (0, number):
        whole = Union.of(absolute(mesh.at(k)) for mesh in parts if k in mesh.numbers)
        start, side = np.array([500000.0, 5600000.0]), crossing.size
        open_edges = whole.middles[whole.uses == 1] - start
        inner = np.abs(open_edges - side).min(axis=1) < 1e-9
        outline = shapely.boundary(crossing.level.areas)
        if k:
            inner &= ~shapely.dwithin(outline, shapely.points(open_edges + start), 0.02)
        assert open_edges[inner].tolist() == []
        assert whole.uses.max() <= 2
        assert whole.area == pytest.approx((2 * side) ** 2 if k == 0 else crossing.level.areas.area, abs=0.1)


@CASES
def test_edges_of_deck_on_abutments_are_edges_of_ground(crossing):
    level = crossing.level

    def edges_on_abutments(mesh, most):
        pairs = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
        pairs, uses = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)
        ends = mesh.vertices[pairs[uses <= most]] + mesh.origin
        middles = shapely.points(ends[..., :2].mean(axis=1))
        on_abutment = shapely.dwithin(level.abutments, middles, 0.02)
        return {frozenset(map(tuple, pair)) for pair in ends[on_abutment].tolist()}

    parts = meshes(crossing)
    ground = set().union(*(edges_on_abutments(mesh.at(0), 2) for mesh in parts))
    deck = set().union(*(edges_on_abutments(mesh.at(crossing.number), 1) for mesh in parts))
    assert deck
    assert deck <= ground


def test_heights_of_meshes_are_those_of_levels():
    crossing = Crossing((40.0, 30.0), angle=10.0)
    tile = next(crossing.tiles())
    grid, level = tile.road.core, crossing.level
    mesh = sample(*tile[:3], Options(), tile.frame)
    ground, deck = (drape(mesh.at(k), grid) + mesh.origin[2] for k in (0, 1))
    x, y = np.meshgrid(grid.eastings, grid.northings)
    inside = shapely.intersects_xy(level.areas, x, y)
    np.testing.assert_array_equal(np.isfinite(deck), inside)
    np.testing.assert_allclose(deck[inside], (107 + RISE * (x - WEST))[inside], atol=0.003)
    away = inside & ~shapely.dwithin(level.abutments, shapely.points(x, y), 1.0)
    np.testing.assert_allclose(ground[away], GROUND_M, atol=0.003)
    assert (ground[inside] < deck[inside] - 0.05).all()
    assert mesh.road[mesh.level == 1].all()


def test_mesh_of_tile_far_from_decks_is_that_without_levels():
    crossing = Crossing((30.0, 30.0))
    *_, tile = crossing.tiles()
    options = Options()
    mesh = sample(*tile[:3], options, tile.frame)
    spline = replace(tile.surface, levels=())
    plain = sample(spline, replace(tile.road, levels=()), tile.clusters, options, tile.frame)
    assert mesh.level is None
    np.testing.assert_array_equal(mesh.vertices, plain.vertices)
    np.testing.assert_array_equal(mesh.faces, plain.faces)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(30))
def test_random_decks_and_tunnels_meet_the_ground(seed):
    rng = np.random.default_rng(seed)
    crossing = Crossing(
        middle=tuple(rng.uniform(28, 92, 2)),
        angle=rng.choice([0, 45, 90, *rng.uniform(0, 360, 6)]),
        length=rng.uniform(8, 40),
        width=rng.uniform(2.5, 14),
        number=int(rng.choice([1, -1, 2])),
    )
    test_levels_are_height_fields_with_common_vertices_on_abutments(crossing)
    test_levels_have_no_open_edge_over_borders(crossing)
    test_edges_of_deck_on_abutments_are_edges_of_ground(crossing)
