import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import MeshFault
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.evaluate import FIGURES, Options, evaluate, mesh_distances
from flexroad.tasks.metrics.mesh_distance import at_nodes, drape, nearest
from flexroad.tasks.sample import Options as SampleOptions
from flexroad.tasks.sample import sample
from flexroad.tasks.spline.moving import moving
from flexroad.tasks.spline.space import clamped_space, surface_on
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.types import Mesh, Metrics, RoadMask, TileData
from tests.builders import make_grid, make_mask, make_tile
from tests.crossing import Crossing


def on_lattice(grid: Grid, height_at, bounds=None, step=1.0) -> Mesh:
    """Return a mesh of square quads, each cut in two, with heights ``height_at(easting, northing)``."""
    west, south, east, north = bounds or grid.hull
    x = np.linspace(west, east, max(round((east - west) / step), 1) + 1)
    y = np.linspace(south, north, max(round((north - south) / step), 1) + 1)
    east_at, north_at = np.meshgrid(x, y)
    i = np.arange(east_at.size).reshape(east_at.shape)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.c_[a, b, c], np.c_[a, c, d]]).astype(np.int32)
    origin = (*grid.origin, 150.0)
    vertices = np.c_[east_at.ravel(), north_at.ravel(), height_at(east_at, north_at).ravel()] - origin
    return Mesh(grid.crs, origin, vertices, faces, np.zeros(len(faces), bool))


def surface(height_at):
    """Return a surface with these heights at eastings and northings."""

    def lattice(eastings, northings):
        heights = height_at(eastings[None, :], northings[:, None])
        return np.broadcast_to(heights, (len(northings), len(eastings)))

    return SimpleNamespace(lattice=lattice)


LEVEL = surface(lambda x, y: 160.0)


def figures(mesh, grid, truth, is_road=None, options=None, **layers) -> Metrics:
    is_road = np.zeros(grid.shape, bool) if is_road is None else is_road
    data = make_tile(truth, grid=grid, **layers)
    return evaluate(mesh, data, make_mask(is_road), LEVEL, options or Options())


def centres(grid: Grid):
    return np.meshgrid(grid.eastings, grid.northings)


def western_half(grid: Grid):
    return centres(grid)[0] < grid.west + grid.width * grid.cell / 2


def tilt(slope_x, slope_y=0.0, height=160.0):
    return lambda x, y: height + slope_x * (x - 295500) + slope_y * (y - 5629470)


def random_surface(rng, n=60, size=20.0, relief=3.0):
    """Return vertices and faces of a random triangulated surface."""
    xy = rng.uniform(0, size, (n, 2))
    faces = Delaunay(xy).simplices.astype(np.int32)
    return np.c_[xy, rng.uniform(0, relief, n)], faces


# Distances


def test_evaluate_statistics_are_per_class():
    grid = make_grid(40, 30)
    errors = np.random.default_rng(0).normal(0.1, 0.5, grid.shape)
    is_road = western_half(grid)
    metrics = figures(on_lattice(grid, tilt(0.0)), grid, 160 - errors, is_road)
    road, terrain = errors[is_road], errors[~is_road]
    assert metrics.l2_road_m == pytest.approx(np.abs(road).mean())
    assert metrics.l2_terrain_m == pytest.approx(np.abs(terrain).mean())
    assert metrics.rmse_road_m == pytest.approx(math.sqrt((road**2).mean()))
    assert metrics.rmse_terrain_m == pytest.approx(math.sqrt((terrain**2).mean()))
    assert metrics.nmad_road_m == pytest.approx(1.4826 * np.median(np.abs(road - np.median(road))))
    assert metrics.p95_road_m == pytest.approx(np.percentile(np.abs(road), 95))
    assert (metrics.mad_road_deg, metrics.mad_terrain_deg) == pytest.approx((0, 0), abs=1e-6)
    assert (metrics.completeness, metrics.road_fraction) == (1.0, 0.5)
    assert math.isnan(metrics.nearest_road_m)
    assert math.isnan(metrics.nearest_terrain_m)


