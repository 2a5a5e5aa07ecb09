"""Heights of faces at nodes of a lattice that has other spacings from east to west and north to south."""

import numpy as np

from flexroad.tasks.metrics.mesh_distance import at_nodes


def test_at_nodes_heights_of_a_plane_and_nothing_beside_it():
    points = np.array([[10, 20, 0], [40, 20, 0], [40, 30, 0], [10, 30, 0]], float)
    points[:, 2] = 0.5 * points[:, 0] - 2 * points[:, 1]
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    heights = at_nodes(points, faces, (0.0, 20.0, 60.0, 40.0), (5, 7))
    x, y = np.meshgrid(np.linspace(0, 60, 7), np.linspace(40, 20, 5))
    inside = (x >= 10) & (x <= 40) & (y <= 30)
    np.testing.assert_allclose(heights[inside], (0.5 * x - 2 * y)[inside], atol=1e-4)
    assert np.isnan(heights[~inside]).all()
