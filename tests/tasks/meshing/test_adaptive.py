"""Adaptive meshes are within their tolerances of the surface, and have few faces."""

from dataclasses import replace

import numpy as np
import pytest

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.meshing import adaptive
from flexroad.tasks.meshing.adaptive import LINE_SHARE, thinned
from flexroad.tasks.metrics.mesh_check import faults
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.sample import Options
from tests.tasks.test_sample import Hills, assert_covers, diagonal_street, ground, sampled

CORE = ground(120, 90)
STREET = diagonal_street(CORE, 9.0)


def made(**options):
    return sampled(CORE, STREET, Options(method="adaptive", **options))


def distances(mesh, chosen):
    """Distances (m) of some of the faces from the surface, at places 0.1 m apart."""
    part = replace(mesh, faces=mesh.faces[chosen], road=mesh.road[chosen])
    fine = Grid(CORE.crs, CORE.west, CORE.north, 0.1, 10 * CORE.width, 10 * CORE.height)
    away = np.abs(drape(part, fine) + mesh.origin[2] - Hills().lattice(fine.eastings, fine.northings))
    return away[np.isfinite(away)]


@pytest.mark.parametrize("tolerance_m", [0.003, 0.005, 0.02])
def test_adaptive_mesh_is_within_tolerances_between_lattice_points(tolerance_m):
    mesh = made(tolerance_m=tolerance_m, terrain_tolerance_m=0.1)
    on_road = distances(mesh, mesh.road)
    assert on_road.size > 100_000
    # A mesh that is far more exact than it has to be has too many faces.
    assert tolerance_m / 2 < on_road.max() <= tolerance_m
    assert 0.05 < distances(mesh, ~mesh.road).max() <= 0.1


def test_adaptive_mesh_covers_domain_without_faults():
    mesh = made()
    assert not faults(mesh)
    assert_covers(mesh, CORE.hull)


def test_adaptive_road_faces_are_those_of_the_mask():
    """The centre of every cell lies in a face of its class; the outline is no more than a cell off."""
    mesh = made()
    part = replace(mesh, faces=mesh.faces[mesh.road], road=mesh.road[mesh.road])
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_array_equal(np.isfinite(drape(part, CORE))[inner], STREET[inner])


def test_adaptive_mesh_of_larger_tolerance_has_fewer_faces():
    numbers = [len(made(tolerance_m=t, terrain_tolerance_m=10 * t).faces) for t in (0.002, 0.005, 0.01, 0.05)]
    assert numbers == sorted(numbers, reverse=True)
    assert numbers[0] > 3 * numbers[-1]


def test_adaptive_mesh_needs_fewer_faces_than_dynamic_of_same_error():
    dynamic = sampled(CORE, STREET)
    limit = distances(dynamic, dynamic.road).max()
    mesh = made(tolerance_m=float(limit), terrain_tolerance_m=float(distances(dynamic, ~dynamic.road).max()))
    assert mesh.road.sum() < dynamic.road.sum() / 2
    assert len(mesh.faces) < len(dynamic.faces) / 2


def test_adaptive_sampling_of_equal_inputs_gives_equal_bytes():
    first, second = made(), made()
    for name in ("vertices", "faces", "road"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@pytest.mark.parametrize("is_road", [True, False])
def test_adaptive_mesh_of_one_class_has_one_class(is_road):
    mesh = sampled(CORE, np.full(CORE.shape, is_road), Options(method="adaptive"))
    assert (mesh.road == is_road).all()
    assert_covers(mesh, CORE.hull)


def test_adaptive_mesh_of_surface_with_hole_has_heights_around_it():
    """Heights are unknown within 20 m of a place: faces reach its edge, and no vertex has NaN."""
    hole = (CORE.west + 60.0, CORE.south + 50.0, 20.0)
    mesh = sampled(CORE, STREET, Options(method="adaptive"), Hills(hole))
    assert np.isfinite(mesh.vertices).all()
    away = np.hypot(*(mesh.vertices[:, :2] + mesh.origin[:2] - hole[:2]).T)
    assert 20 <= away.min() < 22


def test_thinned_line_is_within_share_of_tolerance():
    along = np.arange(0, 100.5, 0.5)
    heights, tolerances = np.sin(along / 9), np.where(along < 50, 0.005, 0.05)
    needed = np.zeros(len(along), bool)
    needed[[0, 77, -1]] = True
    kept = thinned(along, heights, tolerances, needed)
    error = np.abs(np.interp(along, along[kept], heights[kept]) - heights)
    assert (error <= LINE_SHARE * tolerances).all()
    assert kept[77]
    assert kept.sum() < 70


def test_adaptive_mesh_of_too_many_vertices_is_an_error(monkeypatch):
    monkeypatch.setattr(adaptive, "BITS", 6)
    with pytest.raises(TaskError, match="64 vertices or more; raise sample.tolerance_m"):
        made(tolerance_m=0.001)