def test_evaluate_reference_layers_replace_dtm_and_mask():
    grid = make_grid(40, 30)
    layers = {"reference": np.full(grid.shape, 162.0), "reference_road": ~western_half(grid)}
    mesh, dtm = on_lattice(grid, tilt(0.0)), np.where(western_half(grid), 161.0, 165.0)
    without_layers = figures(mesh, grid, dtm, western_half(grid))
    assert (without_layers.l2_road_m, without_layers.l2_terrain_m) == pytest.approx((1, 5))
    layers["reference"][~western_half(grid)] = 163.0
    with_layers = figures(mesh, grid, dtm, western_half(grid), **layers)
    assert (with_layers.l2_road_m, with_layers.l2_terrain_m) == pytest.approx((3, 2))


def test_evaluate_classes_segmented_uses_raw_mask():
    grid = make_grid(40, 30)
    layers = {"reference": np.where(western_half(grid), 161.0, 165.0), "reference_road": ~western_half(grid)}
    segmented = western_half(grid)
    segmented[:, 10:] = False
    mesh = on_lattice(grid, lambda x, y: 160 + 0.01 * (x - 295500) ** 2)
    true = figures(mesh, grid, layers["reference"], segmented, **layers)
    by_mask = figures(mesh, grid, layers["reference"], segmented, Options(classes="segmented"), **layers)
    only_mask = figures(mesh, grid, layers["reference"], segmented, reference=layers["reference"])
    # Compared as text, because NaN does not equal NaN.
    assert str(by_mask) == str(only_mask)
    assert (true.road_fraction, by_mask.road_fraction) == (0.5, 0.25)
    assert true.mad_road_deg != by_mask.mad_road_deg


def test_evaluate_nan_reference_cells_are_ignored():
    grid = make_grid(40, 30)
    truth = np.full(grid.shape, 161.0)
    truth[:, :10] = np.nan
    metrics = figures(on_lattice(grid, tilt(0.0)), grid, truth, western_half(grid))
    assert metrics.l2_road_m == pytest.approx(1)
    assert metrics.completeness == 1
    assert metrics.road_fraction == pytest.approx(10 / 30)


def test_evaluate_hole_in_mesh_lowers_completeness():
    grid = make_grid(41, 31)
    mesh = on_lattice(grid, tilt(0.0))
    centroids = mesh.vertices[mesh.faces].mean(axis=1)
    used, faces = np.unique(
        mesh.faces[(np.abs(centroids[:, :2] - [20.5, 15.5]) > 5).any(axis=1)], return_inverse=True
    )
    holed = replace(mesh, vertices=mesh.vertices[used], faces=faces.reshape(-1, 3).astype(np.int32))
    metrics = figures(holed, grid, np.full(grid.shape, 160.5))
    # The hole is 10 m wide from centre to centre; the cells on its rim have heights.
    assert metrics.completeness == pytest.approx(1 - 81 / (41 * 31))
    assert metrics.l2_terrain_m == pytest.approx(0.5)


def test_evaluate_class_without_cells_is_nan():
    grid = make_grid(40, 30)
    metrics = figures(
        on_lattice(grid, tilt(0.0)), grid, np.full(grid.shape, 160.0), options=Options(nearest=True)
    )
    road = [value for name, value in vars(metrics).items() if "_road_" in name]
    assert len(road) == 8
    assert all(math.isnan(value) for value in road)
    assert (metrics.road_fraction, metrics.l2_terrain_m, metrics.mad_terrain_deg) == (0, 0, 0)


