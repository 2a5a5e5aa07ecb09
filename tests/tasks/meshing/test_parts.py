import numpy as np

from flexroad.tasks.meshing.parts import part, texture_coordinates
from flexroad.tasks.types import Mesh

VERTICES = np.array([[0, 0, 1], [10, 0, 2], [10, 10, 3], [0, 10, 4], [5, 15, 5]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4]], np.int32)
MESH = Mesh("EPSG:25832", (295500.0, 5629250.0, 150.0), VERTICES, FACES, np.array([False, True, False]))


def test_part_has_the_same_triangles_and_only_their_vertices():
    used, corners = part(MESH, MESH.road)
    np.testing.assert_array_equal(used, [0, 2, 3])
    np.testing.assert_array_equal(VERTICES[used][corners], VERTICES[FACES[MESH.road]])


def test_part_without_faces_is_empty():
    used, corners = part(MESH, np.zeros(3, bool))
    assert (used.shape, corners.shape) == ((0,), (0, 3))


def test_texture_coordinates_run_from_the_south_west():
    uv = texture_coordinates(MESH, (295495.0, 5629250.0, 295515.0, 5629290.0))
    np.testing.assert_allclose(uv, [[0.25, 0], [0.75, 0], [0.75, 0.25], [0.25, 0.25], [0.5, 0.375]])
