"""Figures and flags of decks: of level planes they are exact."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely

from flexroad.catalog.grid import Grid
from flexroad.pipeline.store.artefacts import decode, encode
from flexroad.tasks.quality.assess import (
    BELOW,
    NO_ABUTMENT,
    NO_RISE,
    Options,
    assess,
    cell_errors,
    structures,
)
from flexroad.tasks.quality.estimate import compare
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.types import Level, RoadClusters, RoadMask, Structures, TileData
from tests.tasks.spline.test_levelled import GRID, LEVEL, SOUTH, WEST, made_surface

NOWHERE = np.zeros(GRID.shape, np.bool_)


def road(level=LEVEL, core=GRID):
    return RoadMask(GRID, core, NOWHERE, NOWHERE, levels=(level,))


def of_plane(rise, level=LEVEL):
    surface = made_surface(100.0, 100.0 + rise)
    if level is not LEVEL:
        surface = replace(surface, levels=(replace(surface.levels[0], level=level),))
    return structures(road(level), surface, level.number)


@pytest.mark.parametrize(
    ("rise", "crossed", "flags"),
    [(7.0, 0, ()), (0.31, 0, ()), (0.29, 0, (NO_RISE,)), (-1.0, 1, (BELOW, NO_RISE))],
)
def test_figures_of_deck(rise, crossed, flags):
    found, raised = of_plane(rise)
    assert found == Structures(pytest.approx(160), 1, pytest.approx(rise, abs=1e-9), crossed)
    assert raised == flags
    # A tunnel is below the ground.
    found, raised = of_plane(-rise, replace(LEVEL, number=-1))
    assert (found.clearance_m, found.crossed) == (pytest.approx(rise, abs=1e-9), crossed)
    assert raised == flags


@pytest.mark.parametrize(("east", "flags"), [(45, (NO_ABUTMENT,)), (60, ())])
def test_deck_without_abutment_is_flagged_if_its_ends_are_known(east, flags):
    deck = shapely.multipolygons([shapely.box(WEST + 25, SOUTH + 20, WEST + east, SOUTH + 28)])
    found, raised = of_plane(7.0, Level(1, deck, shapely.MultiLineString(), shapely.MultiPolygon()))
    assert (found.abutments, raised) == (0, flags)


def test_deck_beside_the_core_has_no_figures():
    west = replace(GRID, width=20)
    assert structures(road(core=west), made_surface(), 1) == (None, ())


def test_deck_below_the_ground_at_one_end_is_flagged():
    found, raised = structures(road(), made_surface(100.0, 96.5, slope=0.1), 1)
    assert 0.4 < found.crossed < 0.6
    assert BELOW in raised


def test_flags_of_decks_are_those_of_the_tile_and_results_keep_them():
    heights = np.full(GRID.shape, 100.0)
    data = TileData("a", GRID, GRID, heights, heights)
    deck = RoadClusters(GRID, NOWHERE.astype(np.int32), level=LEVEL)
    clusters = RoadClusters(GRID, NOWHERE.astype(np.int32), levels=(deck,))
    quality = assess(data, road(), clusters, made_surface(100.0, 99.0), Options())
    (own,) = quality.levels
    assert own[1].structures.clearance_m == pytest.approx(-1, abs=1e-9)
    assert {BELOW, NO_RISE} <= set(quality.flags) & set(own[1].flags)
    restored = decode(encode(quality, {}, (), ""), "").value
    assert restored.levels[0][1].structures == own[1].structures


@pytest.mark.parametrize(
    ("number", "height_source"), [(1, HeightSource.MEASURED), (-1, HeightSource.INFERRED)]
)
def test_heights_in_tunnels_are_inferred_and_those_of_decks_measured(number, height_source):
    """The DSM of a tunnel is made from its approaches."""
    level = replace(LEVEL, number=number)
    surface = made_surface(100.0, 107.0)
    surface = replace(surface, levels=(replace(surface.levels[0], level=level),))
    heights = np.full(GRID.shape, 107.0)
    data = TileData("a", GRID, GRID, heights, heights)
    easting, northing = np.meshgrid(GRID.eastings, GRID.northings)
    covered = level.covers(easting, northing)
    kept = covered | shapely.contains_xy(level.approach, easting, northing)
    own = RoadClusters(GRID, kept.astype(np.int32), level=level)
    clusters = RoadClusters(GRID, NOWHERE.astype(np.int32), levels=(own,))
    inputs = data, road(level), clusters, surface, Options()
    error, classes = cell_errors(*inputs, number)
    assert (classes[covered] == height_source).all()
    assert (classes[~covered] == HeightSource.NONE).all()
    assert np.isfinite(error[covered]).all()
    np.testing.assert_array_equal(assess(*inputs).levels[0][1].height_source, classes)


@pytest.mark.parametrize(("width", "doubtful"), [(8, False), (44, False), (60, True)])
def test_street_below_a_deck_is_inferred_but_in_doubt_only_if_it_is_long(width, doubtful):
    grid = Grid(GRID.crs, WEST, SOUTH + 40, 1.0, 140, 40)
    street, nowhere = np.zeros(grid.shape, np.bool_), np.zeros(grid.shape, np.bool_)
    street[16:24] = True
    deck = shapely.box(WEST + 70 - width / 2, SOUTH, WEST + 70 + width / 2, SOUTH + 40)
    level = Level(1, shapely.MultiPolygon([deck]), shapely.MultiLineString(), shapely.MultiPolygon())
    ground = np.full(grid.shape, 100.0)
    dsm = np.where(level.covers(*np.meshgrid(grid.eastings, grid.northings)), 107.0, ground)
    labels = street.astype(np.int32)
    own = RoadClusters(grid, labels, levels=(RoadClusters(grid, nowhere.astype(np.int32), level=level),))
    mask = RoadMask(grid, grid, street, nowhere, levels=(level,))
    surface = SimpleNamespace(numbers=(0,), lattice=lambda eastings, northings: ground)
    inputs = TileData("a", grid, grid, dsm, ground), mask, own, surface
    quality, cells = assess(*inputs, Options()), compare(*inputs, 0.3)
    assert quality.inferred_road == pytest.approx((width + 2) / 140)
    assert ("inferred" in quality.flags) == doubtful
    # In the middle, more than 25 m from either side.
    assert cells.lacking.sum() == (8 * (width + 2 - 50) if doubtful else 0)


@pytest.mark.parametrize("number", [1, -1])
def test_road_that_goes_on_as_deck_or_tunnel_has_no_step_at_its_end(number):
    """The ground below the deck lies 7 m lower, and that above the tunnel 7 m higher."""
    level = replace(LEVEL, number=number)
    on_deck = level.covers(*np.meshgrid(GRID.eastings, GRID.northings))
    approach = np.zeros(GRID.shape, np.bool_)
    rows = on_deck.any(axis=1)
    approach[rows, : int(np.argmax(on_deck.any(axis=0)))] = True
    heights = np.where(on_deck, 100.0 - 7 * number, 100.0)
    own = RoadClusters(GRID, approach.astype(np.int32))
    surface = SimpleNamespace(lattice=lambda eastings, northings: heights)
    steps = {}
    for name, levels in (("with", (level,)), ("without", ())):
        mask = RoadMask(GRID, GRID, approach, NOWHERE, levels=levels)
        data = TileData("a", GRID, GRID, heights, heights)
        steps[name] = assess(data, mask, own, surface, Options())
    assert steps["with"].edge_step_m == 0
    assert "edge-step" in steps["without"].flags