def test_evaluate_ignores_halo():
    core = make_grid(20, 20)
    grid = core.buffered(7)
    truth = np.full(grid.shape, 500.0)
    truth[grid.window(core)] = 161.0
    is_road = np.ones(grid.shape, bool)
    is_road[grid.window(core)] = western_half(core)
    mesh = on_lattice(core, tilt(0.0), bounds=core.bounds)
    inputs = TileData("t", grid, core, truth, truth), RoadMask(grid, core, is_road, np.zeros_like(is_road))
    metrics = evaluate(mesh, *inputs, LEVEL, Options(nearest=True))
    assert (metrics.l2_road_m, metrics.nearest_road_m) == pytest.approx((1, 1))
    assert (metrics.completeness, metrics.road_fraction) == (1, 0.5)


# Draping


@given(
    shape=st.tuples(st.integers(2, 30), st.integers(2, 30)),
    cell=st.sampled_from([1.0, 0.5, 0.3, 0.2, 1 / 3]),
    corner=st.tuples(st.floats(-1e3, 8e5), st.floats(0, 9e6)),
    step=st.sampled_from([0.2, 1.0, 1.7, 50.0]),
)
def test_drape_covered_hull_has_no_nan(shape, cell, corner, step):
    grid = make_grid(shape[1], shape[0], cell, *corner)
    plane = tilt(0.1, 0.2)
    mesh = on_lattice(grid, plane, step=step * cell)
    heights = drape(mesh, grid) + mesh.origin[2]
    np.testing.assert_allclose(heights, plane(*centres(grid)), rtol=0, atol=1e-5)


def _slow_drape(mesh: Mesh, grid: Grid):
    """Return heights from the first face on which no barycentric coordinate of the centre is negative."""
    out = np.full(grid.shape, np.nan)
    corners = mesh.vertices[mesh.faces]
    for r, c in np.ndindex(*grid.shape):
        point = np.array([grid.eastings[c], grid.northings[r]]) - mesh.origin[:2]
        for a, b, d in corners:
            weights = np.linalg.solve(np.vstack([np.c_[a, b, d][:2], np.ones(3)]), [*point, 1])
            if weights.min() >= 0:
                out[r, c] = weights @ [a[2], b[2], d[2]]
                break
    return out


@pytest.mark.parametrize("seed", range(3))
def test_drape_equals_barycentric_height(seed):
    vertices, faces = random_surface(np.random.default_rng(seed))
    if seed == 2:
        faces = np.ascontiguousarray(faces[:, ::-1])
    grid = make_grid(24, 22, west=-2.0, north=21.0)
    mesh = Mesh("EPSG:25832", (1.0, -2.0, 100.0), vertices, faces, np.zeros(len(faces), bool))
    heights, truth = drape(mesh, grid), _slow_drape(mesh, grid)
    assert 0.3 < np.isnan(truth).mean() < 0.7
    np.testing.assert_allclose(heights, truth, atol=1e-9)


# Smoothness


