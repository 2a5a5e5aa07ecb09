"""Surfaces of tiles from shared corners and edges, against one fit of all tiles together."""

from dataclasses import fields, replace
from functools import cache, partial

import numpy as np
import pytest
import scipy

from flexroad.catalog.borders import border_of
from flexroad.catalog.grid import Grid
from flexroad.pipeline.store.artefacts import encode
from flexroad.tasks import load
from flexroad.tasks.border import BorderStages
from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.roads.dtm_validity import ground_to_fit
from flexroad.tasks.segment import mask
from flexroad.tasks.spline.frame import Frame
from flexroad.tasks.spline.surface import basis_matrix, uniform_knots
from flexroad.tasks.types import TileData
from flexroad.tools.synthetic import make_scene
from tests import exact_fit
from tests.builders import filtered, make_frame

AROUND_M = 100
FILTER = planar.Options(shoulder_m=5)
OPTIONS = smoothing_spline.Options()
ALL = Grid("EPSG:25832", 500000, 5600500, 1.0, 500, 500)
"""Two by two tiles of 250 m."""
WORLD = ALL.buffered(AROUND_M)
EAST, NORTH = np.meshgrid(WORLD.eastings - 500250, WORLD.northings - 5600250)
"""Places of the cells of a world from its middle (m)."""
NORTH_WEST, SOUTH_WEST = (Grid("EPSG:25832", 500000, north, 1.0, 250, 250) for north in (5600500, 5600250))


@cache
def made_world(stratum):
    scene = make_scene(WORLD, 3, stratum)
    return TileData(
        "world", scene.grid, ALL, scene.dsm, scene.dtm, scene.road_mask, scene.reference, scene.reference_road
    )


def frame_of(world, tile, options=OPTIONS):
    return make_frame(partial(filtered, world), tile, AROUND_M, options)


def north_east_corner(world, options=OPTIONS):
    """Return the control points of the corner in the middle of the world."""
    border = border_of(SOUTH_WEST, AROUND_M)[3]
    return smoothing_spline.corner(*filtered(world, border.grid), border, options).control


def fit_tiles(world, halo_m=50, options=OPTIONS):
    """Return the surfaces of the four tiles by (column, row), each fitted with the ground around it alone."""
    surfaces = {}
    for _, tile in ALL.tiles(250):
        data, _, clusters = filtered(world, tile.buffered(halo_m), tile)
        key = round(tile.west - ALL.west) // 250, round(tile.south - ALL.south) // 250
        surfaces[key] = smoothing_spline.fit(data, clusters, options, frame_of(world, tile))
    return surfaces


def joined(surfaces):
    m, n = (points - 3 for points in surfaces[0, 0].A.shape)
    control = np.empty((2 * m + 3, 2 * n + 3))
    for (column, row), surface in surfaces.items():
        control[row * m : row * m + m + 3, column * n : column * n + n + 3] = surface.A
    return control


def fit_together(world, monkeypatch):
    """Return the control heights of one precise fit of the complete world, on the same lattice."""
    data, _, clusters = filtered(world, WORLD, ALL)
    monkeypatch.setattr(smoothing_spline, "BORDER_TOLERANCE", 1e-8)
    lattice = smoothing_spline._lattice((250, 250), 1.0, OPTIONS)
    (n, m), (k, j) = lattice.intervals, lattice.lines_within(AROUND_M)
    u, v = (-k, 2 * n + k), (-j, 2 * m + j)
    free = np.full((2 * m + 2 * j + 3, 2 * n + 2 * k + 3), np.nan)
    start = AROUND_M + 500, AROUND_M
    control = smoothing_spline._fitted(data, clusters, lattice, start, u, v, free, OPTIONS)[1]
    return control[j : j + 2 * m + 3, k : k + 2 * n + 3]


def at_cells(control):
    """Return the heights of the joined tiles at all cells, row 0 in the north."""
    n = control.shape[1] - 3
    along = basis_matrix(uniform_knots(0, n, 3), 3, (np.arange(500) + 0.5) * n / 500)[0]
    return (along @ control @ along.T)[::-1]


def without(world, void, *layers):
    """Return the world without the heights of some cells."""
    return replace(world, **{name: np.where(void, np.nan, getattr(world, name)) for name in layers})


