from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexroad.catalog import CatalogError, Grid
from flexroad.tasks import TaskError
from flexroad.tasks.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tasks.synthetic.network import Plan
from flexroad.tasks.synthetic.strata import STRATA, stratum_at

CLEAN = SceneOptions(density=0, mask_errors=0, dsm_noise_m=(0, 0), dtm_noise_m=0)
SILENT = SceneOptions(dsm_noise_m=(0, 0))
SURFACE = (Kind.GROUND, Kind.DECK)


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


def test_block_takes_other_cells_and_refuses_those_that_do_not_fit():
    (_, grid), *_ = block(1, size_m=40, cell=0.5)
    assert grid.shape == (80, 80)
    with pytest.raises(CatalogError, match="whole number"):
        block(1, size_m=40, cell=0.3)
    assert block(0) == []


def test_a_scene_is_a_function_of_seed_and_place():
    one, again, other = (make_scene(block(1)[0][1], seed) for seed in (5, 5, 6))
    for name, layer in one.layers.items():
        assert np.array_equal(layer, again.layers[name])
        assert not np.array_equal(layer, other.layers[name])
    assert np.array_equal(one.kind, again.kind)


@pytest.mark.parametrize("seed", [1, 3])
def test_tiles_join(seed):
    """A tile twice as wide shows what the two tiles show: no step, no house cut in two."""
    (_, west), (_, east), *_ = block(4)
    both = make_scene(Grid(west.crs, west.west, west.north, 1.0, 500, 250), seed, options=SILENT)
    for half, tile in ((slice(0, 250), west), (slice(250, 500), east)):
        part = make_scene(tile, seed, options=SILENT)
        # Depth of streams and edges of roads may turn with the last bit of a coordinate.
        assert np.mean(np.abs(part.reference - both.reference[:, half]) > 1e-6) < 1e-4
        assert np.mean(part.reference_road != both.reference_road[:, half]) < 1e-4
        assert np.mean(part.road_mask != both.road_mask[:, half]) < 1e-4
        for kind in (Kind.BUILDING, Kind.PARKED_CAR):
            shown = part.kind != Kind.CROWN, both.kind[:, half] != Kind.CROWN
            differs = (part.kind == kind) != (both.kind[:, half] == kind)
            assert np.mean(differs & shown[0] & shown[1]) < 1e-4


def test_the_truth_does_not_depend_on_the_cell_size():
    _, fine = block(1, size_m=240)[0]
    coarse = Grid(fine.crs, fine.west, fine.north, 3.0, 80, 80)  # centres are centres of the fine grid
    one, three = (make_scene(grid, 2, "urban", CLEAN) for grid in (fine, coarse))
    assert np.allclose(one.reference[1::3, 1::3], three.reference, atol=1e-6)
    assert np.array_equal(one.reference_road[1::3, 1::3], three.reference_road)


def test_without_spoilers_survey_and_truth_agree():
    clean = scene(3, "urban", CLEAN)
    assert np.array_equal(clean.dsm, clean.reference)
    assert np.array_equal(clean.road_mask, clean.reference_road)
    assert set(np.unique(clean.kind)) <= set(SURFACE)


@pytest.mark.parametrize("stratum", STRATA)
def test_spoilers_only_raise_and_are_labelled(stratum):
    made = scene(1, stratum)
    spoiled = ~np.isin(made.kind, SURFACE)
    assert np.array_equal(made.dsm[~spoiled], made.reference[~spoiled])
    assert (made.dsm[spoiled] > made.reference[spoiled]).all()
    on_road = made.kind[made.reference_road]
    assert not (on_road == Kind.BUILDING).any()
    assert (on_road == Kind.CROWN).any()
    cars = np.isin(made.kind, (Kind.PARKED_CAR, Kind.MOVING_CAR))
    assert (made.dsm - made.reference)[cars].max() < 3.5


def test_noise_is_as_strong_as_asked():
    noisy = scene(1, "rural", SceneOptions(density=0, dsm_noise_m=(0.07, 0.07), dtm_noise_m=0.04))
    assert np.std(noisy.dsm - noisy.reference) == pytest.approx(0.07, rel=0.02)
    quiet = scene(1, "rural", SceneOptions(density=0, dtm_noise_m=0))
    # Correlated over metres: fewer independent values than cells, so a wider tolerance.
    assert np.std(noisy.dtm - quiet.dtm) == pytest.approx(0.04, rel=0.1)


