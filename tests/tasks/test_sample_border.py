"""Meshes of neighbouring tiles join without a gap."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.tasks.metrics.mesh_check import faults
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.spline.frame import Corner, Edge, Frame
from flexroad.tasks.types import RoadClusters, RoadMask
from tests.mesh_union import Union
from tests.tasks.test_sample import Hills, areas

WEST, SOUTH = 295500.0, 5629250.0


def edge(rng, cells, share, inside=True):
    road = np.repeat(rng.random(cells // 5 + 1) < share, 5)[:cells]
    return Edge(
        np.zeros((3, 0)), road, road & (rng.random(cells) < 0.8), np.full((2, cells), not inside), np.empty(0)
    )


def block(rng, cell, size, share, inside=True):
    """Two by two tiles with their frames: grid, frame by (column, row)."""
    corner = Corner(np.zeros((3, 3)), np.full((2, 2), not inside))
    width, height = size
    lines = {("h", c, r): edge(rng, width, share, inside) for c in range(2) for r in range(3)}
    lines |= {("v", c, r): edge(rng, height, share, inside) for c in range(3) for r in range(2)}
    tiles = {}
    for c in range(2):
        for r in range(2):
            north = SOUTH + (r + 1) * height * cell
            grid = Grid("EPSG:25832", WEST + c * width * cell, north, cell, width, height)
            edges = lines["h", c, r], lines["h", c, r + 1], lines["v", c, r], lines["v", c + 1, r]
            tiles[c, r] = grid, Frame(corner, corner, corner, corner, *edges)
    return tiles


def surveyed(tiles, has_data):
    """The tiles with frames that know where a survey ends; ``has_data`` takes easting and northing."""

    def beyond(eastings, northings):
        return ~has_data(*np.broadcast_arrays(eastings, northings))

    for key, (grid, frame) in tiles.items():
        (west, south, east, north), half = grid.bounds, grid.cell / 2
        x, y = grid.eastings, grid.northings[::-1]
        parts = {}
        for name, at in (("south", south), ("north", north)):
            rows = np.stack([beyond(x, at + half), beyond(x, at - half)])
            parts[name] = replace(getattr(frame, name), outside=rows)
        for name, at in (("west", west), ("east", east)):
            columns = np.stack([beyond(at - half, y), beyond(at + half, y)])
            parts[name] = replace(getattr(frame, name), outside=columns)
        yield key, (grid, replace(frame, **parts))


def overlap_of_open_edges(whole, axis, at):
    """Largest overlap (m) of two edges of one face each on a line: easting for axis 0."""
    faces = whole.faces
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, uses = np.unique(pairs, axis=0, return_counts=True)
    ends = whole.vertices[edges[uses == 1]]
    on_line = (np.abs(ends[:, :, axis] - at) < 1e-6).all(axis=1)
    spans = np.sort(ends[on_line][:, :, 1 - axis], axis=1)
    spans = spans[np.argsort(spans[:, 0])]
    return (spans[:-1, 1] - spans[1:, 0]).max(initial=0.0)


def meshes(tiles, rng, options, outside=lambda east, north: False):
    for grid, frame in tiles.values():
        mask = np.kron(rng.random((20, 20)) < 0.3, np.ones((16, 16), bool))[: grid.height, : grid.width]
        beyond = np.broadcast_to(outside(*np.meshgrid(grid.eastings, grid.northings)), grid.shape)
        road = RoadMask(grid, grid, mask, beyond)
        yield sample(Hills(), road, RoadClusters(grid, mask.astype(np.int32)), options, frame)


def union(parts):
    return Union.of((mesh.vertices + np.array(mesh.origin), mesh.faces) for mesh in parts)


@settings(max_examples=30)
@given(
    seed=st.integers(0, 2**31),
    cell=st.sampled_from([0.1, 0.2, 0.5, 1.0, 2.0]),
    size_m=st.tuples(*(st.integers(3, 15).map(lambda half: 2 * half) for _ in range(2))),
    share=st.floats(0, 1),
    road_m=st.sampled_from([0.3, 0.7, 1.0, 2.5]),
    method=st.sampled_from(["dynamic", "uniform"]),
    mask=st.sampled_from(["raw", "filtered"]),
)
def test_meshes_of_four_tiles_join_without_open_edges(seed, cell, size_m, share, road_m, method, mask):
    """Tiles are a whole number of metres, as the catalog cuts them."""
    rng = np.random.default_rng(seed)
    size = tuple(round(length / cell) for length in size_m)
    tiles = block(rng, cell, size, share)
    options = Options(method=method, road_m=road_m * max(cell, 0.5), terrain_m=7 * max(cell, 0.5), mask=mask)
    whole = union(meshes(tiles, rng, options))
    assert whole.uses.max() == 2
    assert (whole.uses[whole.inside] == 2).all()
    assert whole.area == pytest.approx(4 * size[0] * size[1] * cell**2, rel=1e-12)


def test_mesh_borders_are_exact_in_float32():
    """Relative to a whole-metre datum, as in GLB files."""
    rng = np.random.default_rng(0)
    (grid, frame), *_ = block(rng, 1.0, (250, 250), 0.5).values()
    (mesh,) = meshes({(0, 0): (grid, frame)}, rng, Options())
    x, y, z = mesh.vertices.T
    border = (x == 0) | (x == 250) | (y == 0) | (y == 250)
    assert border.sum() > 300
    np.testing.assert_array_equal(z[border].astype(np.float32), z[border])
    assert areas(mesh).sum() == 250 * 250


def test_border_vertices_are_fine_where_the_edge_is_road():
    rng = np.random.default_rng(0)
    (grid, frame), *_ = block(rng, 1.0, (250, 250), 0.0).values()
    frame.south.road[100:120] = True
    mask = np.zeros(grid.shape, bool)
    road = RoadMask(grid, grid, mask, mask)
    mesh = sample(Hills(), road, RoadClusters(grid, mask.astype(np.int32)), Options(), frame)
    x, y, _ = mesh.vertices.T
    np.testing.assert_array_equal(x[y == 0], np.unique([*range(0, 251, 10), *range(100, 120)]))
    np.testing.assert_array_equal(x[y == 250], np.arange(0, 251, 10))


def test_faces_along_border_inside_survey_are_kept_on_both_sides():
    """A void that only one tile takes for the end of the survey."""
    rng = np.random.default_rng(0)
    tiles = {key: tile for key, tile in block(rng, 1.0, (100, 100), 0.3).items() if key[1] == 0}
    east = WEST + 100

    def outside(easting, northing):
        # Beside the border, in the western tile only.
        return (easting > east - 30) & (easting < east) & (np.abs(northing - SOUTH - 50) < 20)

    whole = union(meshes(tiles, rng, Options(), outside))
    at_border = whole.middles[:, 0] == east
    assert at_border.sum() > 10
    assert (whole.uses[at_border] == 2).all()
    in_void = (np.abs(whole.middles - [WEST + 85, SOUTH + 50]) < [20, 30]).all(axis=1)
    assert (whole.uses[in_void] == 1).any()


SURVEYS = {
    "slanted": lambda x, y: y - SOUTH > 20.3 + 0.45 * (x - WEST),
    "shallow": lambda x, y: y - SOUTH > 98.4 + 0.02 * (x - WEST),
    "curved": lambda x, y: np.hypot(x - WEST - 90, y - SOUTH - 80) < 75,
    "along the border": lambda x, y: x < WEST + 100,
}


@pytest.mark.parametrize("survey", SURVEYS)
def test_meshes_cut_to_survey_join_without_open_edges(survey):
    rng = np.random.default_rng(0)
    has_data = SURVEYS[survey]
    tiles = dict(surveyed(block(rng, 1.0, (100, 100), 0.3), has_data))
    tiles = {key: (grid, frame) for key, (grid, frame) in tiles.items()
             if has_data(*np.meshgrid(grid.eastings, grid.northings)).any()}  # fmt: skip
    parts = list(meshes(tiles, rng, Options(), lambda x, y: ~has_data(x, y)))
    assert not any(map(faults, parts))
    whole = union(parts)
    assert whole.uses.max() == 2
    for axis, at in enumerate((WEST + 100, SOUTH + 100)):
        assert overlap_of_open_edges(whole, axis, at) == 0
    x, y = np.meshgrid(np.arange(0.5, 200), np.arange(0.5, 200))
    assert whole.area == pytest.approx(has_data(WEST + x, SOUTH + y).sum(), abs=30)
    # All open edges lie within a cell of the limit, or on the rim of the block.
    open_edges = whole.middles[whole.uses == 1]
    around = [has_data(*(open_edges + shift).T) for shift in ([1, 0], [-1, 0], [0, 1], [0, -1])]
    at_rim = (np.abs(open_edges - [WEST + 100, SOUTH + 100]) > 99.9).any(axis=1)
    assert (at_rim | (np.ptp(np.stack(around).astype(int), axis=0) == 1)).all()


def test_mesh_of_covered_tile_is_the_same_beside_end_of_survey():
    rng = np.random.default_rng(0)
    tiles = block(rng, 1.0, (100, 100), 0.3)
    ended = dict(surveyed(tiles, SURVEYS["along the border"]))
    one, other = (
        next(meshes({(0, 0): block_[0, 0]}, np.random.default_rng(1), Options())) for block_ in (tiles, ended)
    )
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


@pytest.mark.slow
@settings(max_examples=30)
@given(seed=st.integers(0, 2**31), share=st.floats(0.02, 0.98), cell=st.sampled_from([0.2, 0.5, 1.0]))
def test_meshes_of_any_survey_meet(seed, share, cell):
    rng = np.random.default_rng(seed)
    n = round(12 / cell)
    known = rng.random((2 * n + 2, 2 * n + 2)) < share

    def has_data(x, y):
        return known[np.floor((y - SOUTH) / cell).astype(int), np.floor((x - WEST) / cell).astype(int)]

    known[n - 1 : n + 1] = True
    tiles = dict(surveyed(block(rng, cell, (n, n), 0.3), has_data))
    whole = union(meshes(tiles, rng, Options(road_m=0.7, terrain_m=5), lambda x, y: ~has_data(x, y)))
    assert whole.uses.max() <= 2
    for axis, at in enumerate((WEST + 12, SOUTH + 12)):
        assert overlap_of_open_edges(whole, axis, at) < 1e-6