def _slow_angles(mesh: Mesh):
    """Evaluate the paper's formula with arccos, face by face."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    out = []
    for i, face in enumerate(mesh.faces):
        shared = [len(set(face) & set(other_face)) for other_face in mesh.faces]
        neighbours = [j for j, n in enumerate(shared) if n == 2]
        angles = [math.acos(min(1.0, abs(normals[i] @ normals[j]))) for j in neighbours]
        out.append(math.degrees(sum(angles) / len(angles)) if angles else math.nan)
    return np.array(out)


@pytest.mark.parametrize("seed", range(3))
def test_mean_angles_equal_paper_formula(seed):
    vertices, faces = random_surface(np.random.default_rng(seed), n=40)
    mesh = Mesh("EPSG:25832", (0.0, 0.0, 0.0), vertices, faces, np.zeros(len(faces), bool))
    np.testing.assert_allclose(mean_angles(mesh), _slow_angles(mesh), rtol=1e-7)


def test_mean_angles_almost_level_ground_is_accurate():
    grid = make_grid(40, 30)
    mesh = on_lattice(grid, lambda x, y: 160 + 1e-9 * (x - 295500) ** 2)
    bend = math.degrees(2e-9)
    inner = mean_angles(mesh)
    assert 0 < inner.max() < bend
    # Faces without neighbours have none.
    assert np.isnan(mean_angles(replace(mesh, faces=mesh.faces[[0, 200]]))).all()
    assert figures(mesh, grid, np.full(grid.shape, 160.0)).mad_terrain_deg == pytest.approx(bend / 3, rel=0.1)


def test_evaluate_faces_are_classed_by_centroid():
    grid = make_grid(40, 30)
    rng = np.random.default_rng(0)
    rough = np.where(western_half(grid), 0.0, rng.uniform(0, 1, grid.shape))[::-1]
    mesh = on_lattice(grid, lambda x, y: 160 + rough)
    west = centres(grid)[0] < 295515
    metrics = figures(mesh, grid, np.full(grid.shape, 160.0), west)
    assert metrics.mad_road_deg == pytest.approx(0, abs=1e-6)
    assert metrics.mad_terrain_deg > 10
    centroid_x = mesh.vertices[mesh.faces][:, :, 0].mean(axis=1)
    assert metrics.mad_terrain_deg == pytest.approx(mean_angles(mesh)[centroid_x >= 15].mean())


def test_evaluate_class_without_centroid_uses_all_faces():
    grid = make_grid(40, 40)
    bent = on_lattice(grid, lambda x, y: 160 + 0.1 * ((x > 295530) & (y > 5629490)), step=39)
    is_road = np.zeros(grid.shape, bool)
    is_road[0, 0] = True
    metrics = figures(bent, grid, np.full(grid.shape, 160.0), is_road)
    assert metrics.triangles == 2
    assert metrics.mad_road_deg == metrics.mad_terrain_deg > 0


# Distance in space


def _brute_force(vertices, faces, points):
    """Return the smallest of trimesh's point-to-triangle distances to all faces."""
    corners = vertices[faces]
    return np.array(
        [
            np.linalg.norm(
                trimesh.triangles.closest_point(corners, np.tile(point, (len(faces), 1))) - point, axis=1
            ).min()
            for point in points
        ]
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n", [3, 8, 400])
def test_nearest_equals_brute_force(seed, n):
    rng = np.random.default_rng(seed)
    vertices, faces = random_surface(rng, n, relief=30.0 if seed % 2 else 1.0)
    points = rng.uniform([-10, -10, -5], [30, 30, 35], (100, 3))
    truth = _brute_force(vertices, faces, points)
    distances = nearest(vertices, faces, points, np.full(len(points), np.inf))
    np.testing.assert_allclose(distances, truth, rtol=1e-9)
    np.testing.assert_allclose(nearest(vertices, faces, points, truth * 1.001), truth, rtol=1e-9)


def test_evaluate_nearest_is_mean_of_class():
    grid = make_grid(14, 12)
    rng = np.random.default_rng(0)
    mesh = on_lattice(grid, lambda x, y: 160 + rng.uniform(0, 2, x.shape))
    truth, is_road = 160 + rng.uniform(0, 5, grid.shape), western_half(grid)
    metrics = figures(mesh, grid, truth, is_road, Options(nearest=True))
    points = np.stack([*centres(grid), truth], axis=-1) - mesh.origin
    for found, cells in ((metrics.nearest_road_m, is_road), (metrics.nearest_terrain_m, ~is_road)):
        assert found == pytest.approx(_brute_force(mesh.vertices, mesh.faces, points[cells]).mean())
    assert metrics.nearest_road_m < metrics.l2_road_m


def test_figures_of_mesh_with_deck_are_those_of_the_ground_beside_it():
    tile = next(Crossing((40.0, 30.0)).tiles())
    grid, level = tile.road.core, tile.road.levels[0]
    mesh = sample(*tile[:3], SampleOptions(), tile.frame)
    below = level.covers(*centres(grid))
    truth = np.where(below, -100.0, tile.surface.height(*centres(grid)))
    data = make_tile(truth, grid=grid)
    result = evaluate(mesh, data, tile.road, tile.surface, Options())
    assert result.l2_road_m < 0.05
    assert result.completeness == 1
    assert result.triangles == len(mesh.faces)
    # A fault of the deck is an error.
    last = mesh.faces.copy()
    last[-1] = last[-1, ::-1]
    with pytest.raises(MeshFault, match="inverted faces"):
        evaluate(replace(mesh, faces=last), data, tile.road, tile.surface, Options())


def test_evaluate_truth_dsm_measures_distance_from_the_dsm_where_it_has_a_height():
    grid = make_grid(40, 30)
    mesh, truth = on_lattice(grid, tilt(0)), np.full(grid.shape, 160.0)
    data = make_tile(truth + 0.5, truth, reference=truth - 1)
    data.dsm[:, :10] = np.nan
    by_dsm, by_reference = (
        evaluate(mesh, data, make_mask(western_half(grid)), LEVEL, Options(truth=truth))
        for truth in ("dsm", "reference")
    )
    assert (by_dsm.l2_road_m, by_dsm.road_fraction) == pytest.approx((0.5, 10 / 30))
    assert by_reference.l2_road_m == pytest.approx(1.0)


def test_at_nodes_heights_of_a_plane_and_nothing_beside_it():
    """The lattice has other spacings from east to west and north to south."""
    points = np.array([[10, 20, 0], [40, 20, 0], [40, 30, 0], [10, 30, 0]], float)
    points[:, 2] = 0.5 * points[:, 0] - 2 * points[:, 1]
    heights = at_nodes(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), (0.0, 20.0, 60.0, 40.0), (5, 7))
    x, y = np.meshgrid(np.linspace(0, 60, 7), np.linspace(40, 20, 5))
    inside = (x >= 10) & (x <= 40) & (y <= 30)
    np.testing.assert_allclose(heights[inside], (0.5 * x - 2 * y)[inside], atol=1e-4)
    assert np.isnan(heights[~inside]).all()


