"""Meshes in which roads from polygons end at the polygons' outlines."""

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flexroad.catalog.borders import border_of
from flexroad.catalog.grid import Grid
from flexroad.tasks.meshing.road_outline import crossings, encoded
from flexroad.tasks.metrics.mesh_check import faults
from flexroad.tasks.roads.rasterise import cells
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.types import RoadClusters, RoadMask
from tests.crossing import border_part
from tests.mesh_union import Union
from tests.tasks.test_sample import Hills, areas

WEST, SOUTH = 295500.0, 5629250.0


def at(x, y):
    return WEST + x, SOUTH + y


def road(half_m, *points):
    return shapely.buffer(shapely.linestrings([at(*point) for point in points]), half_m, cap_style="flat")


DISC = shapely.Point(at(47.3, 52.1)).buffer(17.6, quad_segs=64)
ROADS = {
    "roundabout": [DISC.difference(shapely.Point(at(47.3, 52.1)).buffer(9.2, quad_segs=64))],
    "slanted": [road(3.63, (-20, 11.4), (230, 71.7))],
    "crossing": [
        road(3.5, (-9, 30), (260, 40)),
        road(2.75, (70, -9), (82, 120)),
        road(2, (-9, 44), (260, 38)),
    ],
    "small angle": [road(3, (-9, 50), (120, 50)), road(3, (-9, 50), (120, 62))],
    "touching": [shapely.box(*at(20, 20), *at(40.2, 41)), shapely.box(*at(40.2, 41), *at(60, 60))],
    "along the border": [shapely.box(*at(0, -5), *at(100, 4)), shapely.box(*at(93, 20), *at(100, 50))],
}


def grid_of(column, row, cell=1.0, size_m=100):
    n = round(size_m / cell)
    return Grid("EPSG:25832", WEST + column * size_m, SOUTH + (row + 1) * size_m, cell, n, n)


def frame_of(grid, polygons):
    return Frame(*(border_part(border, polygons) for border in border_of(grid, 10.0)))


def meshed(polygons, grid, frame=None, options=None, exact=True, outside=None):
    polygons = np.array(polygons, object)
    mask = cells(polygons, grid)
    beyond = np.zeros_like(mask) if outside is None else outside
    kept = encoded(polygons, grid) if exact else None
    segmented = RoadMask(grid, grid, mask, beyond, areas=kept)
    return sample(Hills(), segmented, RoadClusters(grid, mask.astype(np.int32)), options or Options(), frame)


def drawn(*parts, road_only=True):
    """The faces of meshes as one area."""
    faces = [mesh.faces[mesh.road] if road_only else mesh.faces for mesh in parts]
    plans = [mesh.vertices[:, :2] + np.array(mesh.origin[:2]) for mesh in parts]
    triangles = np.concatenate([plan[corners] for plan, corners in zip(plans, faces, strict=True)])
    return shapely.coverage_union_all(shapely.polygons(triangles))


def assert_equal_outlines(result, truth, name):
    away, back = (
        shapely.distance(
            shapely.points(shapely.get_coordinates(shapely.segmentize(a.boundary, 0.05))), b.boundary
        )
        for a, b in ((result, truth), (truth, result))
    )
    # Outlines of 1 m chords on a circle of 9.2 m are 0.014 m inside of it.
    assert away.max() <= 0.02 + 0.014
    # A gap is closed where it is narrower than 2 cm: for 0.27 m where its sides meet at 4 degrees.
    assert back.max() <= (0.3 if name in ("small angle", "crossing") else 0.02 + 0.014)


@pytest.mark.parametrize("framed", [False, True])
@pytest.mark.parametrize("name", ROADS)
def test_road_of_mesh_ends_at_outline(name, framed):
    polygons, grid = ROADS[name], grid_of(0, 0)
    mesh = meshed(polygons, grid, frame_of(grid, np.array(polygons, object)) if framed else None)
    assert not faults(mesh)
    domain = shapely.box(*(grid.bounds if framed else grid.hull))
    truth = shapely.intersection(shapely.union_all(polygons), domain)
    result = drawn(mesh)
    assert_equal_outlines(result, truth, name)
    assert result.area == pytest.approx(truth.area, rel=1e-3)
    assert areas(mesh).sum() == pytest.approx(domain.area, rel=1e-12)
    east, north, up = (mesh.vertices + np.array(mesh.origin)).T
    heights = Hills().height(east, north)
    np.testing.assert_allclose(up, heights, rtol=0, atol=2.0**-12)


@pytest.mark.parametrize("name", ["crossing", "slanted"])
def test_roads_of_cells_are_steps(name):
    """What the outlines improve."""
    polygons, grid = ROADS[name], grid_of(0, 0)
    truth = shapely.intersection(shapely.union_all(polygons), shapely.box(*grid.hull))
    steps, exact = (drawn(mesh) for mesh in (meshed(polygons, grid, exact=e) for e in (False, True)))
    assert shapely.hausdorff_distance(steps.boundary, truth.boundary, densify=0.01) > 0.5
    assert shapely.area(steps ^ truth) > 100 * shapely.area(exact ^ truth)


def joined(tiles, polygons, options=None):
    polygons = np.array(polygons, object)
    parts = [meshed(polygons, grid, frame_of(grid, polygons), options) for grid in tiles]
    assert not any(map(faults, parts))
    return parts, Union.of((mesh.vertices + np.array(mesh.origin), mesh.faces) for mesh in parts)


