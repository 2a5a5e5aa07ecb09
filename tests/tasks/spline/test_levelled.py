"""The surfaces of several levels: weights beside abutments, heights, slopes, and the copy in a store."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from flexroad.pipeline.store.artefacts import decode, encode
from flexroad.tasks.spline.frame import Corner, Edge
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.space import Lattice, surface_on
from flexroad.tasks.types import Level, LevelSpline, RoadClusters, RoadMask
from tests.builders import make_grid

GRID = make_grid(60, 60, west=500000.0, north=5600060.0)
WEST, SOUTH = GRID.west, GRID.south
LEVEL = Level(
    1,
    shapely.multipolygons([shapely.box(WEST + 25, SOUTH + 20, WEST + 45, SOUTH + 28)]),
    shapely.multilinestrings([shapely.LineString([(WEST + 25, SOUTH + 28), (WEST + 25, SOUTH + 20)])]),
    shapely.multipolygons([shapely.box(WEST + 9, SOUTH + 20, WEST + 25, SOUTH + 28)]),
)
"""A deck of 20 m with one abutment, in the west, and its approach."""


def made_surface(own=100.0, deck=107.0, slope=0.0):
    """Return the ground at one height, and a deck that rises to the east."""
    lattice = Lattice.of((60, 60), 1.0, 3, 3.6)
    space, _ = lattice.part(GRID.shape, (60, 0), (0, lattice.intervals[0]), (0, lattice.intervals[1]))
    n, m = space.points
    spline = surface_on(space, GRID, GRID.exact_bounds, np.full((m, n), own), np.ones((m, n)), 0.0)
    rising = deck + slope * (np.arange(n) - 1.0) * lattice.unit_m[0] + np.zeros((m, 1))
    return LevelledSurface.of(spline, (LevelSpline(LEVEL, rising),), GRID)


@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (20, 24, 1.0),  # on the approach
        (25, 24, 1.0),  # on the abutment
        (25.01, 24, 0.0),  # below the deck
        (7, 24, 0.5),  # behind the approach
        (4.9, 24, 0.0),
        (20, 30, 0.5),  # beside it
        (20, 32.1, 0.0),
        (26, 28.5, 0.0),  # at a free edge of the deck
        (55, 24, 0.0),
    ],
)
def test_weight_is_that_of_approaches(x, y, expected):
    assert LEVEL.weight(np.array(WEST + x), np.array(SOUTH + y)) == pytest.approx(expected)


def test_height_is_that_of_ground_with_approaches():
    surface = made_surface()
    x, y = WEST + np.array([20.0, 7.0, 30.0, 55.0]), np.full(4, SOUTH + 24.0)
    np.testing.assert_allclose(surface.height(x, y), [107, 103.5, 100, 100], atol=1e-9)
    np.testing.assert_allclose(surface.at(1).height(x, y), 107, atol=1e-9)
    assert surface.at(0) is surface
    assert surface.top(x, y).tolist() == [0, 0, 1, 0]
    assert surface.numbers == (0, 1)


def test_surfaces_meet_on_abutment():
    surface = made_surface(slope=0.03)
    x, y = np.full(9, WEST + 25.0), SOUTH + np.linspace(20, 28, 9)
    np.testing.assert_array_equal(surface.height(x, y), surface.at(1).height(x, y))


def test_lattice_equals_heights_with_steps():
    surface = made_surface(slope=0.03)
    surface = replace(surface, steps=np.random.default_rng(1).random(GRID.shape).astype(np.float32))
    x, y = np.meshgrid(GRID.eastings, GRID.northings)
    lattice = surface.lattice(GRID.eastings, GRID.northings)
    np.testing.assert_allclose(lattice, surface.height(x, y), atol=1e-9)
    np.testing.assert_allclose(surface.smooth(x, y), surface.height(x, y) - surface.steps, atol=1e-9)


def test_slope_equals_differences_of_heights():
    surface = made_surface(slope=0.03)
    x, y = np.meshgrid(WEST + np.arange(2.0, 58.0) + 0.13, SOUTH + np.arange(2.0, 58.0) + 0.13)
    h = 1e-4
    by_easting = (surface.height(x + h, y) - surface.height(x - h, y)) / (2 * h)
    by_northing = (surface.height(x, y + h) - surface.height(x, y - h)) / (2 * h)
    np.testing.assert_allclose(surface.slope(x, y), (by_easting, by_northing), atol=2e-2)
    assert np.abs(by_easting).max() > 2


def same(one, other):
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other)
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            same(a, b)
    elif isinstance(one, shapely.Geometry):
        assert shapely.equals_exact(one, other)
    elif hasattr(one, "__dict__"):
        for name in vars(one):
            same(getattr(one, name), getattr(other, name))
    else:
        assert one == other


def corner(height):
    return Corner(np.full((3, 3), height), np.zeros((2, 2), bool))


def edge(height):
    flags = np.zeros(60, bool)
    return Edge(np.full((3, 14), height), flags, flags, np.zeros((2, 60), bool), np.empty(0))


CLUSTERS = RoadClusters(GRID, np.ones(GRID.shape, np.int32))


@pytest.mark.parametrize(
    "result",
    [
        RoadMask(GRID, GRID, np.ones(GRID.shape, bool), np.zeros(GRID.shape, bool), levels=(LEVEL,)),
        replace(CLUSTERS, levels=(replace(CLUSTERS, level=LEVEL),)),
        replace(corner(1.0), levels=((1, corner(2.0)), (2, corner(3.0)))),
        replace(edge(1.0), levels=((-1, edge(2.0)),)),
        made_surface(),
    ],
    ids=["mask", "clusters", "corner", "edge", "surface"],
)
def test_results_with_levels_are_stored(result):
    same(decode(encode(result, {}, (), ""), "").value, result)


def test_frame_part_of_missing_level_is_that_of_ground():
    levelled = replace(corner(1.0), levels=((1, corner(2.0)),))
    assert levelled.at(1).control[0, 0] == 2.0
    assert levelled.at(2) is levelled
    assert levelled.at(0) is levelled


def test_top_is_the_deck_and_elsewhere_the_ground():
    surface = made_surface(slope=0.03)
    top, (x, y) = surface.highest, np.meshgrid(WEST + np.array([1.5, 30.5, 55.5]), SOUTH + np.array([24.5]))
    expected = [[100.0, 107 + 0.03 * 30.5, 100.0]]
    np.testing.assert_allclose(top.height(x, y), expected, atol=1e-9)
    np.testing.assert_allclose(top.lattice(x[0], y[:, 0]), expected, atol=1e-9)
    np.testing.assert_allclose(top.normal(x, y)[0, :, 0], [0, -0.03 / np.hypot(0.03, 1), 0], atol=1e-9)
    deck = surface.at(1)
    assert deck.highest is deck
    assert top.bounds == surface.bounds
