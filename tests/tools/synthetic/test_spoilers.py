"""Each option of the spoilers and of the road mask changes what it describes, and nothing else."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt, label, maximum_filter, minimum_filter

from flexroad.catalog import Grid
from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.gerod import PRESET, survey
from flexroad.tools.synthetic.network import Plan
from flexroad.tools.synthetic.population import rails, wires
from flexroad.tools.synthetic.spoilers import BARE
from flexroad.tools.synthetic.surfaces import CIRCLE_M, ISLAND_M

GRID = block(1)[0][1]
QUIET = {"dsm_noise_m": (0, 0), "dtm_noise_m": 0, "flight_offset_m": 0}
INNER = np.s_[25:-25, 25:-25]
"""Cells whose neighbourhood lies on the tile."""
EMPTY = {**QUIET, "density": 0, "mask_errors": 0, "stream_share": 0}


@lru_cache
def made(base: str = "empty", seed: int = 2, stratum: str = "urban", **options: float) -> Scene:
    defaults = EMPTY if base == "empty" else QUIET
    return make_scene(GRID, seed, stratum, SceneOptions(**{**defaults, **options}))


@pytest.mark.parametrize("stratum", PRESET)
def test_all_spoilers_truth_does_not_depend_on_cell_size(stratum):
    fine = Grid(GRID.crs, GRID.west, GRID.north, 1.0, 240, 240)
    # The centres of the coarse cells are also centres of the fine grid.
    coarse = Grid(GRID.crs, GRID.west, GRID.north, 3.0, 80, 80)
    fine_scene, coarse_scene = (make_scene(grid, 3, stratum, PRESET[stratum]) for grid in (fine, coarse))
    assert np.allclose(fine_scene.reference[1::3, 1::3], coarse_scene.reference, atol=1e-6)
    assert np.array_equal(fine_scene.reference_road[1::3, 1::3], coarse_scene.reference_road)


@pytest.mark.parametrize("stratum", PRESET)
def test_all_spoilers_only_raise_and_have_a_kind(stratum):
    options = PRESET[stratum].model_copy(update={**QUIET, "rails": 0.5, "wires": 1, "car_parks": 0.5})
    scene = make_scene(GRID, 5, stratum, options)
    void = np.isnan(scene.dsm)
    bare = np.isin(scene.kind, BARE) & ~void
    assert np.array_equal(scene.dsm[bare], scene.reference[bare])
    assert (scene.dsm >= scene.reference)[~void].all()
    assert 0 < void.mean() < 0.1
    assert {Kind.PLANTS, Kind.WIRE, Kind.RAIL, Kind.MIXED} <= set(np.unique(scene.kind).tolist())
    on_road = scene.kind[scene.reference_road]
    assert not (on_road == Kind.BUILDING).any()
    assert (on_road == Kind.CROWN).any()


@pytest.mark.parametrize("stratum", PRESET)
def test_cars_are_low(stratum):
    scene = made("quiet", 1, stratum)
    cars = np.isin(scene.kind, (Kind.PARKED_CAR, Kind.MOVING_CAR))
    assert 0 < (scene.dsm - scene.reference)[cars].max() < 3.5


def test_neighbouring_tiles_join():
    """A tile twice as wide equals the two tiles: no step, no house cut in two."""
    options = PRESET["urban"].model_copy(update=QUIET)
    both = make_scene(Grid(GRID.crs, GRID.west, GRID.north, 1.0, 500, 250), 4, "urban", options)
    for half, tile in ((slice(0, 250), GRID), (slice(250, 500), block(2)[1][1])):
        part = make_scene(tile, 4, "urban", options)
        # Depth of streams and edges of roads may differ by rounding of coordinates.
        assert np.mean(np.abs(part.reference - both.reference[:, half]) > 1e-6) < 1e-4
        assert np.mean(np.abs(part.dtm - both.dtm[:, half]) > 1e-3) < 1e-3
        assert np.mean(part.reference_road != both.reference_road[:, half]) < 1e-4
        assert np.mean(part.road_mask != both.road_mask[:, half]) < 1e-4
        crown = (part.kind == Kind.CROWN) | (both.kind[:, half] == Kind.CROWN)
        for kind in (Kind.BUILDING, Kind.PARKED_CAR):
            differs = (part.kind == kind) != (both.kind[:, half] == kind)
            assert np.mean(differs & ~crown) < 1e-4


def test_curb_raises_pavement_only():
    flat, curbed = made(), made(curb_m=0.12)
    lift = curbed.reference - flat.reference
    away = distance_transform_edt(~flat.reference_road)
    assert np.abs(lift[flat.reference_road]).max() == 0
    assert np.allclose(lift[(away > 1.5) & (away < 2)], 0.12)
    assert np.abs(lift[INNER][away[INNER] > 6]).max() < 1e-9
    assert np.array_equal(flat.reference_road, curbed.reference_road)


def test_embankment_changes_streets_only():
    level, banked = made(), made(embankment_m=2)
    lift = banked.reference - level.reference
    away = distance_transform_edt(~level.reference_road)
    assert 0.5 < np.sqrt(np.mean(lift[level.reference_road] ** 2)) < 5
    assert np.abs(lift[INNER][away[INNER] > 13]).max() < 1e-9
    steps = np.abs(np.diff(lift, axis=0))[level.reference_road[1:] & level.reference_road[:-1]]
    assert steps.max() < 0.3


@pytest.mark.parametrize("seed", range(4))
def test_cross_slope_has_no_step(seed):
    """No step where streets meet, or at a dead end, where the two sides differ most."""
    level, leaning = (made(seed=seed, stratum="rural", cross_slope=slope) for slope in (0, 0.08))
    lift = leaning.reference - level.reference
    assert np.abs(lift).max() > 0.05
    for axis in (0, 1):
        assert np.abs(np.diff(lift, axis=axis)).max() < 0.25


def test_median_is_no_road():
    single, dual = made(), made(medians=1)
    assert dual.reference_road.sum() > single.reference_road.sum()
    strips = made(medians=1).reference_road < binary_dilation(dual.reference_road, iterations=2)
    inside = strips & (distance_transform_edt(~single.reference_road) == 0)
    assert inside.sum() > 200


def test_roundabout_has_ring_and_island():
    plan = Plan(2, 100.0, 0.0, "urban", roundabouts=1)
    scene = made(roundabouts=1)
    x, y = plan.from_map(*np.meshgrid(GRID.eastings, GRID.northings))
    island_cells = 0
    box = (x.min(), y.min(), x.max(), y.max())
    for cx, cy in plan.circles(box, 0):
        away = np.hypot(x - cx, y - cy)
        island_cells += (away < ISLAND_M).sum()
        assert not scene.reference_road[away < ISLAND_M].any()
        assert scene.reference_road[(away > ISLAND_M) & (away < CIRCLE_M)].all()
    assert island_cells > 100


def test_sunken_road_is_crossed_on_bridges():
    scene = made(sunken_share=1)
    deck = scene.kind == Kind.DECK
    over = scene.reference - scene.dtm
    assert deck.sum() > 50
    assert over[deck].max() > 4
    # The sunken road continues on both sides of the bridge, 5 m below.
    without = made()
    below = scene.reference_road & ~without.reference_road & ~deck
    assert below.sum() > 200
    assert np.median((without.reference - scene.reference)[below]) > 3.5


def test_rails_and_wires_are_thin_and_have_their_height():
    railed, wired = made(density=1, rails=1, trees=0), made(density=1, wires=1, trees=0)
    height = railed.dsm - railed.reference
    rail, wire = railed.kind == Kind.RAIL, wired.kind == Kind.WIRE
    assert rail.sum() > 200
    assert np.median(height[rail]) == pytest.approx(0.8, abs=0.1)
    assert wire.sum() > 50
    assert 5 < np.median((wired.dsm - wired.reference)[wire]) < 8
    # No wider than two cells anywhere.
    assert not minimum_filter(rail, 3).any()


def test_mixed_cells_lie_between_foot_and_top():
    sharp, mixed = made("quiet"), made("quiet", mixed=0.5)
    changed = sharp.dsm != mixed.dsm
    low, high = minimum_filter(sharp.dsm, 3), maximum_filter(sharp.dsm, 3)
    assert changed.sum() > 500
    assert (mixed.dsm >= sharp.reference).all()
    assert (mixed.dsm <= high + 1e-9)[INNER].all()
    assert np.mean(changed[high - low > 1.5]) == pytest.approx(0.5, abs=0.05)
    assert not changed[INNER][(high - low)[INNER] < 1.5].any()


def test_growth_is_off_the_road():
    scene = made("quiet", stratum="rural", growth_m=0.6)
    plants = scene.kind == Kind.PLANTS
    assert plants.mean() > 0.1
    assert not (plants & scene.reference_road).any()
    assert 0.1 < np.mean((scene.dsm - scene.reference)[plants]) < 0.6


def test_scars_are_under_houses_only():
    whole, scarred = made("quiet"), made("quiet", scars_m=0.5)
    off = np.abs(scarred.dtm - whole.dtm)
    assert np.array_equal(whole.dsm, scarred.dsm)
    near_houses = binary_dilation(whole.kind == Kind.BUILDING, iterations=9)
    assert off[INNER][~near_houses[INNER]].max() < 1e-3
    assert 0.1 < off[whole.kind == Kind.BUILDING].mean() < 1


def test_car_parks_and_fields_are_partly_in_road_mask():
    parks, fields = made("quiet", car_parks=1), made("quiet", stratum="rural", fields=1)
    for scene, kind in ((parks, Kind.PAVED), (fields, Kind.FIELD)):
        area = scene.kind == kind
        assert area.sum() > 100
        assert not (area & scene.reference_road).any()
        assert scene.road_mask[area].mean() > 0.2
    assert (parks.kind == Kind.PARKED_CAR).sum() > (made("quiet").kind == Kind.PARKED_CAR).sum()


def test_false_roofs_are_in_road_mask():
    right, wrong = made("quiet"), made("quiet", false_roofs=1)
    roofs = right.kind == Kind.BUILDING
    assert right.road_mask[roofs].mean() < 0.1
    assert wrong.road_mask[roofs].mean() > 0.5
    assert np.array_equal(right.dsm, wrong.dsm)


def test_towers_overhang_and_storeys_change_roofs():
    plain = made("quiet", trees=0)
    assert np.max(made("quiet", trees=0, towers=1).dsm - plain.reference) > 25
    eaves = made("quiet", trees=0, overhang_m=1)
    assert (eaves.kind == Kind.BUILDING).sum() > 1.1 * (plain.kind == Kind.BUILDING).sum()
    low = made("quiet", trees=0, storeys=0.5)
    roofs = (plain.kind == Kind.BUILDING) & (low.kind == Kind.BUILDING)
    ratio = np.mean((low.dsm - low.reference)[roofs]) / np.mean((plain.dsm - plain.reference)[roofs])
    assert 0.4 < ratio < 0.75


def test_rails_and_wires_without_streets_are_empty():
    def unused(x, y):
        raise AssertionError("the ground is not needed")

    assert rails([], 0, unused, 1).size == wires([], 0, unused, 1).size == 0


def plain(**options: float) -> Scene:
    return made("quiet", stream_share=0, **options)


def false_road(scene: Scene) -> np.ndarray:
    return scene.road_mask & ~scene.reference_road


def test_benchmark_false_road_is_coherent():
    """Nearly all false cells lie in patches of more than 10 m2, as yards and strips do and noise does not."""
    for _, grid, stratum, options in survey(3, 1):
        scene = make_scene(grid, 1, stratum, options)
        false = false_road(scene)
        patches, count = label(false)
        area = np.bincount(patches.ravel(), minlength=count + 1)[1:]
        assert area[area > 10].sum() > 0.85 * false.sum()
        scattered = np.random.default_rng(0).permutation(false.ravel()).reshape(false.shape)
        sizes = np.bincount(label(scattered)[0].ravel())[1:]
        assert sizes[sizes > 10].sum() < 0.3 * false.sum()


def test_patches_mask_is_constant_on_them():
    mask = plain(patch_m=2).road_mask
    blocks = mask.reshape(125, 2, 125, 2)
    assert (blocks == blocks[:, :1, :, :1]).all()
    both = (mask & plain().road_mask).sum() / (mask | plain().road_mask).sum()
    assert 0.85 < both < 1


def test_perfect_mask_has_no_errors_of_any_kind():
    options = {"patch_m": 2, "verge_m": 3, "yards": 3, "lean": 0.3, "facades": 1, "false_roofs": 1}
    perfect = plain(mask_errors=0, **options)
    assert np.array_equal(perfect.road_mask, perfect.reference_road)


def test_verge_widens_mask_except_on_roofs_and_crowns():
    narrow, wide = plain(), plain(verge_m=3, verge_share=1)
    added = wide.road_mask & ~narrow.road_mask
    away = distance_transform_edt(~wide.reference_road)
    assert added.sum() > 0.3 * wide.reference_road.sum()
    # An edge wobbles by 0.5 m (rms); distances are to cell centres.
    assert np.percentile(away[added], 99) < 3 + 3 * 0.5
    beside = (away > 1) & (away < 2) & np.isin(wide.kind, (Kind.GROUND, Kind.PAVED))
    assert wide.road_mask[beside].mean() > 0.8
    assert wide.road_mask[wide.kind == Kind.BUILDING].mean() < 0.02
    off_road = (wide.kind == Kind.CROWN) & ~wide.reference_road
    assert wide.road_mask[off_road].mean() < 0.1


def test_verge_share_is_that_of_the_length():
    none, half, whole = (plain(verge_m=3, verge_share=share).road_mask.sum() for share in (0, 0.5, 1))
    assert none < half < whole
    assert (half - none) / (whole - none) == pytest.approx(0.5, abs=0.2)


def test_open_ground_is_all_but_roofs_and_crowns():
    half, whole = plain(open_ground=0.5), plain(open_ground=1)
    covered = np.isin(whole.kind, (Kind.BUILDING, Kind.CROWN)) & ~whole.reference_road
    assert whole.road_mask[~covered].mean() > 0.97
    assert whole.road_mask[covered].mean() < 0.15
    assert 0.3 < false_road(half).sum() / false_road(whole).sum() < 0.7


def test_yards_are_paved_and_partly_in_mask():
    yards = plain(yards=3)
    paved = yards.kind == Kind.PAVED
    assert paved.sum() > 500
    assert not (paved & yards.reference_road).any()
    assert 0.4 < yards.road_mask[paved].mean() < 0.9


def test_facades_are_false_road_on_roofs_where_they_lean():
    upright, leaning, shown = (
        plain(verge_m=2, lean=lean, facades=share) for lean, share in ((0, 1), (0.3, 0), (0.3, 1))
    )
    roof = upright.kind == Kind.BUILDING
    assert np.array_equal(upright.dsm, shown.dsm)
    assert max(false_road(scene)[roof].mean() for scene in (upright, leaning)) < 0.02
    facade = shown.road_mask & ~leaning.road_mask
    assert facade.sum() > 100
    assert facade[roof].sum() > 0.8 * facade.sum()
    # They are strips at the walls, as wide as roofs are displaced: 0.3 of the height or less.
    inside = distance_transform_edt(roof)[facade & roof]
    assert 1 < np.percentile(inside, 95) < 0.3 * 20


def test_leaning_roof_hides_road_mask_beside_it():
    upright, leaning = (plain(verge_m=4, verge_share=1, lean=lean) for lean in (0, 0.4))
    hidden = upright.road_mask & ~leaning.road_mask
    walls = distance_transform_edt(upright.kind != Kind.BUILDING)
    assert hidden.sum() > 50
    assert np.percentile(walls[hidden], 95) < 0.4 * np.sqrt(2) * 20
    assert np.array_equal(upright.dsm, leaning.dsm)
