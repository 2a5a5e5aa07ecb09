"""Points and orthophotos of synthetic meshes have the true positions, heights and colours."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chisquare

from flexroad.catalog.grid import Grid
from flexroad.tools.prepare.mesh import sample as sample_module
from flexroad.tools.prepare.mesh.sample import (
    TexturedMesh,
    orthophoto,
    project_down,
    sample,
)

CRS = "EPSG:25832"
EAST, NORTH = 552_208.0, 4_114_742.0
RED, BLUE = (200, 30, 20), (10, 40, 210)


def rectangle(west, south, east, north, height):
    """Two triangles; height is one number or a function of easting and northing."""
    corners = [(west, south), (east, south), (east, north), (west, north)]
    z = height if callable(height) else lambda *_: height
    return np.array([(EAST + x, NORTH + y, z(x, y)) for x, y in corners]), np.array([[0, 1, 2], [0, 2, 3]])


def plain(*rectangles):
    """Mesh of rectangles of one colour each, given as pairs of rectangle and colour."""
    vertices, faces, colours, count = [], [], [], 0
    for (points, triangles), colour in rectangles:
        vertices.append(points)
        faces.append(triangles + count)
        colours.append(np.broadcast_to(np.array(colour, np.uint8), (len(triangles), 3, 3)))
        count += len(points)
    faces = np.concatenate(faces).astype(np.int32)
    none = np.full(len(faces), -1, np.int32)
    return TexturedMesh(CRS, np.concatenate(vertices), faces, none, colours=np.concatenate(colours))


def textured(rectangle, *textures, index=(0, 0)):
    """Mesh of a rectangle covered by textures; ``index`` is the texture of each triangle."""
    points, faces = rectangle
    uv = (points[:, :2] - points[0, :2]) / (points[2, :2] - points[0, :2])
    return TexturedMesh(
        CRS, points, faces.astype(np.int32), np.array(index, np.int32), textures, uv[faces].astype(np.float32)
    )


def grid(width, height, cell=1.0, west=0.0, south=0.0):
    return Grid(CRS, EAST + west, NORTH + south + height * cell, cell, width, height)


@pytest.fixture
def texture():
    """A random texture, so that a rotated or mirrored orthophoto is detected."""
    return np.random.default_rng(1).integers(0, 256, (12, 16, 3), dtype=np.uint8)


def test_orthophoto_has_each_texel_at_its_position_and_means_of_finer_textures(texture):
    mesh = textured(rectangle(0, 0, 16, 12, 100), texture)
    photo = orthophoto(mesh, grid(16, 12))
    assert photo.known.all()
    assert np.abs(np.moveaxis(photo.colour, 0, -1).astype(int) - texture).max() <= 1
    mean = texture.reshape(6, 2, 8, 2, 3).mean(axis=(1, 3))
    coarse = orthophoto(mesh, grid(8, 6, cell=2)).colour
    assert np.abs(np.moveaxis(coarse, 0, -1) - mean).max() <= 1


def test_orthophoto_outside_the_mesh_is_masked(texture):
    photo = orthophoto(textured(rectangle(0, 0, 16, 12, 100), texture), grid(20, 20, west=-2, south=-4))
    valid = np.zeros((20, 20), bool)
    valid[4:16, 2:18] = True
    assert np.array_equal(photo.known, valid)
    assert not photo.colour[:, ~valid].any()


def test_orthophoto_in_many_bands_is_the_same(texture, monkeypatch):
    mesh = textured(rectangle(0, 0, 16, 12, 100), texture)
    whole = orthophoto(mesh, grid(40, 30, cell=0.4))
    monkeypatch.setattr(sample_module, "CHUNK", 100)
    assert np.array_equal(whole.colour, orthophoto(mesh, grid(40, 30, cell=0.4)).colour)


def test_orthophoto_uses_texture_of_each_face():
    red, blue = (np.broadcast_to(np.array(c, np.uint8), (5, 7, 3)) for c in (RED, BLUE))
    photo = orthophoto(textured(rectangle(0, 0, 8, 8, 0), red, blue, index=(1, 0)), grid(8, 8))
    # The first triangle is south-east of the diagonal.
    assert tuple(photo.colour[:, 7, 7]) == BLUE
    assert tuple(photo.colour[:, 0, 0]) == RED


def test_orthophoto_higher_surface_hides_lower_in_any_order():
    ground, bridge = (rectangle(0, 0, 20, 20, 100), RED), (rectangle(8, 0, 12, 20, 106), BLUE)
    for mesh in (plain(ground, bridge), plain(bridge, ground)):
        photo, heights = orthophoto(mesh, grid(20, 20)), project_down(mesh, grid(20, 20))[0]
        on_bridge = np.zeros((20, 20), bool)
        on_bridge[:, 8:12] = True
        assert (heights == np.where(on_bridge, 106, 100)).all()
        assert (photo.colour[:, on_bridge].T == BLUE).all()
        assert (photo.colour[:, ~on_bridge].T == RED).all()


def test_surface_heights_of_a_plane_are_exact():
    def slope(x, y):
        return 100 + 0.25 * x - 0.125 * y

    where = grid(30, 20, cell=0.5)
    heights = project_down(plain((rectangle(0, 0, 15, 10, slope), RED)), where)[0]
    truth = slope(where.eastings[None] - EAST, where.northings[:, None] - NORTH)
    np.testing.assert_allclose(heights, truth, atol=1e-8)


def test_covered_cells_are_those_with_centre_in_a_face_without_gaps_at_edges():
    """Two rectangles; a fan of thin triangles whose edges cross many cell centres."""
    mesh = plain((rectangle(2, 3, 6.4, 8, 0), RED), (rectangle(5, 0, 9.6, 4, 50), RED))
    truth = np.zeros((10, 10), bool)
    truth[2:7, 2:6] = truth[6:10, 5:10] = True
    assert np.array_equal(project_down(mesh, grid(10, 10))[1] >= 0, truth)
    angles = np.linspace(0, 2 * np.pi, 721)[:-1]
    rim = np.column_stack([EAST + 10.5 + 15 * np.cos(angles), NORTH + 10.5 + 15 * np.sin(angles)])
    vertices = np.column_stack([np.vstack([[EAST + 10.5, NORTH + 10.5], rim]), np.full(721, 5.0)])
    around = np.arange(720)
    faces = np.column_stack([np.zeros(720, int), around + 1, (around + 1) % 720 + 1]).astype(np.int32)
    fan = TexturedMesh(CRS, vertices, faces, np.full(720, -1, np.int32))
    assert (project_down(fan, grid(21, 21, cell=1))[1] >= 0).all()
    assert all_points(fan, 10, 0).colour is None


def test_orthophoto_of_inside_out_or_non_manifold_mesh_is_the_same(texture):
    mesh = textured(rectangle(0, 0, 16, 12, 100), texture)
    reversed_ = replace(mesh, faces=mesh.faces[:, ::-1].copy(), uv=mesh.uv[:, ::-1])
    three_times = {name: np.concatenate([getattr(mesh, name)] * 3) for name in ("faces", "texture", "uv")}
    expected = orthophoto(mesh, grid(16, 12))
    for other in (reversed_, replace(mesh, **three_times)):
        assert np.array_equal(orthophoto(other, grid(16, 12)).colour, expected.colour)
        assert np.array_equal(project_down(other, grid(16, 12))[0], project_down(mesh, grid(16, 12))[0])


@pytest.mark.parametrize("seed", range(3))
def test_sample_points_are_uniform_on_the_surface(seed):
    """On a wall and on triangles of different sizes, numbers of points are proportional to the area."""
    wall = np.array([(EAST, NORTH, 0), (EAST, NORTH + 20, 0), (EAST, NORTH + 20, 10), (EAST, NORTH, 10)])
    mesh = plain((rectangle(0, 0, 30, 20, 0), RED), ((wall, np.array([[0, 1, 2], [0, 2, 3]])), BLUE))
    points = all_points(mesh, 5, seed)
    assert len(points) == 5 * 800
    on_wall = points.height > 0
    assert on_wall.sum() == pytest.approx(1000, abs=2)
    east, north = points.easting[~on_wall] - EAST, points.northing[~on_wall] - NORTH
    counts = np.histogram2d(east, north, bins=(6, 4), range=((0, 30), (0, 20)))[0].ravel()
    assert chisquare(counts).pvalue > 1e-3
    # Also uniform within a triangle: its four barycentric quarters have equal areas.
    below = north < east * 2 / 3
    u, v = 1 - east[below] / 30, north[below] / 20
    quarter = np.select([u > 0.5, v > 0.5, u + v < 0.5], [0, 1, 2], 3)
    assert chisquare(np.bincount(quarter, minlength=4)).pvalue > 1e-3


def all_points(mesh, density, seed):
    (points,) = sample(mesh, density, seed)
    return points


def test_sample_points_have_colour_and_height_of_the_surface(texture):
    mesh = textured(
        rectangle(0, 0, 16, 12, lambda x, y: 50 + x + 2 * y), np.repeat(np.repeat(texture, 8, 0), 8, 1)
    )
    points = all_points(mesh, 20, 0)
    x, y = points.easting - EAST, points.northing - NORTH
    np.testing.assert_allclose(points.height, 50 + x + 2 * y, atol=1e-8)
    # Away from the edges of texels, colours are not interpolated.
    inside = (abs(x % 1 - 0.5) < 0.4) & (abs(y % 1 - 0.5) < 0.4)
    truth = texture[11 - y[inside].astype(int), x[inside].astype(int)]
    assert np.abs(points.colour[inside].astype(int) - truth).max() <= 1


def test_sample_in_many_chunks_gives_the_same_points_and_another_seed_others(monkeypatch, texture):
    mesh = textured(rectangle(0, 0, 16, 12, 100), texture)
    whole = all_points(mesh, 10, 7)
    assert not np.array_equal(whole.easting, all_points(mesh, 10, 1).easting)
    monkeypatch.setattr(sample_module, "CHUNK", 128)
    parts = list(sample(mesh, 10, 7))
    assert len(parts) == 15
    for name in ("easting", "northing", "height", "colour"):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))
