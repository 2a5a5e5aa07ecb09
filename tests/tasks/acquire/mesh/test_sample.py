"""Points and the view from above of made meshes, against what was made."""

import numpy as np
import pytest
from scipy.stats import chisquare

from flexroad.catalog.grid import Grid
from flexroad.tasks.acquire.mesh import sample as acquire
from flexroad.tasks.acquire.mesh.sample import (
    TexturedMesh,
    covered_cells,
    orthophoto,
    sample,
    surface_heights,
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
    """Rectangles of one colour each: pairs of a rectangle and its colour."""
    vertices, faces, colours, count = [], [], [], 0
    for (points, triangles), colour in rectangles:
        vertices.append(points)
        faces.append(triangles + count)
        colours.append(np.broadcast_to(np.array(colour, np.uint8), (len(triangles), 3, 3)))
        count += len(points)
    faces = np.concatenate(faces).astype(np.int32)
    none = np.full(len(faces), -1, np.int32)
    return TexturedMesh(CRS, np.concatenate(vertices), faces, none, colours=np.concatenate(colours))


def textured(rectangle, *textures, which=(0, 0)):
    """A rectangle with a texture over all of it."""
    points, faces = rectangle
    uv = (points[:, :2] - points[0, :2]) / (points[2, :2] - points[0, :2])
    return TexturedMesh(
        CRS, points, faces.astype(np.int32), np.array(which, np.int32), textures, uv[faces].astype(np.float32)
    )


def grid(width, height, cell=1.0, west=0.0, south=0.0):
    return Grid(CRS, EAST + west, NORTH + south + height * cell, cell, width, height)


@pytest.fixture
def texture():
    """No two quarters, rows or columns alike: a photo that is turned or mirrored shows."""
    return np.random.default_rng(1).integers(0, 256, (12, 16, 3), dtype=np.uint8)


def test_the_photo_shows_each_texel_in_its_place(texture):
    photo = orthophoto(textured(rectangle(0, 0, 16, 12, 100), texture), grid(16, 12))
    assert photo.known.all()
    assert np.abs(np.moveaxis(photo.colour, 0, -1).astype(int) - texture).max() <= 1


def test_beyond_the_mesh_nothing_is_known(texture):
    photo = orthophoto(textured(rectangle(0, 0, 16, 12, 100), texture), grid(20, 20, west=-2, south=-4))
    known = np.zeros((20, 20), bool)
    known[4:16, 2:18] = True
    assert np.array_equal(photo.known, known)
    assert not photo.colour[:, ~known].any()


def test_a_finer_texture_is_averaged_over_the_pixel(texture):
    photo = orthophoto(textured(rectangle(0, 0, 16, 12, 100), texture), grid(8, 6, cell=2))
    mean = texture.reshape(6, 2, 8, 2, 3).mean(axis=(1, 3))
    assert np.abs(np.moveaxis(photo.colour, 0, -1) - mean).max() <= 1


def test_bands_make_no_seams(texture, monkeypatch):
    made = textured(rectangle(0, 0, 16, 12, 100), texture)
    whole = orthophoto(made, grid(40, 30, cell=0.4))
    monkeypatch.setattr(acquire, "CHUNK", 100)
    assert np.array_equal(whole.colour, orthophoto(made, grid(40, 30, cell=0.4)).colour)


def test_each_face_has_its_own_texture():
    red, blue = (np.broadcast_to(np.array(c, np.uint8), (5, 7, 3)) for c in (RED, BLUE))
    photo = orthophoto(textured(rectangle(0, 0, 8, 8, 0), red, blue, which=(1, 0)), grid(8, 8))
    # The first triangle lies south-east of the diagonal.
    assert tuple(photo.colour[:, 7, 7]) == BLUE
    assert tuple(photo.colour[:, 0, 0]) == RED


def test_the_higher_surface_hides_the_lower_whatever_comes_first():
    ground, bridge = (rectangle(0, 0, 20, 20, 100), RED), (rectangle(8, 0, 12, 20, 106), BLUE)
    for made in (plain(ground, bridge), plain(bridge, ground)):
        photo, heights = orthophoto(made, grid(20, 20)), surface_heights(made, grid(20, 20))
        over = np.zeros((20, 20), bool)
        over[:, 8:12] = True
        assert (heights == np.where(over, 106, 100)).all()
        assert (photo.colour[:, over].T == BLUE).all()
        assert (photo.colour[:, ~over].T == RED).all()


def test_tops_are_those_of_the_plane():
    def slope(x, y):
        return 100 + 0.25 * x - 0.125 * y

    where = grid(30, 20, cell=0.5)
    heights = surface_heights(plain((rectangle(0, 0, 15, 10, slope), RED)), where)
    truth = slope(where.eastings[None] - EAST, where.northings[:, None] - NORTH)
    np.testing.assert_allclose(heights, truth, atol=1e-8)


def test_every_centre_is_hit_though_triangles_meet_under_it():
    """A fan of slivers whose edges run through many centres."""
    angles = np.linspace(0, 2 * np.pi, 721)[:-1]
    rim = np.column_stack([EAST + 10.5 + 15 * np.cos(angles), NORTH + 10.5 + 15 * np.sin(angles)])
    vertices = np.column_stack([np.vstack([[EAST + 10.5, NORTH + 10.5], rim]), np.full(721, 5.0)])
    around = np.arange(720)
    faces = np.column_stack([np.zeros(720, int), around + 1, (around + 1) % 720 + 1]).astype(np.int32)
    made = TexturedMesh(CRS, vertices, faces, np.full(720, -1, np.int32))
    assert covered_cells(made, grid(21, 21, cell=1)).all()


def test_inside_out_and_not_manifold_change_nothing_from_above(texture):
    made = textured(rectangle(0, 0, 16, 12, 100), texture)
    turned = TexturedMesh(
        CRS, made.vertices, made.faces[:, ::-1].copy(), made.texture, made.textures, made.uv[:, ::-1]
    )
    twice = TexturedMesh(
        CRS,
        made.vertices,
        np.tile(made.faces, (3, 1)),
        np.tile(made.texture, 3),
        made.textures,
        np.tile(made.uv, (3, 1, 1)),
    )
    here = orthophoto(made, grid(16, 12))
    for other in (turned, twice):
        assert np.array_equal(orthophoto(other, grid(16, 12)).colour, here.colour)
        assert np.array_equal(surface_heights(other, grid(16, 12)), surface_heights(made, grid(16, 12)))


def test_cover_is_what_lies_below_or_above_a_face():
    made = plain((rectangle(2, 3, 6.4, 8, 0), RED), (rectangle(5, 0, 9.6, 4, 50), RED))
    truth = np.zeros((10, 10), bool)
    truth[2:7, 2:6] = truth[6:10, 5:10] = True
    assert np.array_equal(covered_cells(made, grid(10, 10)), truth)


@pytest.mark.parametrize("seed", range(3))
def test_points_lie_evenly_on_the_surface(seed):
    """Also on a wall and over triangles of quite different sizes; the shares are those of the area."""
    wall = np.array([(EAST, NORTH, 0), (EAST, NORTH + 20, 0), (EAST, NORTH + 20, 10), (EAST, NORTH, 10)])
    made = plain((rectangle(0, 0, 30, 20, 0), RED), ((wall, np.array([[0, 1, 2], [0, 2, 3]])), BLUE))
    points = acquire_all(made, 5, seed)
    assert len(points) == 5 * 800
    on_wall = points.height > 0
    assert on_wall.sum() == pytest.approx(1000, abs=2)
    east, north = points.easting[~on_wall] - EAST, points.northing[~on_wall] - NORTH
    counts = np.histogram2d(east, north, bins=(6, 4), range=((0, 30), (0, 20)))[0].ravel()
    assert chisquare(counts).pvalue > 1e-3
    # Within one triangle, too: by its barycentric quarters, which are of one area.
    below = north < east * 2 / 3
    u, v = 1 - east[below] / 30, north[below] / 20
    quarter = np.select([u > 0.5, v > 0.5, u + v < 0.5], [0, 1, 2], 3)
    assert chisquare(np.bincount(quarter, minlength=4)).pvalue > 1e-3


def acquire_all(made, density, seed):
    (points,) = sample(made, density, seed)
    return points


def test_points_have_the_colour_and_height_under_them(texture):
    made = textured(
        rectangle(0, 0, 16, 12, lambda x, y: 50 + x + 2 * y), np.repeat(np.repeat(texture, 8, 0), 8, 1)
    )
    points = acquire_all(made, 20, 0)
    x, y = points.easting - EAST, points.northing - NORTH
    np.testing.assert_allclose(points.height, 50 + x + 2 * y, atol=1e-8)
    # Away from the texels' edges nothing is mixed.
    inside = (abs(x % 1 - 0.5) < 0.4) & (abs(y % 1 - 0.5) < 0.4)
    truth = texture[11 - y[inside].astype(int), x[inside].astype(int)]
    assert np.abs(points.colour[inside].astype(int) - truth).max() <= 1


def test_points_do_not_depend_on_the_chunks(monkeypatch, texture):
    made = textured(rectangle(0, 0, 16, 12, 100), texture)
    whole = acquire_all(made, 10, 7)
    monkeypatch.setattr(acquire, "CHUNK", 128)
    parts = list(sample(made, 10, 7))
    assert len(parts) == 15
    for name in ("easting", "northing", "height", "colour"):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))


def test_another_seed_is_another_set_of_points(texture):
    made = textured(rectangle(0, 0, 16, 12, 100), texture)
    assert not np.array_equal(acquire_all(made, 10, 0).easting, acquire_all(made, 10, 1).easting)


def test_without_colours_points_have_none():
    points, faces = rectangle(0, 0, 3, 3, 0)
    bare = TexturedMesh(CRS, points, faces.astype(np.int32), np.full(2, -1, np.int32))
    assert acquire_all(bare, 10, 0).colour is None