@pytest.mark.parametrize("name", ROADS)
def test_outlines_meet_at_border(name):
    tiles = [grid_of(column, row) for column in (0, 1) for row in (-1, 0)]
    parts, whole = joined(tiles, ROADS[name])
    assert whole.uses.max() == 2
    assert (whole.uses[whole.inside] == 2).all()
    assert whole.area == 40_000
    road = drawn(*parts)
    truth = shapely.intersection(shapely.union_all(ROADS[name]), shapely.box(*at(0, -100), *at(200, 100)))
    assert_equal_outlines(road, truth, name)
    assert road.area == pytest.approx(truth.area, rel=1e-3)


def test_crossings_do_not_depend_on_roads_elsewhere():
    """Border vertices are exact in the float32 of GLB files, and the outline meets them."""
    border = border_of(grid_of(0, 0), 10.0)[7]
    places = crossings(encoded(np.array(ROADS["slanted"], object), border.grid), border)
    slope, run = 60.3 / 250, 3.63 * np.hypot(1, 60.3 / 250)
    np.testing.assert_allclose(places, 11.4 + 120 * slope + np.array([-run, run]), rtol=0, atol=0.004)
    np.testing.assert_array_equal(places, places.astype(np.float32))


def test_filtered_and_uniform_meshes_have_cells():
    polygons, grid = ROADS["slanted"], grid_of(0, 0)
    for options in (Options(mask="filtered"), Options(method="uniform")):
        one, other = (meshed(polygons, grid, options=options, exact=exact) for exact in (True, False))
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.road, other.road)


def test_roads_without_outline_on_tile():
    covering, far = [shapely.box(*at(-50, -50), *at(150, 150))], [shapely.box(*at(500, 0), *at(510, 10))]
    grid = grid_of(0, 0)
    whole, nothing = meshed(covering, grid), meshed(far, grid)
    assert whole.road.all()
    assert not nothing.road.any()
    assert not faults(whole)
    assert encoded(np.array(far, object), grid) is None


def test_gaps_of_drawings_are_closed():
    polygons = [shapely.box(*at(10, 10), *at(50, 30)), shapely.box(*at(10, 30.011), *at(50, 50)),
                shapely.box(*at(50.1, 10), *at(80, 50))]  # fmt: skip
    mesh = meshed(polygons, grid_of(0, 0))
    result = drawn(mesh)
    assert [len(part.interiors) for part in shapely.get_parts(result)] == [0, 0]
    assert result.area == pytest.approx(40 * 40 + 29.9 * 40, abs=0.2)


def test_invalid_and_empty_polygons_and_heights_are_no_trouble():
    grid = grid_of(0, 0)
    bow = shapely.Polygon([at(10, 10), at(30, 40), at(30, 10), at(10, 40)])
    high = shapely.Polygon([(*at(60, 10), 5.0), (*at(90, 10), 5.0), (*at(90, 40), 6.0)])
    nowhere = shapely.Polygon([(np.inf, 0), (np.inf, 1), (0, 1)])
    spike = shapely.Polygon([at(50, 60), at(60, 60), at(60, 70), at(60, 95), at(60, 70), at(50, 70)])
    mesh = meshed([bow, high, shapely.Polygon(), nowhere, spike], grid)
    assert not faults(mesh)
    assert drawn(mesh).area == pytest.approx(300 + 450 + 100, rel=1e-3)


def test_outline_and_end_of_survey_cross():
    polygons, grid = ROADS["crossing"], grid_of(0, 0)
    x, y = np.meshgrid(grid.eastings - WEST, grid.northings - SOUTH)
    outside = y > 10 + 0.8 * x
    mesh = meshed(polygons, grid, outside=outside)
    assert not faults(mesh)
    covered, truth = drawn(mesh, road_only=False), shapely.union_all(polygons)
    centres = shapely.contains_xy(covered, *np.meshgrid(grid.eastings, grid.northings))
    np.testing.assert_array_equal(centres[1:-1, 1:-1], ~outside[1:-1, 1:-1])
    assert shapely.area(drawn(mesh) ^ (truth & covered)) < 1.0


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 25), cell=st.sampled_from([0.5, 1.0]))
@example(seed=23, count=25, cell=0.5)
@example(seed=25, count=23, cell=0.5)
@example(seed=760, count=6, cell=0.5)
@example(seed=3011, count=24, cell=1.0)
def test_any_roads_give_meshes_that_meet(seed, count, cell):
    """Among them roads that touch, cross at small angles, lie on a lattice, or graze a border."""
    rng = np.random.default_rng(seed)
    lines = rng.uniform(-10, 70, (count, 2, 2))
    whole = rng.random(count) < 0.5
    lines[whole] = np.round(lines[whole])
    polygons = [
        road(rng.choice([0.05, 1.5, 3.0]), *line) for line in lines if np.ptp(line, axis=0).max() > 0.1
    ]
    tiles = [grid_of(column, row, cell, 30) for column in (0, 1) for row in (0, 1)]
    if not polygons:
        return
    parts, whole = joined(tiles, polygons, Options(road_m=0.9))
    assert (whole.uses[whole.inside] == 2).all()
    road_ = drawn(*parts)
    truth = shapely.intersection(shapely.union_all(polygons), shapely.box(*at(0, 0), *at(60, 60)))
    assert shapely.area(road_ ^ truth) <= 0.02 * shapely.length(truth) + 0.05
