"""Meshes of neighbouring tiles join without a gap."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog.grid import Grid
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.spline.frame import Corner, Edge, Frame
from flexroad.tasks.types import RoadClusters, RoadMask
from tests.mesh_union import Union
from tests.tasks.test_sample import Hills, areas

WEST, SOUTH = 295500.0, 5629250.0


def edge(rng, cells, share, inside=True):
    road = np.repeat(rng.random(cells // 5 + 1) < share, 5)[:cells]
    return Edge(np.zeros((3, 0)), road, road & (rng.random(cells) < 0.8), np.full(cells, inside))


def block(rng, cell, size, share, inside=True):
    """Two by two tiles with their frames: grid, frame by (column, row)."""
    corner = Corner(np.zeros((3, 3)))
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


def meshes(tiles, rng, options, outside=lambda east, north: False):
    for grid, frame in tiles.values():
        mask = np.kron(rng.random((20, 20)) < 0.3, np.ones((16, 16), bool))[: grid.height, : grid.width]
        beyond = np.broadcast_to(outside(*np.meshgrid(grid.eastings, grid.northings)), grid.shape)
        road = RoadMask(grid, grid, mask, beyond)
        yield sample(Hills(), road, RoadClusters(grid, mask.astype(np.int32)), options, frame)


def union(parts):
    return Union.of((mesh.vertices + np.array(mesh.origin), mesh.faces) for mesh in parts)


@settings(deadline=None, max_examples=30)
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


def test_border_beyond_survey_ends_mesh():
    rng = np.random.default_rng(0)
    tiles = block(rng, 1.0, (100, 100), 0.3, inside=False)
    first = {(0, 0): tiles[0, 0]}
    (mesh,) = meshes(first, rng, Options(), lambda easting, northing: easting > WEST + 60)
    assert mesh.vertices[:, 0].max() < 80
