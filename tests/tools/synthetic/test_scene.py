from functools import lru_cache

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog import Grid
from flexroad.tasks import TaskError
from flexroad.tasks.roads.rasterise import cells
from flexroad.tools.prepare.points.to_rasters import Options
from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.crossings import make_crossings
from flexroad.tools.synthetic.gerod import PRESET
from flexroad.tools.synthetic.network import Plan, stratum_at
from flexroad.tools.synthetic.scene import DECK, GROUND, centre_lines, scan, true_height
from tests.make_clouds import rasterise

CLEAN = SceneOptions(density=0, mask_errors=0, dsm_noise_m=(0, 0), dtm_noise_m=0)
SILENT = SceneOptions(dsm_noise_m=(0, 0))
SURFACE = (Kind.GROUND, Kind.DECK)
GRID = Grid("EPSG:25832", 500000, 5600100, 1.0, 100, 100)
LARGE = Grid("EPSG:25832", 295500, 5629500, 1.0, 200, 200)


@lru_cache
def scene(seed: int, stratum: str | None = None, options: SceneOptions = SILENT, tile: int = 0) -> Scene:
    return make_scene(block(4)[tile][1], seed, stratum, options)


def test_block_is_near_square_and_on_the_absolute_grid():
    tiles = block(7)
    assert [name for name, _ in tiles[:4]] == [
        "500000_5600000",
        "500250_5600000",
        "500500_5600000",
        "500000_5600250",
    ]
    assert len(tiles) == len({grid for _, grid in tiles}) == 7
    assert all(grid.shape == (250, 250) for _, grid in tiles)


def test_make_scene_depends_on_seed():
    grid, options = block(1)[0][1], PRESET["urban"]
    first, same, other = (make_scene(grid, seed, "urban", options) for seed in (5, 5, 6))
    for name in (*first.layers, "extended_dtm", "kind"):
        layer, again, changed = (getattr(scene, name) for scene in (first, same, other))
        assert np.array_equal(layer, again, equal_nan=True), name
        assert not np.array_equal(layer, changed, equal_nan=True), name


def test_true_height_equals_reference_of_scene():
    grid, options = Grid("EPSG:32632", 500_000, 5_600_060, 1.0, 60, 60), SceneOptions(slope=0.1)
    scene = make_scene(grid, 3, "urban", options)
    np.testing.assert_array_equal(true_height(grid, 3, "urban", options), scene.reference)


def test_make_scene_without_spoilers_survey_equals_truth():
    clean = scene(3, "urban", CLEAN)
    assert np.array_equal(clean.dsm, clean.reference)
    assert np.array_equal(clean.road_mask, clean.reference_road)
    assert set(np.unique(clean.kind)) <= set(SURFACE)


def test_make_scene_noise_has_given_deviation():
    noisy = scene(1, "rural", SceneOptions(density=0, dsm_noise_m=(0.07, 0.07), dtm_noise_m=0.04))
    assert np.std(noisy.dsm - noisy.reference) == pytest.approx(0.07, rel=0.02)
    quiet = scene(1, "rural", SceneOptions(density=0, dtm_noise_m=0))
    # The noise is correlated, so there are fewer independent values and the tolerance is wider.
    assert np.std(noisy.dtm - quiet.dtm) == pytest.approx(0.04, rel=0.1)


def test_make_scene_bridges_are_in_dsm_and_not_in_dtm():
    made = scene(3, "urban", SceneOptions(density=0, stream_share=1, dsm_noise_m=(0, 0), dtm_noise_m=0))
    deck = made.kind == Kind.DECK
    assert deck.sum() > 100
    assert np.array_equal(made.dsm[deck], made.reference[deck])
    assert np.max((made.reference - made.dtm)[deck]) > 4
    elsewhere = np.abs(made.reference - made.dtm)[made.reference_road & ~deck]
    assert np.percentile(elsewhere, 95) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_make_scene_streets_have_no_steps(seed):
    """Kerbs, crossings and humps cause no step, even in steep hills."""
    hilly = CLEAN.model_copy(update={"slope": 0.08, "roughness_m": 1.5})
    made = scene(seed, "urban", hilly)
    road = made.reference_road
    along_columns = np.abs(np.diff(made.reference, axis=0))[road[1:] & road[:-1]]
    along_rows = np.abs(np.diff(made.reference, axis=1))[road[:, 1:] & road[:, :-1]]
    rises = np.concatenate([along_columns, along_rows])
    assert rises.max() < 3 * hilly.slope
    assert np.percentile(rises, 99) < 2 * hilly.slope


