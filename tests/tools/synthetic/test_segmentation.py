"""The errors of the road mask: image patches, verges, yards, leaning roofs and facades."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, label

from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.gerod import survey

GRID = block(1)[0][1]
PLAIN = {"dsm_noise_m": (0, 0), "dtm_noise_m": 0, "stream_share": 0}


@lru_cache
def made(**options: float) -> Scene:
    return make_scene(GRID, 2, "urban", SceneOptions(**{**PLAIN, **options}))


@lru_cache
def benchmark() -> tuple[Scene, ...]:
    return tuple(make_scene(grid, 1, stratum, options) for _, grid, stratum, options in survey(3, 1))


def false_road(scene: Scene) -> np.ndarray:
    return scene.road_mask & ~scene.reference_road


def test_benchmark_false_road_is_coherent():
    """Nearly all false cells lie in patches of more than 10 m2, as yards and strips do and noise does not."""
    for scene in benchmark():
        false = false_road(scene)
        patches, count = label(false)
        area = np.bincount(patches.ravel(), minlength=count + 1)[1:]
        assert area[area > 10].sum() > 0.85 * false.sum()
        scattered = np.random.default_rng(0).permutation(false.ravel()).reshape(false.shape)
        sizes = np.bincount(label(scattered)[0].ravel())[1:]
        assert sizes[sizes > 10].sum() < 0.3 * false.sum()


def test_patches_mask_is_constant_on_them():
    mask = made(patch_m=2).road_mask
    blocks = mask.reshape(125, 2, 125, 2)
    assert (blocks == blocks[:, :1, :, :1]).all()
    both = (mask & made().road_mask).sum() / (mask | made().road_mask).sum()
    assert 0.85 < both < 1


def test_perfect_mask_has_no_errors_of_any_kind():
    options = {"patch_m": 2, "verge_m": 3, "yards": 3, "lean": 0.3, "facades": 1, "false_roofs": 1}
    perfect = made(mask_errors=0, **options)
    assert np.array_equal(perfect.road_mask, perfect.reference_road)


def test_verge_widens_mask_except_on_roofs_and_crowns():
    narrow, wide = made(), made(verge_m=3, verge_share=1)
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
    none, half, whole = (made(verge_m=3, verge_share=share).road_mask.sum() for share in (0, 0.5, 1))
    assert none < half < whole
    assert (half - none) / (whole - none) == pytest.approx(0.5, abs=0.2)


def test_open_ground_is_all_but_roofs_and_crowns():
    half, whole = made(open_ground=0.5), made(open_ground=1)
    covered = np.isin(whole.kind, (Kind.BUILDING, Kind.CROWN)) & ~whole.reference_road
    assert whole.road_mask[~covered].mean() > 0.97
    assert whole.road_mask[covered].mean() < 0.15
    assert 0.3 < false_road(half).sum() / false_road(whole).sum() < 0.7


def test_yards_are_paved_and_partly_in_mask():
    yards = made(yards=3)
    paved = yards.kind == Kind.PAVED
    assert paved.sum() > 500
    assert not (paved & yards.reference_road).any()
    assert 0.4 < yards.road_mask[paved].mean() < 0.9


def test_facades_are_false_road_on_roofs_where_they_lean():
    upright, leaning, shown = (
        made(verge_m=2, lean=lean, facades=share) for lean, share in ((0, 1), (0.3, 0), (0.3, 1))
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
    upright, leaning = (made(verge_m=4, verge_share=1, lean=lean) for lean in (0, 0.4))
    hidden = upright.road_mask & ~leaning.road_mask
    walls = distance_transform_edt(upright.kind != Kind.BUILDING)
    assert hidden.sum() > 50
    assert np.percentile(walls[hidden], 95) < 0.4 * np.sqrt(2) * 20
    assert np.array_equal(upright.dsm, leaning.dsm)