def away_from_one_fit(world, monkeypatch):
    """Return the differences from one fit of all tiles, at cells (m)."""
    tiles = joined(fit_tiles(world))
    return np.abs(at_cells(tiles) - at_cells(fit_together(world, monkeypatch)))


@pytest.mark.slow
@pytest.mark.parametrize("stratum", ["urban", "rural"])
def test_tiles_equal_one_fit_of_all(monkeypatch, stratum):
    world = made_world(stratum)
    off = away_from_one_fit(world, monkeypatch)
    on_road = off[world.reference_road[world.grid.window(ALL)]]
    assert on_road.mean() < 0.5e-3
    assert np.percentile(on_road, 99) < 5e-3
    assert off.mean() < 0.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("stratum", ["urban", "rural"])
def test_void_on_corner_is_bridged_as_by_one_fit_of_all(monkeypatch, stratum):
    world, void = made_world(stratum), np.hypot(EAST, NORTH) < 70
    off = away_from_one_fit(without(world, void, "dsm", "dtm"), monkeypatch)
    void = void[world.grid.window(ALL)]
    assert off[void].max() < 0.010
    assert off[~void].mean() < 0.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("stratum", ["urban", "rural"])
def test_tile_within_borders_equals_literal_fit(monkeypatch, stratum):
    world, tile = made_world(stratum), NORTH_WEST
    data, _, clusters = filtered(world, tile.buffered(50), tile)

    def heights():
        surface = smoothing_spline.fit(data, clusters, OPTIONS, frame_of(world, tile))
        return surface.lattice(tile.eastings, tile.northings)

    ours = heights()
    monkeypatch.setattr(smoothing_spline, "_minimum", exact_fit.minimum)
    assert np.abs(heights() - ours).max() < 1e-3


@pytest.mark.parametrize("steps", [False, True])
def test_neighbours_meet_exactly(steps):
    surfaces = fit_tiles(made_world("rural"), options=smoothing_spline.Options(steps=steps))
    along = np.random.default_rng(0).uniform(0, 250, 500)
    for one, other, x, y in (
        ((0, 0), (1, 0), np.full(500, 500250.0), 5600000 + along),
        ((0, 1), (1, 1), np.full(500, 500250.0), 5600250 + along),
        ((0, 0), (0, 1), 500000 + along, np.full(500, 5600250.0)),
        ((0, 0), (1, 1), np.array([500250.0]), np.array([5600250.0])),
    ):
        a, b = surfaces[one], surfaces[other]
        np.testing.assert_array_equal(a.height(x, y), b.height(x, y))
        np.testing.assert_array_equal(a.normal(x, y), b.normal(x, y))


def test_change_beyond_reach_leaves_border_unchanged():
    """1 m of change 30 m beyond the eastern edge: the tile's own border is fitted up to 25 m."""
    world = made_world("rural")
    changed = replace(world, dtm=world.dtm.copy())
    changed.dtm[:, world.grid.cells(np.array([500280.5]), np.array([5600000.5]))[1][0] :] += 1.0
    one, other = (frame_of(each, SOUTH_WEST).control((73, 73)).tobytes() for each in (world, changed))
    assert one == other


def viaduct(height_m=8.0):
    """A deck over a valley, 300 m long and across the border between two tiles; the DTM has the valley."""
    road = np.abs(NORTH + 125) < 6
    valley = height_m * np.clip((150 - np.abs(EAST)) / 40, 0, 1)
    rng = np.random.default_rng(0)
    dtm = 200 - valley + rng.normal(0, 0.02, EAST.shape)
    dsm = np.where(road, 200 + rng.normal(0, 0.02, EAST.shape), dtm)
    return TileData("viaduct", WORLD, ALL, dsm, dtm, road)


def test_viaduct_across_border_is_kept():
    surfaces = fit_tiles(viaduct())
    deck = np.arange(500110, 500400, 0.5)
    for east in (deck[deck <= 500250], deck[deck >= 500250]):
        tile = surfaces[0 if east[0] < 500250 else 1, 0]
        assert np.abs(tile.height(east, np.full(east.size, 5600125.0)) - 200).max() < 0.1


def with_random_voids(world, seed):
    """Return the world with round voids of 2 to 60 m radius, in the DTM or in both models."""
    circles = np.random.default_rng(seed).uniform((-250, -250, 2), (250, 250, 60), (12, 3))
    void = np.any([np.hypot(EAST - x, NORTH - y) < radius for x, y, radius in circles], axis=0)
    return without(world, void, "dtm", *["dsm"] * (seed % 2))