CORE = make_grid(20, 20, north=5629520.0)
WEST = np.arange(20) < 10
ROAD = np.tile(WEST, (20, 1))


def above(distances):
    """Return a surface above the mesh by the distances of its cells, ``(20, 20)``, m."""
    return surface(lambda x, y: 160.0 + distances[CORE.cells(x, y)])


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
    assert mesh_distances(mesh, above(distances), road) == pytest.approx(expected)


def test_mesh_with_vertices_at_centres_of_cells_has_the_distance_between_them():
    x = np.arange(20) + 0.5
    mesh, road = strip(x, 10 + 0.08 * np.arange(20) ** 2)
    expected = 0.08 * 0.25 * 0.75
    bowl = surface(lambda x, y: 160 + 0.08 * (x - 295500.5) ** 2)
    assert list(mesh_distances(mesh, bowl, road).values()) == pytest.approx(4 * [expected])


def test_places_without_mesh_do_not_count():
    distances = np.where(np.arange(20) < 12, 0.1, 7.0) * np.ones((20, 1))
    mesh, road = strip([0, 12], [10.0, 10.0])
    assert list(mesh_distances(mesh, above(distances), road).values()) == pytest.approx(4 * [0.1])
    mesh, road = strip([0, 9], [10.0, 10.0])
    p95, largest = list(mesh_distances(mesh, above(distances), road).values())[2:]
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
    stepped = SteppedSurface(**vars(level), steps=steps, cells=CORE, south_north=rim, west_east=rim)
    mesh, road = strip([0, 20], [10.0, 10.0])
    expected = dict(zip(FIGURES, (0, 0, 0.75, 0.75), strict=True))
    assert mesh_distances(mesh, stepped, road) == pytest.approx(expected, abs=1e-9)


def test_surface_whose_plan_moves_has_no_distance(level):
    mesh, road = strip([0, 20], [10.0, 10.0])
    distances = mesh_distances(mesh, moving(level), road)
    assert list(distances) == list(FIGURES)
    assert all(math.isnan(distance) for distance in distances.values())
