from dataclasses import dataclass

import numpy as np
import pytest
import scipy
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.metrics.mesh_check import faults
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.spline.moving import moving
from flexroad.tasks.spline.space import clamped_space, surface_on
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask, Surface
from tests.builders import make_grid


@dataclass(frozen=True)
class Hills(Surface):
    """A surface with heights everywhere except in a hole."""

    hole: tuple[float, float, float] | None = None
    bounds = (0.0, 0.0, 1.0, 1.0)

    def height(self, easting, northing):
        z = 150 + 3 * np.sin(easting / 17) + 2 * np.cos(northing / 11)
        if self.hole is None:
            return z
        x, y, radius = self.hole
        return np.where(np.hypot(easting - x, northing - y) < radius, np.nan, z)

    def lattice(self, eastings, northings):
        return self.height(eastings[None, :], northings[:, None])

    def normal(self, easting, northing):
        raise NotImplementedError


def diagonal_street(grid: Grid, half_m: float = 12.0):
    x, y = np.meshgrid(grid.eastings - grid.west, grid.northings - grid.south)
    return np.abs(x - y) < half_m


def sampled(core, mask, options=None, surface=None, halo=0.0, outside=None, filtered=None) -> Mesh:
    grid = core.buffered(halo)
    road = RoadMask(grid, core, mask, np.zeros(grid.shape, bool) if outside is None else outside)
    clusters = RoadClusters(grid, (mask if filtered is None else filtered).astype(np.int32))
    return sample(surface or Hills(), road, clusters, options or Options())


