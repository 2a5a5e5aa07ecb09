"""Pinned output of each fit for one small tile; a changed number needs a higher VERSION of that method."""

import numpy as np
import pytest

from flexroad.tasks.fit import nurbs, plane, raster
from tests.builders import make_clusters, make_grid, make_tile

GRID = make_grid(48, 40)
GOLDEN = {
    "nurbs": (
        nurbs,
        1,
        {"control_points": (12, 10), "iterations": 60},
        [163.6535762, 0.5016401, 162.4962163, 163.7859205, 163.6318281, -0.0387811, 0.0690293, 0.9968606],
    ),
    "nurbs unit": (
        nurbs,
        1,
        {"control_points": (12, 10), "weights": "unit", "degree": 2},
        [163.6546653, 0.5031995, 162.5011738, 163.7909019, 163.6192187, -0.0391598, 0.0725505, 0.9965957],
    ),
    "nurbs without terrain": (
        nurbs,
        1,
        {"control_points": (12, 10), "terrain": False, "iterations": 60},
        [163.6130336, 0.4945207, 162.6279551, 163.7758172, 164.0003101, -0.0412321, 0.0596806, 0.9973656],
    ),
    "plane": (
        plane,
        1,
        {},
        [163.7568783, 0.4064233, 162.9153554, 163.9265386, 164.5984011, -0.0465388, 0.0198843, 0.9987186],
    ),
    "raster": (
        raster,
        1,
        {"terrain": "dtm"},
        [163.6825637, 0.50739, 162.5043978, 163.7913188, 163.6567454, -0.0807542, 0.1040818, 0.9912849],
    ),
}
"""Method, its VERSION, options, and expected result of `summary`, by name."""


def tile():
    """Return a bumpy slope with kerbs, cars and a hole; the noise is made of integers modulo a prime."""
    e, n = np.meshgrid(GRID.eastings - GRID.west, GRID.northings - GRID.south)
    rows, cols = np.indices(GRID.shape)
    noise = (rows * 7919 + cols * 104729 + rows * cols * 31) % 1009 / 1009 - 0.5
    dtm = 163 + 0.03 * e + np.sin(e / 9) * np.cos(n / 11) + 0.1 * noise
    road = np.abs(n - 20 - 4 * np.sin(e / 15)) < 5
    dsm = dtm + 0.05 * noise[::-1] + 1.4 * (road & (noise > 0.45)) + 6.0 * ~road
    dtm[5:9, 30:37] = np.nan
    return make_tile(dsm, dtm), make_clusters(road)


def summary(surface):
    """Return mean, spread and three heights on a lattice off the cells (m), and one normal."""
    heights = surface.lattice(GRID.eastings[9:38] + 0.3, GRID.northings[10:30] - 0.2)
    normal = surface.normal(GRID.west + 20.3, GRID.south + 19.1)
    return [heights.mean(), heights.std(), heights[0, 0], heights[11, 17], heights[-1, -1], *normal]


@pytest.mark.parametrize("name", GOLDEN)
def test_fit_output_is_pinned_to_version(name):
    method, version, options, expected = GOLDEN[name]
    data, clusters = tile()
    assert version == method.VERSION
    result = summary(method.fit(data, clusters, method.Options(**options)))
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-6)
