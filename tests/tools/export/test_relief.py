"""Reliefs cover the meshes that they stand for; their error is the largest vertical distance from them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from matplotlib.tri import LinearTriInterpolator, Triangulation

from flexroad.catalog.grid import Grid
from flexroad.tasks.meshing.triangulate import delaunay
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.products import glb
from flexroad.tools.export.relief import Relief, Sheet, encode_sheet, highest_first, joined, of_mesh, sheet
from tests import crossing
from tests.tasks.products.test_glb import attribute, gltf_json

WEST, SOUTH = 500_000.0, 5_600_000.0


def hills(seed, size=100.0, east=0.0, north=0.0, hole=None):
    """A mesh of 800 points with steep hills, without faces that have their middle in a circle (x, y, r)."""
    rng = np.random.default_rng(seed)
    edge = np.linspace(0, size, 11)
    border = [(x, y) for x in edge for y in (0, size)] + [(x, y) for x in (0, size) for y in edge[1:-1]]
    plan = np.add(np.concatenate([border, rng.uniform(0, size, (760, 2))]), (east, north))
    x, y = plan.T
    height = 200 + 6 * np.sin(x / 13) * np.cos(y / 9) + rng.normal(0, 0.1, len(plan))
    points = np.column_stack([np.add(plan, (WEST, SOUTH)), height])
    faces = delaunay(np.column_stack([plan, height]))
    if hole:
        away = np.linalg.norm(points[faces, :2].mean(axis=1) - (WEST + hole[0], SOUTH + hole[1]), axis=1)
        faces = faces[away > hole[2]]
    return points, faces


def samples(points, faces, number=20_000):
    """Random places on faces, all vertices among them."""
    rng = np.random.default_rng(0)
    face = rng.integers(0, len(faces), number)
    weights = rng.dirichlet([0.4] * 3, number)
    return np.concatenate([points[np.unique(faces)], (points[faces[face]] * weights[:, :, None]).sum(axis=1)])


def height_at(relief, places):
    """The heights of the relief's triangles, by matplotlib; NaN where there is no triangle."""
    x, y, z = relief.places.T
    triangles = Triangulation(x - WEST, y - SOUTH, relief.faces)
    return LinearTriInterpolator(triangles, z)(places[:, 0] - WEST, places[:, 1] - SOUTH).filled(np.nan)


@pytest.mark.parametrize("hole", [None, (30.0, 60.0, 18.0), (0.0, 0.0, 50.0)])
def test_of_mesh_error_is_the_largest_vertical_distance(hole):
    points, faces = hills(1, hole=hole)
    relief = of_mesh(points, faces, 7.0)
    places = samples(points, faces)
    distance = np.abs(height_at(relief, places) - places[:, 2])
    # Places on the outer edge may be beside it by rounding.
    assert np.isfinite(distance).mean() > 0.99
    assert np.nanmax(distance) <= relief.error_m + 1e-6
    assert np.nanmax(distance) > 0.9 * relief.error_m


def test_of_mesh_of_a_plane_is_the_plane():
    points, faces = hills(2)
    points[:, 2] = 0.1 * (points[:, 0] - WEST) - 0.2 * (points[:, 1] - SOUTH) + 50
    relief = of_mesh(points, faces, 9.0)
    assert relief.error_m < 1e-9
    assert relief.cells.all()
    x, y, z = relief.places.T
    np.testing.assert_allclose(z, 0.1 * (x - WEST) - 0.2 * (y - SOUTH) + 50, atol=1e-6)
    assert relief.bounds == (WEST, SOUTH, WEST + 100, SOUTH + 100)
    assert relief.heights.shape == (13, 13)


def test_relief_has_no_cells_beyond_the_mesh():
    points, faces = hills(3, hole=(0.0, 0.0, 50.0))
    relief = of_mesh(points, faces, 5.0)
    x, y = np.meshgrid(np.arange(20) * 5 + 2.5, 100 - (np.arange(20) * 5 + 2.5))
    away = np.hypot(x, y)
    # Faces at the hole reach up to some metres into it.
    assert not relief.cells[away < 35].any()
    assert relief.cells[away > 55].all()


