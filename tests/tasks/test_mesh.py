"""Parts of meshes by class and level, and normals at their vertices."""

from dataclasses import replace

import numpy as np
import trimesh

from flexroad.tasks.meshing.normals import vertex_normals
from flexroad.tasks.meshing.triangulate import delaunay
from flexroad.tasks.sample import with_levels
from flexroad.tasks.types import Mesh

VERTICES = np.array([[0, 0, 1], [10, 0, 2], [10, 10, 3], [0, 10, 4], [5, 15, 5]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4]], np.int32)
MESH = Mesh("EPSG:25832", (295500.0, 5629250.0, 150.0), VERTICES, FACES, np.array([False, True, False]))


def test_part_has_the_same_triangles_and_only_their_vertices():
    used, corners = MESH.part(MESH.road)
    np.testing.assert_array_equal(used, [0, 2, 3])
    np.testing.assert_array_equal(VERTICES[used][corners], VERTICES[FACES[MESH.road]])
    used, corners = MESH.part(np.zeros(3, bool))
    assert (used.shape, corners.shape) == ((0,), (0, 3))


def test_texture_coordinates_run_from_the_south_west():
    uv = MESH.texture_coordinates((295495.0, 5629250.0, 295515.0, 5629290.0))
    np.testing.assert_allclose(uv, [[0.25, 0], [0.75, 0], [0.75, 0.25], [0.25, 0.25], [0.5, 0.375]])


def test_meshes_of_levels_as_one_can_be_taken_apart():
    deck = replace(MESH, origin=(295500.0, 5629250.0, 148.0), faces=FACES[:2], road=np.ones(2, bool))
    every = with_levels({0: MESH, -1: MESH, 2: deck})
    assert every.numbers == (0, -1, 2)
    assert every.level.tolist() == [0, 0, 0, -1, -1, -1, 2, 2]
    for number, mesh in ((0, MESH), (-1, MESH), (2, deck)):
        own = every.at(number)
        np.testing.assert_array_equal(
            own.vertices[own.faces] + own.origin, mesh.vertices[mesh.faces] + mesh.origin
        )
        np.testing.assert_array_equal(own.road, mesh.road)
    # A mesh without levels is level 0.
    assert with_levels({0: MESH}) is MESH
    assert MESH.numbers == (0,)
    assert MESH.at(0) is MESH


def test_normals_equal_those_of_trimesh():
    rng = np.random.default_rng(2)
    points = rng.uniform(0, 10, (300, 3))
    faces = delaunay(points)
    truth = trimesh.Trimesh(points, faces, process=False).vertex_normals
    np.testing.assert_allclose(vertex_normals(points, faces), truth, atol=1e-9)


def test_vertex_of_lines_only_looks_up():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]])
    normals = vertex_normals(points, np.array([[0, 1, 2]], np.int32))
    np.testing.assert_array_equal(normals, np.tile([0.0, 0.0, 1.0], (4, 1)))