@pytest.mark.parametrize("seed", range(2))
def test_reach_equals_distance_to_farthest_ground(seed):
    world = with_random_voids(made_world("urban"), seed)
    lattice = smoothing_spline._lattice((250, 250), 1.0, OPTIONS)
    reaches = set()
    for border in border_of(NORTH_WEST, AROUND_M):
        data, _, clusters = filtered(world, border.grid)
        missing = np.isnan(ground_to_fit(data, clusters))
        away = border.along(scipy.ndimage.distance_transform_edt(missing)).max()
        enough = [lines for lines in (7, 14, 28) if lines * 250 / 70 >= 15 + away]
        lines = smoothing_spline._lines(data, clusters, border, lattice)
        assert lines == 2 * (min(enough, default=28),)
        reaches.add(lines)
    assert len(reaches) > 1


def test_part_with_dtm_checked_near_border_equals_that_of_complete_filter(monkeypatch):
    chain = {
        "load": load.Options(halo_m=50),
        "segment": mask.Options(),
        "ecsrc": FILTER,
        "fit": OPTIONS,
    }
    stages = BorderStages.of(chain)
    worlds = [made_world("urban"), with_random_voids(made_world("urban"), 1)]
    near = [stages.frame(world, NORTH_WEST) for world in worlds]
    monkeypatch.setattr(
        BorderStages, "_filtered", lambda _, data, road, near: planar.ecsrc(data, road, FILTER)
    )
    for world, frame in zip(worlds, near, strict=True):
        complete = stages.frame(world, NORTH_WEST)
        for field in fields(Frame):
            parts = (getattr(result, field.name) for result in (frame, complete))
            assert len({encode(result, {}, (), "") for result in parts}) == 1


def test_border_without_ground_is_left_free():
    world = made_world("rural")
    nothing = without(world, True, "dsm", "dtm")
    frame = frame_of(nothing, SOUTH_WEST)
    assert np.isnan(frame.control((73, 73))).all()
    assert not frame.south.inside.any()
    data, _, clusters = filtered(world, SOUTH_WEST)
    alone, free = (smoothing_spline.fit(data, clusters, OPTIONS, f) for f in (None, frame))
    np.testing.assert_array_equal(free.A, alone.A)


def test_corner_with_little_ground_is_fitted():
    """The corner must not be left to each tile."""
    world = made_world("rural")
    away, road = np.maximum(np.abs(EAST), np.abs(NORTH)), world.road_mask
    without_road = replace(world, road_mask=np.zeros_like(road))
    road_alone = replace(without(world, True, "dtm"), road_mask=np.ones_like(road))
    # Three intervals of 27.8 m would end before the ground, which begins 97 m away.
    far = replace(without(world, away < 97, "dsm", "dtm"), road_mask=road & (away >= 97))
    wide = {"spacing_m": 30.0}
    for given, changes in ((without_road, {}), (road_alone, {}), (far, wide)):
        assert np.isfinite(north_east_corner(given, OPTIONS.model_copy(update=changes))).all()
    # Tiles bridge ground that has only a DSM.
    dsm_alone = replace(without(world, away < 120, "dtm"), road_mask=road & (away >= 120))
    control = north_east_corner(dsm_alone)
    middle = world.grid.cells(np.array([500250.0]), np.array([5600250.0]))
    np.testing.assert_allclose(control, world.dsm[middle][0], atol=5)


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 4])
def test_borders_of_other_degrees_meet(degree):
    world = made_world("rural")
    options = OPTIONS.model_copy(update={"degree": degree, "spacing_m": 6.0})
    surfaces = []
    for tile in (SOUTH_WEST, replace(SOUTH_WEST, west=500250)):
        data, _, clusters = filtered(world, tile)
        surfaces.append(smoothing_spline.fit(data, clusters, options, frame_of(world, tile, options)))
    x, y = np.full(100, 500250.0), np.linspace(5600000, 5600250, 100)
    np.testing.assert_array_equal(surfaces[0].height(x, y), surfaces[1].height(x, y))
    np.testing.assert_array_equal(surfaces[0].normal(x, y), surfaces[1].normal(x, y))