def areas(mesh: Mesh):
    """Signed areas in plan (m2); positive is counter-clockwise."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces][..., :2], 1, 0)
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def plan(mesh: Mesh):
    return mesh.vertices[:, :2] + np.array(mesh.origin[:2])


def drawn(mesh: Mesh):
    """Return the faces as one area."""
    return shapely.union_all(shapely.polygons(plan(mesh)[mesh.faces]))


def assert_covers(mesh: Mesh, bounds):
    """Assert that the faces triangulate the rectangle without gap, overlap or degenerate face."""
    west, south, east, north = bounds
    signed = areas(mesh)
    assert signed.min() > 1e-7
    assert signed.sum() == pytest.approx((east - west) * (north - south), rel=1e-9)
    xy = plan(mesh)
    assert xy.min(axis=0) == pytest.approx([west, south], abs=1e-9)
    assert xy.max(axis=0) == pytest.approx([east, north], abs=1e-9)
    at_border = (np.abs(xy - [west, south]) < 1e-8) | (np.abs(xy - [east, north]) < 1e-8)
    # Euler's formula: every vertex is used, and the outline has as many edges as vertices.
    assert len(mesh.faces) == 2 * len(xy) - 2 - at_border.any(axis=1).sum()
    assert len(np.unique(mesh.faces)) == len(xy) == len(np.unique(xy.round(6), axis=0))


@pytest.mark.parametrize(("method", "triangles"), [("uniform", 124_002), ("corners", 2), ("dynamic", None)])
def test_sample_of_a_tile_as_in_the_paper_has_the_heights_of_the_surface(method, triangles):
    core = make_grid(250, 250)
    # The end of the survey does not cut a mesh of two triangles.
    outside = np.full(core.shape, method == "corners")
    mesh = sampled(core, diagonal_street(core), Options(method=method), outside=outside)
    assert triangles in (None, len(mesh.faces))
    assert_covers(mesh, core.hull)
    east, north, up = (mesh.vertices + np.array(mesh.origin)).T
    np.testing.assert_allclose(up, Hills().height(east, north), rtol=0, atol=1e-9)
    assert mesh.origin == (295500, 5629250, np.floor(up.min()))
    assert 0 <= mesh.vertices[:, 2].min() < 1


def test_uniform_adds_points_on_border():
    core = make_grid(30, 20)
    mesh = sampled(core, diagonal_street(core), Options(method="uniform", road_m=4))
    assert np.unique(mesh.vertices[:, 0]).tolist() == [0.5, 4.5, 8.5, 12.5, 16.5, 20.5, 24.5, 28.5, 29.5]
    assert np.unique(mesh.vertices[:, 1]).tolist() == [0.5, 4.5, 8.5, 12.5, 16.5, 19.5]
    assert_covers(mesh, core.hull)


def test_dynamic_is_fine_on_road_and_coarse_elsewhere():
    core = make_grid(250, 250)
    mask = diagonal_street(core)
    mesh = sampled(core, mask)
    assert_covers(mesh, core.hull)
    xy = mesh.vertices[:, :2] - 0.5
    on_road = mask[core.cells(*plan(mesh).T)]
    assert on_road.sum() == mask.sum()
    on_lattice = (xy % 10 == 0).all(axis=1)
    on_border = ((xy == 0) | (xy == 249)).any(axis=1)
    assert (on_road | on_lattice | on_border).all()
    without_road = sampled(core, np.zeros_like(mask))
    assert (len(without_road.vertices), len(sampled(core, ~np.zeros_like(mask)).faces)) == (26 * 26, 124_002)


@given(
    cell=st.sampled_from([1.0, 0.5, 0.2, 0.3, 2.0]),
    shape=st.tuples(st.integers(2, 24), st.integers(2, 24)),
    corner=st.tuples(st.floats(-1e3, 7e5), st.floats(0, 9e6)),
    road_m=st.sampled_from([0.3, 0.5, 0.7, 1.0, 1.3]),
    ratio=st.sampled_from([1.0, 3.0, 3.7, 10.0]),
    halo=st.sampled_from([0, 0, 2]),
    method=st.sampled_from(["dynamic", "dynamic", "uniform", "corners"]),
    data=st.data(),
)
@settings(max_examples=150)
def test_sample_any_mask_and_lattice_covers_domain(cell, shape, corner, road_m, ratio, halo, method, data):
    core = make_grid(shape[1], shape[0], cell, *corner)
    grid = core.buffered(halo)
    mask = data.draw(arrays.arrays(bool, grid.shape))
    options = Options(method=method, road_m=road_m * cell, terrain_m=ratio * road_m * cell)
    mesh = sampled(core, mask, options, halo=halo)
    assert_covers(mesh, core.bounds if halo else core.hull)


@pytest.mark.parametrize("cell", [1.0, 0.2])
def test_sample_neighbours_with_halo_meet(cell):
    """Both meshes have the same vertices on the shared edge."""
    n = round(50 / cell)
    west, east = make_grid(n, n, cell), make_grid(n, n, cell, west=295550.0)
    edges = []
    for core in (west, east):
        grid = core.buffered(10)
        x, y = np.meshgrid(grid.eastings, grid.northings)
        mask = np.abs(x - 295550 - (y - 5629475) * 0.6) < 4
        xy = plan(sampled(core, mask, halo=10)).round(6)
        edges.append({tuple(point) for point in xy if abs(point[0] - 295550) < 1e-6})
    assert edges[0] == edges[1]
    assert len(edges[0]) > 8


def moving_surface(core, spread):
    """A surface whose weights vary by a factor up to ``exp(2 * spread)``."""
    w = np.exp(np.random.default_rng(5).uniform(-spread, spread, (9, 9)))
    return moving(surface_on(clamped_space(core, 3, (9, 9)), core, core.hull, 0 * w, w, 150.0))


@pytest.mark.parametrize("method", ["dynamic", "uniform"])
def test_sample_moving_surface_has_vertices_in_space(method):
    core = make_grid(60, 60)
    mask, options = diagonal_street(core), Options(method=method)
    surface = moving_surface(core, 1.0)
    mesh = sampled(core, mask, options, surface)
    fixed = sampled(core, mask, options)
    assert faults(mesh) == ()
    expected = np.column_stack(surface.moved(*(fixed.vertices[:, :2] + core.origin).T))
    order = [np.lexsort(points[:, :2].T) for points in (expected, mesh.vertices)]
    np.testing.assert_allclose(mesh.vertices[order[1], :2], expected[order[0]], atol=1e-9)
    assert np.abs(expected - fixed.vertices[:, :2]).max() > 1
    assert_covers(mesh, core.hull)


def test_sample_filtered_mask_is_used():
    core = make_grid(60, 60)
    mask = np.ones(core.shape, bool)
    filtered = diagonal_street(core, 5)
    raw = sampled(core, mask, filtered=filtered)
    fine = sampled(core, mask, Options(mask="filtered"), filtered=filtered)
    assert len(fine.vertices) < len(raw.vertices) / 3
    assert raw.road.all()
    np.testing.assert_array_equal(fine.road, filtered[core.cells(*plan(fine)[fine.faces].mean(axis=1).T)])


@pytest.mark.parametrize("method", ["dynamic", "uniform"])
def test_sample_faces_without_height_are_dropped(method):
    core = make_grid(60, 60)
    hole = (295530.0, 5629470.0, 8.0)
    mesh = sampled(core, diagonal_street(core), Options(method=method), surface=Hills(hole))
    assert np.isfinite(mesh.vertices).all()
    assert (np.hypot(*(plan(mesh) - hole[:2]).T) >= 8).all()
    assert areas(mesh).sum() < 59**2 - 150
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_uniform_mesh_ends_with_survey():
    core = make_grid(60, 60)
    outside = np.zeros(core.shape, bool)
    outside[:, :25] = True
    whole = sampled(core, diagonal_street(core), Options(method="uniform"))
    mesh = sampled(core, diagonal_street(core), Options(method="uniform"), outside=outside)
    centroids = plan(mesh)[mesh.faces].mean(axis=1)
    assert not outside[core.cells(*centroids.T)].any()
    inside = ~outside[core.cells(*plan(whole)[whole.faces].mean(axis=1).T)]
    assert len(mesh.faces) == inside.sum() < len(whole.faces)
    np.testing.assert_array_equal(plan(mesh)[mesh.faces], plan(whole)[whole.faces[inside]])


LIMITS = {
    "straight": lambda x, y: x > 25,
    "slanted": lambda x, y: y > 20 + 0.37 * x,
    "shallow": lambda x, y: y > 31.2 + 0.03 * x,
    "curved": lambda x, y: np.hypot(x - 20, y - 30) < 60,
    "bay": lambda x, y: np.hypot(x - 90, y - 50) > 30,
}
"""Where a survey has data, by metres from the south-west corner of a tile of 100 m."""


@pytest.mark.parametrize(("cell", "halo"), [(1.0, 0), (0.5, 10)])
@pytest.mark.parametrize("limit", LIMITS)
def test_dynamic_mesh_is_cut_to_survey(limit, cell, halo):
    core = make_grid(round(100 / cell), round(100 / cell), cell)
    grid = core.buffered(halo)
    x, y = np.meshgrid(grid.eastings - core.west, grid.northings - core.south)
    outside = ~LIMITS[limit](x, y)
    mesh = sampled(core, diagonal_street(grid, 5), halo=halo, outside=outside)
    assert not faults(mesh)
    # The true limit, by points 0.1 m apart.
    fine = np.arange(0.05, 100, 0.1)
    domain = shapely.box(*(core.bounds if halo else core.hull))
    truth = shapely.transform(domain, lambda points: points - [core.west, core.south])
    px, py = np.meshgrid(fine, fine)
    known = LIMITS[limit](px, py)
    west, south, east, north = truth.bounds
    known &= (px > west) & (px < east) & (py > south) & (py < north)
    local = shapely.transform(drawn(mesh), lambda points: points - [core.west, core.south])
    shapely.prepare(local)
    covered = shapely.contains_xy(local, px, py)
    # Distances of the places where mesh and survey differ from the true limit.
    away = np.maximum(
        scipy.ndimage.distance_transform_edt(known), scipy.ndimage.distance_transform_edt(~known)
    )
    assert away[covered != known].max(initial=0.0) * 0.1 <= 0.85 * cell
    # Mean width of the difference along the limit.
    rim = np.count_nonzero(known[1:] != known[:-1]) + np.count_nonzero(known[:, 1:] != known[:, :-1])
    assert abs(covered.sum() - known.sum()) / rim * 0.1 < 0.2 * cell
    # No centre of a cell with data is lost, and none beyond the survey is covered.
    rows = grid.window(core)
    centres = np.meshgrid(core.eastings - core.west, core.northings - core.south)
    inner = shapely.contains_xy(truth, *centres)
    np.testing.assert_array_equal(shapely.contains_xy(local, *centres)[inner], ~outside[rows][inner])


def test_dynamic_mesh_of_covered_tile_ignores_gap_in_halo():
    core = make_grid(60, 60)
    grid = core.buffered(10)
    outside = np.zeros(grid.shape, bool)
    outside[:5] = True
    whole = sampled(core, diagonal_street(grid), halo=10)
    mesh = sampled(core, diagonal_street(grid), halo=10, outside=outside)
    np.testing.assert_array_equal(mesh.vertices, whole.vertices)
    np.testing.assert_array_equal(mesh.faces, whole.faces)


def test_dynamic_mesh_keeps_islands_and_joins_cells_at_corners():
    core = make_grid(60, 60)
    outside = np.ones(core.shape, bool)
    outside[30, 30] = outside[31, 31] = outside[10, 50] = False
    mesh = sampled(core, np.zeros_like(outside), outside=outside)
    assert not faults(mesh)
    row, col = core.cells(*plan(mesh)[mesh.faces].mean(axis=1).T)
    assert outside[row, col].sum() < len(row)
    assert (outside[row, col] <= ((row // 2 == 15) & (col // 2 == 15))).all()
    assert 1.0 < areas(mesh).sum() < 3.0


def test_dynamic_mesh_without_heights_raises():
    core = make_grid(20, 20)
    every = np.ones(core.shape, bool)
    for beyond, surface in ((every, None), (None, Hills((295510.0, 5629490.0, 1e3)))):
        with pytest.raises(TaskError, match="no height"):
            sampled(core, every, surface=surface, outside=beyond)


@given(seed=st.integers(0, 2**31), halo=st.sampled_from([0, 2]), share=st.floats(0.05, 0.95))
@settings(max_examples=60)
def test_dynamic_mesh_of_any_survey_has_every_centre_with_data(seed, halo, share):
    core = make_grid(30, 24)
    grid = core.buffered(halo)
    rng = np.random.default_rng(seed)
    outside = rng.random(grid.shape) < share
    mesh = sampled(core, rng.random(grid.shape) < 0.5, halo=halo, outside=outside)
    assert not faults(mesh)
    inner = slice(None) if halo else slice(1, -1)
    covered = shapely.contains_xy(drawn(mesh), *np.meshgrid(core.eastings, core.northings))
    known = ~outside[grid.window(core)]
    np.testing.assert_array_equal(covered[inner, inner], known[inner, inner])


def test_sample_shifted_survey_gives_same_mesh():
    shift = np.array([4_000_000.0, -3_000_000.0])
    grid, shifted_grid = (
        make_grid(80, 80),
        make_grid(80, 80, west=295500 + shift[0], north=5629500 + shift[1]),
    )
    one, two = sampled(grid, diagonal_street(grid)), sampled(shifted_grid, diagonal_street(shifted_grid))
    np.testing.assert_array_equal(one.vertices[:, :2], two.vertices[:, :2])
    np.testing.assert_array_equal(one.faces, two.faces)


def test_sample_single_row_of_cells_raises():
    core = make_grid(5, 1)
    with pytest.raises(TaskError, match="5 x 1 cells span no area"):
        sampled(core, np.ones(core.shape, bool))
    assert_covers(sampled(core, np.ones((5, 9), bool), halo=2), core.bounds)
