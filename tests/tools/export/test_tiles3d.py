"""3D Tiles: transforms and regions of tiles agree with exact conversions; tilesets contain their children."""

import io

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from flexroad.tools.export.georeference import Datum, Georeference, geocentric
from flexroad.tools.export.relief import Relief, encode_sheet, sheet
from flexroad.tools.export.tiles3d import (
    around,
    east_north_up,
    extent_m,
    group,
    placed,
    sheet_placed,
    tile,
    tileset,
)
from tests.read_exports import from_earth

PLACE = Georeference("EPSG:25832", (450_000.0, 5_550_000.0, 0.0))
DATUM = Datum("offset", "47.5")


def at(east, north, size, low=100.0, high=160.0):
    bounds = east, north, east + size, north + size
    return placed("a.glb", bounds, (low, high), PLACE, DATUM)


@pytest.mark.parametrize(("size", "within"), [(250, 0.002), (500, 0.006)])
@pytest.mark.parametrize("east", [500_000.0, 770_000.0])
def test_transform_is_exact_but_for_the_curvature_of_the_earth(east, size, within):
    leaf = at(east, 5_600_000.0, size)
    rng = np.random.default_rng(1)
    points = rng.uniform((east, 5_600_000.0, 100), (east + size, 5_600_000.0 + size, 160), (500, 3))
    matrix = np.reshape(leaf["transform"], (4, 4)).T
    placed_at = (points - PLACE.origin) @ matrix[:3, :3].T + matrix[:3, 3]
    errors = np.linalg.norm(placed_at - geocentric(*DATUM.geographic(PLACE.crs, *points.T)), axis=1)
    assert errors.max() < within
    # Half of the sagitta of the diagonal: no affine transform can be better than a good part of it.
    assert errors.max() > (size / np.sqrt(2)) ** 2 / (2 * 6.4e6) / 3


def test_transforms_of_neighbours_agree_on_their_border():
    left = at(500_000.0, 5_600_000.0, 250)
    right = at(500_250.0, 5_600_000.0, 250)
    border = np.array([[50_250.0, y, z, 1] for y in (50_000.0, 50_100.0, 50_250.0) for z in (100.0, 160.0)])
    both = [border @ np.reshape(leaf["transform"], (4, 4)) for leaf in (left, right)]
    assert np.linalg.norm(both[0] - both[1], axis=1).max() < 0.002


def test_regions_contain_all_vertices():
    east, north = 500_000.0, 5_600_000.0
    points = np.random.default_rng(2).uniform((east, north, 100), (east + 250, north + 250, 160), (500, 3))
    made, placed_sheet, _ = sheet_of(4000.0, east, north, 64.0)
    for region, inside in ((at(east, north, 250)["region"], points), (placed_sheet["region"], made.points)):
        longitude, latitude, height = DATUM.geographic(PLACE.crs, *inside.T)
        plan, (west, south, east_, north_, low, high) = np.radians([longitude, latitude]), region
        assert (plan.min(axis=1) > [west, south]).all()
        assert (plan.max(axis=1) < [east_, north_]).all()
        assert low <= height.min() < height.max() <= high
    west, _, east_, *_ = placed_sheet["region"]
    assert east_ - west < np.ptp(plan[0]) + 1e-7


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 6), min_size=1, max_size=9))
def test_around_contains_each_region(regions):
    west, south, east, north, low, high = around(regions)
    assert (np.array(regions)[:, [0, 1, 4]] >= [west, south, low]).all()
    assert (np.array(regions)[:, [2, 3, 5]] <= [east, north, high]).all()


def matrix_of(entry):
    return np.reshape(entry["transform"], (4, 4)).T


def sheet_of(side, east, north, spacing):
    """A relief of hills with a skirt, and where it is on the Earth."""
    number = round(side / spacing) + 1
    axis = np.linspace(0, side, number)
    heights = 150 + 80 * np.add.outer(np.sin(axis / 500), np.cos(axis / 700))
    cells = np.ones((number - 1, number - 1), bool)
    made = sheet(Relief((east, north, east + side, north + side), heights, cells, 1.0), 8.0)
    return made, *sheet_placed("b.glb", made.points, PLACE.crs, DATUM)


