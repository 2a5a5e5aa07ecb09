from collections import Counter

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flexroad.tools.synthetic import make_scene
from flexroad.tools.synthetic.gerod import APART_M, PRESET, STRATA, survey


@settings(max_examples=30)
@given(st.integers(1, 300), st.integers(0, 5))
@example(240, 1)
def test_survey_any_size_has_shares_of_paper(tiles, seed):
    places = survey(tiles, seed)
    assert len({name for name, *_ in places}) == tiles
    counts = Counter(stratum for _, _, stratum, _ in places)
    for stratum, share in STRATA.items():
        assert abs(counts[stratum] - tiles * share / 240) < 1


def test_survey_smaller_is_subset_of_larger():
    whole = {tile_id: (grid, stratum, options) for tile_id, grid, stratum, options in survey(240, 3)}
    for tile_id, *rest in survey(24, 3):
        assert whole[tile_id] == tuple(rest)
    assert survey(24, 4)[0][3] != survey(24, 3)[0][3]


def test_survey_tiles_lie_on_absolute_grid_and_apart():
    places = survey(240)
    corners = np.array([(grid.west, grid.south) for _, grid, _, _ in places])
    assert not (corners % 250).any()
    assert [tile_id for tile_id, *_ in places] == [f"{w:.0f}_{s:.0f}" for w, s in corners]
    distance = np.hypot(*(corners[:, None] - corners[None]).transpose(2, 0, 1))
    assert distance[distance > 0].min() == APART_M


def test_survey_options_vary_around_those_of_stratum():
    for _, _, stratum, options in survey(240, 2):
        assert 0.8 * PRESET[stratum].block_m <= options.block_m <= 1.2 * PRESET[stratum].block_m
        assert options.mask_errors == PRESET[stratum].mask_errors
    turns = [options.turn_deg for *_, options in survey(240, 2)]
    assert np.histogram(turns, 3, (0, 90))[0].min() > 50


@pytest.mark.parametrize("stratum", STRATA)
def test_survey_scenes_have_plausible_road_share_and_height(stratum):
    tiles = [place for place in survey(60) if place[2] == stratum][:3]
    scenes = [make_scene(grid, 0, name, options) for _, grid, name, options in tiles]
    least, most = {"urban": (0.12, 0.35), "suburban": (0.08, 0.3), "rural": (0.03, 0.2)}[stratum]
    for scene in scenes:
        assert scene.stratum == stratum
        assert least < scene.reference_road.mean() < most
        assert 0.001 < np.isnan(scene.dsm).mean() < 0.15
    raised = np.mean([np.nanmean((s.dsm - s.reference)[~s.reference_road]) for s in scenes])
    assert {"urban": 1.2, "suburban": 0.8, "rural": 0.3}[stratum] < raised < 4
