from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog import Grid
from flexroad.tasks import TaskError
from flexroad.tools.prepare.points.to_rasters import Options
from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.network import STRATA, Plan, stratum_at
from flexroad.tools.synthetic.scene import DECK, GROUND, scan, true_height
from tests.make_clouds import rasterise

CLEAN = SceneOptions(density=0, mask_errors=0, dsm_noise_m=(0, 0), dtm_noise_m=0)
SILENT = SceneOptions(dsm_noise_m=(0, 0))
SURFACE = (Kind.GROUND, Kind.DECK)
GRID = Grid("EPSG:25832", 500000, 5600100, 1.0, 100, 100)


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


def test_block_of_no_tiles_is_empty():
    assert block(0) == []


def test_make_scene_depends_on_seed():
    first, same, other = (make_scene(block(1)[0][1], seed) for seed in (5, 5, 6))
    for name, layer in first.layers.items():
        assert np.array_equal(layer, same.layers[name])
        assert not np.array_equal(layer, other.layers[name])
    assert np.array_equal(first.kind, same.kind)


def test_true_height_equals_reference_of_scene():
    grid, options = Grid("EPSG:32632", 500_000, 5_600_060, 1.0, 60, 60), SceneOptions(slope=0.1)
    scene = make_scene(grid, 3, "urban", options)
    np.testing.assert_array_equal(true_height(grid, 3, "urban", options), scene.reference)


@pytest.mark.parametrize("seed", [1, 3])
def test_make_scene_neighbouring_tiles_join(seed):
    """A tile twice as wide equals the two tiles: no step, no house cut in two."""
    (_, west), (_, east), *_ = block(4)
    both = make_scene(Grid(west.crs, west.west, west.north, 1.0, 500, 250), seed, options=SILENT)
    for half, tile in ((slice(0, 250), west), (slice(250, 500), east)):
        part = make_scene(tile, seed, options=SILENT)
        # Depth of streams and edges of roads may differ by rounding of coordinates.
        assert np.mean(np.abs(part.reference - both.reference[:, half]) > 1e-6) < 1e-4
        assert np.mean(part.reference_road != both.reference_road[:, half]) < 1e-4
        assert np.mean(part.road_mask != both.road_mask[:, half]) < 1e-4
        for kind in (Kind.BUILDING, Kind.PARKED_CAR):
            visible = part.kind != Kind.CROWN, both.kind[:, half] != Kind.CROWN
            differs = (part.kind == kind) != (both.kind[:, half] == kind)
            assert np.mean(differs & visible[0] & visible[1]) < 1e-4


def test_make_scene_truth_does_not_depend_on_cell_size():
    _, fine = block(1, size_m=240)[0]
    coarse = Grid(
        fine.crs, fine.west, fine.north, 3.0, 80, 80
    )  # its centres are also centres of the fine grid
    fine_scene, coarse_scene = (make_scene(grid, 2, "urban", CLEAN) for grid in (fine, coarse))
    assert np.allclose(fine_scene.reference[1::3, 1::3], coarse_scene.reference, atol=1e-6)
    assert np.array_equal(fine_scene.reference_road[1::3, 1::3], coarse_scene.reference_road)


def test_make_scene_without_spoilers_survey_equals_truth():
    clean = scene(3, "urban", CLEAN)
    assert np.array_equal(clean.dsm, clean.reference)
    assert np.array_equal(clean.road_mask, clean.reference_road)
    assert set(np.unique(clean.kind)) <= set(SURFACE)


@pytest.mark.parametrize("stratum", STRATA)
def test_make_scene_spoilers_only_raise_and_have_a_kind(stratum):
    made = scene(1, stratum)
    spoiled = ~np.isin(made.kind, SURFACE)
    assert np.array_equal(made.dsm[~spoiled], made.reference[~spoiled])
    assert (made.dsm[spoiled] > made.reference[spoiled]).all()
    on_road = made.kind[made.reference_road]
    assert not (on_road == Kind.BUILDING).any()
    assert (on_road == Kind.CROWN).any()
    cars = np.isin(made.kind, (Kind.PARKED_CAR, Kind.MOVING_CAR))
    assert (made.dsm - made.reference)[cars].max() < 3.5


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


@pytest.mark.parametrize(("stratum", "least", "most"), [("urban", 0.14, 0.27), ("rural", 0.05, 0.16)])
def test_make_scene_road_share_and_relief_match_real_tiles(stratum, least, most):
    made = [scene(seed, stratum, tile=tile) for seed in (0, 1) for tile in (0, 3)]
    for part in made:
        assert least < part.reference_road.mean() < most
        assert 15 < np.ptp(part.dsm) < 80
    overlap = [(s.road_mask & s.reference_road).sum() / (s.road_mask | s.reference_road).sum() for s in made]
    assert 0.75 < min(overlap) <= max(overlap) < 0.97


def test_make_scene_small_tile_with_small_blocks_has_streets():
    _, grid = block(1, size_m=40)[0]
    for seed in range(10):
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


def test_make_scene_invalid_arguments_raise():
    grid = block(1)[0][1]
    with pytest.raises(TaskError, match="'city'; there are urban, suburban, rural"):
        make_scene(grid, 0, "city")
    with pytest.raises(TaskError, match="-1"):
        make_scene(grid, -1)


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