@pytest.mark.parametrize("east", [500_000.0, 770_000.0])
def test_sheet_of_4_km_is_where_its_points_are_within_2_mm(east):
    """As a viewer reads it: float32 vertices with the transform of the tile."""
    made, placed_sheet, local = sheet_of(4000.0, east, 5_600_000.0, 64.0)
    data = encode_sheet(made, local, (east, 5_600_000.0, east + 4000, 5_604_000.0), b"", False)
    scene = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
    x, y, z = scene.geometry["ground"].vertices.astype(np.float32).T.astype(np.float64)
    matrix = matrix_of(tile(placed_sheet, 64.0))
    read = from_earth(np.column_stack([x, -z, y]) @ matrix[:3, :3].T + matrix[:3, 3])
    assert np.abs(read - made.points).max() < 0.002
    # A rigid frame: lengths on the Earth, not on the map.
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-14)
    assert np.abs(local).max() < 4000


def test_east_north_up_is_where_the_place_is():
    longitude, latitude, height = 9.0, 50.5, 200.0
    matrix = east_north_up(longitude, latitude, height)
    moved = {"east": (1e-5, 0, 0), "north": (0, 1e-5, 0), "up": (0, 0, 1.0)}
    for axis, (dx, dy, dz) in zip(matrix[:3, :3].T, moved.values(), strict=True):
        there = geocentric(*(np.array([v]) for v in (longitude + dx, latitude + dy, height + dz)))[0]
        direction = (there - matrix[:3, 3]) / np.linalg.norm(there - matrix[:3, 3])
        np.testing.assert_allclose(axis, direction, atol=1e-6)


def test_tile_transform_of_a_child_is_relative_to_its_parent():
    """A transform applies to all tiles below it."""
    parent = sheet_of(1000.0, 500_000.0, 5_600_000.0, 16.0)[1]
    child = at(500_250.0, 5_600_250.0, 250)
    entry = tile(parent, 16.0, children=[tile(child, 0.0, parent)])
    product = matrix_of(entry) @ matrix_of(entry["children"][0])
    points = np.array([[50_250.0, 50_250.0, 100.0, 1], [50_500.0, 50_500.0, 160.0, 1]])
    alone = points @ np.reshape(child["transform"], (4, 4))
    np.testing.assert_allclose(points @ product.T, alone, atol=1e-7)


def test_tile_with_children_replaces_them_and_contains_them():
    parent = sheet_of(1000.0, 500_000.0, 5_600_000.0, 16.0)[1]
    outside = at(500_900.0, 5_600_900.0, 250, high=900.0)
    entry = tile(parent, 16.0, children=[tile(outside, 0.0, parent)], vertical_error_m=1.5)
    assert entry["refine"] == "REPLACE"
    assert entry["extras"] == {"vertical_error_m": 1.5}
    assert entry["boundingVolume"]["region"] == around([parent["region"], outside["region"]])
    assert "refine" not in entry["children"][0]


def test_tileset_of_a_group_has_its_children_and_their_region():
    children = [tile(at(500_000.0 + 250 * n, 5_600_000.0, 250), 0.0) for n in range(3)]
    region = around([child["boundingVolume"]["region"] for child in children])
    made = tileset(group(children, extent_m(region)), extent_m(region), crs="EPSG:25832")
    assert made["asset"]["version"] == "1.1"
    assert made["asset"]["extras"] == {"crs": "EPSG:25832"}
    assert made["root"]["children"] == children
    assert made["root"]["boundingVolume"]["region"] == region
    # 750 x 250 m: to show nothing is wrong by as much.
    assert made["geometricError"] == pytest.approx(np.hypot(750, 250), abs=3)
    assert len(children[0]["transform"]) == 16