def test_streets_cross_streams_on_bridges_the_terrain_model_lacks():
    made = scene(3, "urban", SceneOptions(density=0, stream_share=1, dsm_noise_m=(0, 0), dtm_noise_m=0))
    deck = made.kind == Kind.DECK
    assert deck.sum() > 100
    assert np.array_equal(made.dsm[deck], made.reference[deck])
    assert np.max((made.reference - made.dtm)[deck]) > 4
    elsewhere = np.abs(made.reference - made.dtm)[made.reference_road & ~deck]
    assert np.percentile(elsewhere, 95) < 0.05


@pytest.mark.parametrize("seed", range(4))
def test_streets_are_graded(seed):
    """No kerb, no crossing and no humps make a step: steep as the hills may be, streets rise evenly."""
    hilly = CLEAN.model_copy(update={"slope": 0.08, "roughness_m": 1.5})
    made = scene(seed, "urban", hilly)
    road = made.reference_road
    along_columns = np.abs(np.diff(made.reference, axis=0))[road[1:] & road[:-1]]
    along_rows = np.abs(np.diff(made.reference, axis=1))[road[:, 1:] & road[:, :-1]]
    rises = np.concatenate([along_columns, along_rows])
    assert rises.max() < 3 * hilly.slope
    assert np.percentile(rises, 99) < 2 * hilly.slope


@pytest.mark.parametrize(("stratum", "least", "most"), [("urban", 0.14, 0.27), ("rural", 0.05, 0.16)])
def test_road_share_and_relief_are_those_of_real_tiles(stratum, least, most):
    made = [scene(seed, stratum, tile=tile) for seed in (0, 1) for tile in (0, 3)]
    for one in made:
        assert least < one.reference_road.mean() < most
        assert 15 < np.ptp(one.dsm) < 80
    overlap = [(s.road_mask & s.reference_road).sum() / (s.road_mask | s.reference_road).sum() for s in made]
    assert 0.75 < min(overlap) <= max(overlap) < 0.97


def test_a_small_tile_has_streets_when_blocks_are_small():
    _, grid = block(1, size_m=40)[0]
    for seed in range(10):
        road = make_scene(grid, seed, options=SceneOptions(block_m=30)).road_mask
        assert 0.1 < road.mean() < 0.9


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.floats(-25, 25), st.floats(0, 1))
def test_distance_to_a_street_is_that_to_its_nearest_point(seed, lateral, part):
    plan = Plan(seed, 100.0, 0.0, "urban")
    for street in plan.streets((0.0, 0.0, 100.0, 100.0)):
        x, y = street.point(street.start + part * (street.end - street.start), lateral)
        along, distance = street.foot(np.atleast_1d(x), np.atleast_1d(y))
        dense = np.linspace(street.start, street.end, 20_001)
        everywhere = np.hypot(*(np.array(street.point(dense, 0.0)) - np.array([[x], [y]])))
        nearest = everywhere.argmin()
        assert distance[0] == pytest.approx(everywhere[nearest], abs=0.02)
        assert along[0] == pytest.approx(dense[nearest], abs=0.5)


def test_side_streets_start_at_main_streets():
    for street in Plan(4, 100.0, 0.0, "suburban").streets((0.0, 0.0, 2000.0, 2000.0)):
        _, line, piece = street.key
        assert line % 2 == 0 or piece % 2 == 0 or (piece + 1) % 2 == 0
        assert street.end > street.start


def test_districts_mix_in_the_paper_s_shares():
    names = [stratum_at(0, 250 * i + 125, 250 * j + 125).name for i in range(45) for j in range(45)]
    for name, tiles in (("urban", 168), ("suburban", 23), ("rural", 49)):
        assert names.count(name) / len(names) == pytest.approx(tiles / 240, abs=0.03)
    corner, opposite = (stratum_at(0, 500_000 + d, 5_600_000 + d) for d in (0.5, 249.5))
    assert corner is opposite


def test_what_cannot_be_made_is_refused():
    grid = block(1)[0][1]
    with pytest.raises(TaskError, match="'city'; known are urban, suburban, rural"):
        make_scene(grid, 0, "city")
    with pytest.raises(TaskError, match="-1"):
        make_scene(grid, -1)