def test_make_scene_small_tile_with_small_blocks_has_streets():
    _, grid = block(1, size_m=40)[0]
    for seed in range(4):
        road = make_scene(grid, seed, options=SceneOptions(block_m=30)).road_mask
        assert 0.1 < road.mean() < 0.9


@settings(max_examples=30)
@given(st.integers(0, 10**6), st.floats(-25, 25), st.floats(0, 1))
def test_street_foot_is_nearest_point_of_centre_line(seed, lateral, part):
    plan = Plan(seed, 100.0, 0.0, "urban")
    for street in plan.streets((0.0, 0.0, 100.0, 100.0)):
        x, y = street.point(street.start + part * (street.end - street.start), lateral)
        along, distance = street.foot(np.atleast_1d(x), np.atleast_1d(y))
        dense = np.linspace(street.start, street.end, 20_001)
        everywhere = np.hypot(*(np.array(street.point(dense, 0.0)) - np.array([[x], [y]])))
        nearest = everywhere.argmin()
        assert distance[0] == pytest.approx(everywhere[nearest], abs=0.02)
        assert along[0] == pytest.approx(dense[nearest], abs=0.5)


def test_plan_side_streets_start_at_main_streets():
    for street in Plan(4, 100.0, 0.0, "suburban").streets((0.0, 0.0, 2000.0, 2000.0)):
        _, line, piece = street.key
        assert line % 2 == 0 or piece % 2 == 0 or (piece + 1) % 2 == 0
        assert street.end > street.start


def test_stratum_at_districts_have_shares_of_paper():
    names = [stratum_at(0, 250 * i + 125, 250 * j + 125).name for i in range(45) for j in range(45)]
    for name, tiles in (("urban", 168), ("suburban", 23), ("rural", 49)):
        assert names.count(name) / len(names) == pytest.approx(tiles / 240, abs=0.03)
    corner, opposite = (stratum_at(0, 500_000 + d, 5_600_000 + d) for d in (0.5, 249.5))
    assert corner is opposite


@pytest.mark.parametrize("make", [make_scene, make_crossings])
def test_scene_of_a_negative_seed_or_an_unknown_stratum_raises(make):
    with pytest.raises(TaskError, match="a seed is 0 or more, not -1"):
        make(GRID, -1)
    with pytest.raises(TaskError, match="'city'; there are urban, suburban, rural"):
        make_scene(GRID, 0, "city")


@pytest.mark.parametrize(
    ("stratum", "options"),
    [
        (None, SceneOptions()),
        ("urban", SceneOptions(medians=1.0, roundabouts=1.0)),
        ("rural", SceneOptions(sunken_share=1.0, stream_share=0.0)),
    ],
)
def test_centre_lines_buffered_by_width_cover_true_roads(stratum, options):
    lines = centre_lines(LARGE, 3, stratum, options)
    half = np.array([line.width_m for line in lines]) / 2
    road = cells(shapely.buffer([shapely.LineString(line.points) for line in lines], half), LARGE)
    truth = make_scene(LARGE, 3, stratum, options).reference_road
    # The ends of medians and the islands of roundabouts are not represented.
    assert (road & truth).sum() / (road | truth).sum() > 0.93


def test_scan_has_density_noise_and_classes_of_scene():
    scene = make_scene(GRID, 3, "suburban", SceneOptions(dsm_noise_m=(0.0, 0.0), stream_share=1.0))
    points = scan(scene, per_m2=20, noise_m=0.03)
    assert len(points) == 20 * 100 * 100
    rasters = rasterise(points, GRID, Options(dtm="mean"), None)
    bare = np.isfinite(rasters.dtm) & rasters.ground & (np.abs(scene.dtm - scene.reference) < 0.3)
    off = (rasters.dtm - scene.reference)[bare]
    assert abs(off.mean()) < 0.005
    assert np.median(np.abs(rasters.dsm - scene.dsm - 0.055)) < 0.03
    assert {GROUND, DECK} <= set(np.unique(points.kind))
    assert np.array_equal(scan(scene, 20, 0.03).height, points.height)
    assert not np.array_equal(scan(scene, 20, 0.03, seed=1).height, points.height)
