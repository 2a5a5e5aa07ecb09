"""A DTM of another year than the DSM, and the paper's reference made from it."""

from functools import lru_cache

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, distance_transform_edt

from flexroad.tools.synthetic import Kind, Scene, SceneOptions, block, make_scene
from flexroad.tools.synthetic.gerod import survey
from flexroad.tools.synthetic.survey_errors import BESIDE_M, RISE_M, TRENCH_M

GRID = block(1)[0][1]
INNER = np.s_[8:-8, 8:-8]


@lru_cache
def made(seed: int = 2, density: float = 0, **options: float) -> Scene:
    plain = {"dsm_noise_m": (0, 0), "dtm_noise_m": 0, "density": density, "stream_share": 0.3}
    return make_scene(GRID, seed, "urban", SceneOptions(**{**plain, **options}))


def test_works_change_dsm_and_truth_and_not_dtm():
    before, after = made(), made(works=2)
    rise = after.reference - before.reference
    assert np.array_equal(after.dtm, before.dtm)
    assert np.array_equal(after.dsm - before.dsm, rise)
    assert 0.01 < np.mean(rise != 0) < 0.3


def test_works_are_surfaces_kerbs_and_excavations_on_streets():
    before, after = made(), made(works=2)
    rise = after.reference - before.reference
    changed = rise != 0
    allowed = np.zeros_like(changed)
    for low, high in RISE_M.values():
        of_kind = (rise > low - 1e-9) & (rise < high + 1e-9)
        assert of_kind.any()
        allowed |= of_kind
    assert allowed[changed].all()
    away = distance_transform_edt(~before.reference_road)[INNER]
    assert away[changed[INNER]].max() < BESIDE_M + TRENCH_M[1] / 2 + 1.5
    assert not changed[before.kind == Kind.DECK].any()


def test_flight_offset_is_slow_and_in_dtm_only():
    one, other = made(), made(flight_offset_m=0.05)
    offset = other.dtm - one.dtm
    assert np.array_equal(one.dsm, other.dsm)
    assert np.array_equal(one.reference, other.reference)
    assert np.abs(np.diff(offset, axis=0)).max() < 0.002
    means = [
        np.mean(made(seed=seed, flight_offset_m=0.05).dtm - made(seed=seed).dtm) for seed in range(2, 14)
    ]
    assert np.sqrt(np.mean(np.square(means))) == pytest.approx(0.05, rel=0.5)


def test_extended_dtm_is_dtm_with_decks():
    scene = made(stream_share=1, flight_offset_m=0.05)
    deck = scene.kind == Kind.DECK
    assert deck.sum() > 100
    assert np.array_equal(scene.extended_dtm[~deck], scene.dtm[~deck])
    assert np.abs(scene.extended_dtm - scene.reference)[deck].max() < 0.2
    assert np.max((scene.extended_dtm - scene.dtm)[deck]) > 3


def test_benchmark_reference_differs_from_truth_as_surveys_do():
    for _, grid, stratum, options in survey(4, 1):
        scene = make_scene(grid, 1, stratum, options)
        assert 0.01 < np.mean(np.abs(scene.extended_dtm - scene.reference)) < 0.3
        road = scene.reference_road & ~binary_dilation(scene.kind == Kind.DECK, iterations=4)
        assert np.median(np.abs(scene.extended_dtm - scene.reference)[road]) < 0.15


def test_benchmark_same_seed_gives_same_scene_and_other_seed_another():
    _, grid, stratum, options = survey(1, 1)[0]
    first, same, other = (make_scene(grid, seed, stratum, options) for seed in (1, 1, 2))
    for name, layer in {**first.layers, "extended": first.extended_dtm}.items():
        again = same.extended_dtm if name == "extended" else same.layers[name]
        assert np.array_equal(layer, again, equal_nan=True)
    assert not np.array_equal(first.road_mask, other.road_mask)
    assert not np.array_equal(first.extended_dtm, other.extended_dtm)