def test_joined_error_is_no_less_than_the_distance_from_the_first_meshes():
    meshes = [hills(n, east=100.0 * (n % 2), north=100.0 * (n // 2)) for n in range(4)]
    parts = [of_mesh(*mesh, 4.0) for mesh in meshes]
    once = joined(parts, 16.0)
    twice = joined([once], 64.0)
    assert once.heights.shape == (14, 14)
    assert twice.heights.shape == (5, 5)
    for relief in (once, twice):
        assert relief.bounds == (WEST, SOUTH, WEST + 200, SOUTH + 200)
        assert relief.cells.all()
        worst = 0.0
        for mesh in meshes:
            places = samples(*mesh)
            worst = max(worst, np.nanmax(np.abs(height_at(relief, places) - places[:, 2])))
        assert 0.5 * relief.error_m < worst <= relief.error_m + 1e-6


def test_joined_step_between_parts_is_part_of_the_error_and_what_no_part_has_is_left_out():
    lower, upper = hills(0), hills(0, east=100.0)
    upper[0][:, 2] = lower[0][:, 2] + 30
    assert joined([of_mesh(*lower, 4.0), of_mesh(*upper, 4.0)], 20.0).error_m > 25
    relief = joined([of_mesh(*hills(n, east=100.0 * n, north=100.0 * n), 4.0) for n in range(2)], 12.5)
    expected = np.zeros((16, 16), bool)
    expected[8:, :8] = expected[:8, 8:] = True
    np.testing.assert_array_equal(relief.cells, expected)


def test_joined_part_between_nodes_is_covered():
    """A part that no node of the lattice is on."""
    parts = [of_mesh(*hills(0), 4.0), of_mesh(*hills(1, size=6.0, east=130.0, north=40.0), 2.0)]
    relief = joined(parts, 64.0)
    places = samples(*hills(1, size=6.0, east=130.0, north=40.0))
    distance = np.abs(height_at(relief, places) - places[:, 2])
    assert np.isfinite(distance).mean() > 0.99
    assert np.nanmax(distance) <= relief.error_m + 1e-6


def test_sheet_skirt_hangs_from_the_whole_rim_and_looks_outward():
    heights = np.add.outer(np.arange(5.0), np.arange(6.0)) / 10
    cells = np.ones((4, 5), bool)
    cells[1, 2] = cells[0, 4] = False
    relief = Relief((0.0, 0.0, 50.0, 40.0), heights, cells, 0.5)
    made = sheet(relief, 2.0)
    assert set(made.faces.ravel()) == set(range(len(made.points)))
    mesh = trimesh.Trimesh(made.points, made.faces, process=False)
    assert (mesh.face_normals[: made.count, 2] > 0).all()
    np.testing.assert_allclose(mesh.face_normals[made.count :, 2], 0, atol=1e-12)
    # Each edge of the relief has a second face; only the foot of the skirt is open.
    edges, number = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    top = len(np.unique(relief.faces))
    assert number.max() == 2
    assert (edges[number == 1] >= top).all()
    np.testing.assert_allclose(
        made.points[made.top[top:]] - made.points[top:], [[0, 0, 2.0]] * len(made.top[top:])
    )
    for face in made.faces[made.count :]:
        outward = np.cross(*(made.points[face[1:]] - made.points[face[0]]))[:2]
        x, y = made.points[face].mean(axis=0)[:2] - 0.5 * outward / np.linalg.norm(outward)
        assert cells[int((40 - y) // 10), int(x // 10)]


def coarse(jpeg: bytes, photo: bool = False) -> tuple[bytes, Sheet]:
    """Return the GLB of a slope of 3 x 2 cells of 10 m with a skirt of 4 m."""
    heights = np.add.outer(np.arange(3.0), 2 * np.arange(4.0))
    made = sheet(Relief((100.0, 200.0, 130.0, 220.0), heights, np.ones((2, 3), bool), 0.5), 4.0)
    local = made.points - (100, 200, 0)
    return encode_sheet(made, local, (100.0, 200.0, 130.0, 220.0), jpeg, photo), made


def test_encode_sheet_skirt_has_normals_and_colours_of_the_edge():
    data, made = coarse(glb.jpeg(np.full((8, 8, 3), 90, np.uint8), 85))
    position, normal, uv = (attribute(data, "ground", name) for name in ("POSITION", "NORMAL", "TEXCOORD_0"))
    np.testing.assert_allclose(
        np.column_stack([position[:, 0], -position[:, 2]]), made.points[:, :2] - (100, 200)
    )
    np.testing.assert_allclose(normal, normal[made.top])
    np.testing.assert_allclose(uv, uv[made.top])
    # Per cell of 10 m, heights rise by 2 m to the east and by 1 m to the south.
    slope = np.array([-0.2, 1.0, -0.1])
    np.testing.assert_allclose(normal, np.tile(slope / np.linalg.norm(slope), (len(normal), 1)), atol=1e-6)
    np.testing.assert_allclose(uv, np.column_stack([position[:, 0] / 30, 1 + position[:, 2] / 20]), atol=1e-6)


@pytest.mark.parametrize("photo", [False, True])
def test_encode_sheet_is_unlit_if_it_has_photos(photo):
    tree = gltf_json(coarse(b"", photo)[0])
    assert tree.get("extensionsUsed") == (["KHR_materials_unlit"] if photo else None)
    assert [material.get("extensions") for material in tree["materials"]] == [
        {"KHR_materials_unlit": {}} if photo else None
    ]


def test_height_over_faces_of_the_highest_level_is_that_of_the_deck():
    mesh, _ = crossing.Crossing((40.0, 30.0)).mesh()
    grid = Grid(mesh.crs, crossing.WEST + 35, crossing.SOUTH + 32, 1.0, 10, 4)
    top = drape(replace(mesh, faces=highest_first(mesh)), grid) + mesh.origin[2]
    np.testing.assert_allclose(
        top, crossing.DECK_M + crossing.RISE * np.tile(grid.eastings - crossing.WEST, (4, 1)), atol=2e-3
    )
    ground = mesh.at(0)
    assert highest_first(ground) is ground.faces
