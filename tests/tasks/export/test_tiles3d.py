"""3D Tiles: transforms and regions of tiles agree with exact conversions; tilesets contain their children."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.catalog.ellipsoidal import Datum, Ellipsoidal, geocentric
from flexroad.tasks.export.tiles3d import around, leaf, placed, tileset

ORIGIN = 450_000.0, 5_550_000.0


def at(east, north, size, low=100.0, high=160.0):
    conversion = Ellipsoidal("EPSG:25832", Datum("offset", "47.5"))
    bounds = east, north, east + size, north + size
    return placed("a.glb", bounds, (low, high), ORIGIN, conversion), conversion


@pytest.mark.parametrize(("size", "within"), [(250, 0.002), (500, 0.006)])
@pytest.mark.parametrize("east", [500_000.0, 770_000.0])
def test_transform_is_exact_but_for_the_curvature_of_the_earth(east, size, within):
    tile, conversion = at(east, 5_600_000.0, size)
    rng = np.random.default_rng(1)
    points = rng.uniform((east, 5_600_000.0, 100), (east + size, 5_600_000.0 + size, 160), (500, 3))
    matrix = np.reshape(tile.transform, (4, 4)).T
    placed_at = (points - (*ORIGIN, 0)) @ matrix[:3, :3].T + matrix[:3, 3]
    errors = np.linalg.norm(placed_at - geocentric(*conversion.geographic(*points.T)), axis=1)
    assert errors.max() < within
    assert tile.residual_m < within
    # Half of the sagitta of the diagonal: no affine transform can be better than a good part of it.
    assert tile.residual_m > (size / np.sqrt(2)) ** 2 / (2 * 6.4e6) / 3


def test_transforms_of_neighbours_agree_on_their_border():
    left, *_ = at(500_000.0, 5_600_000.0, 250)
    right, *_ = at(500_250.0, 5_600_000.0, 250)
    border = np.array([[50_250.0, y, z, 1] for y in (50_000.0, 50_100.0, 50_250.0) for z in (100.0, 160.0)])
    both = [border @ np.reshape(tile.transform, (4, 4)) for tile in (left, right)]
    assert np.linalg.norm(both[0] - both[1], axis=1).max() < 0.002


def test_region_contains_all_vertices():
    tile, conversion = at(500_000.0, 5_600_000.0, 250)
    rng = np.random.default_rng(2)
    points = rng.uniform((500_000, 5_600_000, 100), (500_250, 5_600_250, 160), (500, 3))
    longitude, latitude, height = conversion.geographic(*points.T)
    west, south, east, north, low, high = tile.region
    assert np.radians(longitude).min() >= west
    assert np.radians(longitude).max() <= east
    assert np.radians(latitude).min() >= south
    assert np.radians(latitude).max() <= north
    assert low <= height.min() <= height.max() <= high


@given(st.lists(st.tuples(*[st.floats(-1, 1)] * 6), min_size=1, max_size=9))
def test_around_contains_each_region(regions):
    west, south, east, north, low, high = around(regions)
    for region in regions:
        assert west <= region[0]
        assert south <= region[1]
        assert east >= region[2]
        assert north >= region[3]
        assert low <= region[4]
        assert high >= region[5]


def test_tileset_has_its_children_and_their_region():
    children = [leaf(at(500_000.0 + 250 * n, 5_600_000.0, 250)[0], 0.05) for n in range(3)]
    made = tileset(children, 20.0, crs="EPSG:25832")
    assert made["asset"]["version"] == "1.1"
    assert made["asset"]["extras"] == {"crs": "EPSG:25832"}
    assert made["root"]["children"] == children
    assert made["root"]["boundingVolume"]["region"] == around(
        [child["boundingVolume"]["region"] for child in children]
    )
    assert len(children[0]["transform"]) == 16
