"""Distances of a mesh from its surface are those of places in the cells, by class."""

import math

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.metrics.evaluate import FIGURES, mesh_distances
from flexroad.tasks.spline.moving import moving
from flexroad.tasks.spline.space import clamped_space, surface_on
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Mesh, RoadMask

CORE = Grid("EPSG:25832", 295500.0, 5629520.0, 1.0, 20, 20)
WEST = np.arange(20) < 10
ROAD = np.tile(WEST, (20, 1))


class Above:
    """A surface above the mesh by the distances of its cells, ``(20, 20)``, m."""

    def __init__(self, distances):
        self.distances = distances

    def lattice(self, eastings, northings):
        row, col = CORE.cells(eastings[None, :], northings[:, None])
        return 160.0 + self.distances[row, col]


class Bowl:
    """A surface bent along the easting."""

    def lattice(self, eastings, northings):
        return np.broadcast_to(160 + 0.08 * (eastings - 295500.5) ** 2, (len(northings), len(eastings)))


def strip(x, z, mask=ROAD) -> tuple[Mesh, RoadMask]:
    """Return a mesh of strips from south to north with heights ``z`` at ``x``, and the road mask."""
    x = np.asarray(x, float)
    south, north = np.c_[x, np.zeros_like(x), z], np.c_[x, np.full_like(x, 20.0), z]
    a = np.arange(len(x) - 1)
    n = len(x)
    faces = np.concatenate([np.c_[a, a + 1, a + n + 1], np.c_[a, a + n + 1, a + n]]).astype(np.int32)
    vertices = np.concatenate([south, north])
    mesh = Mesh(CORE.crs, (295500, 5629500, 150.0), vertices, faces, np.zeros(len(faces), bool))
    return mesh, RoadMask(CORE, CORE, mask, np.zeros_like(mask))


def test_distances_are_percentile_and_maximum_of_each_class():
    distances = np.where(WEST, 0.02, -0.3) * np.ones((20, 1))
    distances[3, 4], distances[5, 15] = -0.5, 4.9
    mesh, road = strip([0, 20], [10.0, 10.0])
    expected = dict(zip(FIGURES, (0.02, 0.5, 0.3, 4.9), strict=True))
    assert mesh_distances(mesh, Above(distances), road) == pytest.approx(expected)


def test_mesh_with_vertices_at_centres_of_cells_has_the_distance_between_them():
    x = np.arange(20) + 0.5
    mesh, road = strip(x, 10 + 0.08 * np.arange(20) ** 2)
    expected = 0.08 * 0.25 * 0.75
    assert list(mesh_distances(mesh, Bowl(), road).values()) == pytest.approx(4 * [expected])


def test_places_without_mesh_do_not_count():
    distances = np.where(np.arange(20) < 12, 0.1, 7.0) * np.ones((20, 1))
    mesh, road = strip([0, 12], [10.0, 10.0])
    assert list(mesh_distances(mesh, Above(distances), road).values()) == pytest.approx(4 * [0.1])
    mesh, road = strip([0, 9], [10.0, 10.0])
    p95, largest = list(mesh_distances(mesh, Above(distances), road).values())[2:]
    assert math.isnan(p95)
    assert math.isnan(largest)


@pytest.fixture
def level():
    """Return a spline at 160 m."""
    space = clamped_space(CORE, 3, (6, 6))
    return surface_on(space, CORE, CORE.hull, np.zeros((6, 6)), np.ones((6, 6)), 160.0)


def test_steps_of_the_surface_count(level):
    steps, rim = np.zeros((20, 20), np.float32), np.zeros((2, 20), np.float32)
    steps[:, 14:16] = 0.75
    surface = SteppedSurface(**vars(level), steps=steps, cells=CORE, south_north=rim, west_east=rim)
    mesh, road = strip([0, 20], [10.0, 10.0])
    expected = dict(zip(FIGURES, (0, 0, 0.75, 0.75), strict=True))
    assert mesh_distances(mesh, surface, road) == pytest.approx(expected, abs=1e-9)


def test_surface_whose_plan_moves_has_no_distance(level):
    mesh, road = strip([0, 20], [10.0, 10.0])
    distances = mesh_distances(mesh, moving(level), road)
    assert list(distances) == list(FIGURES)
    assert all(math.isnan(distance) for distance in distances.values())
