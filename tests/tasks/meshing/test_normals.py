import numpy as np
import trimesh

from flexroad.tasks.meshing.normals import vertex_normals
from flexroad.tasks.meshing.triangulate import delaunay


def slope(points: np.ndarray) -> np.ndarray:
    """Return points, ``(V, 2)``, on a plane that rises by 0.3 to the east and by 0.4 to the north."""
    return np.column_stack([points, points @ [0.3, 0.4]])


def test_plane_has_its_own_normal_at_all_vertices():
    points = slope(np.random.default_rng(1).uniform(0, 10, (50, 2)))
    truth = np.array([-0.3, -0.4, 1.0]) / np.sqrt(1.25)
    np.testing.assert_allclose(vertex_normals(points, delaunay(points)), np.tile(truth, (50, 1)), atol=1e-12)


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
