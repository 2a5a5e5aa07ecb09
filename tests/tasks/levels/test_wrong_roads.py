"""Crossings whose vectors are wrong, or whose rasters lack something: heights stay right, with notes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from tests.make_crossings import Survey, block


def changed(width=1.0, shift=0.0, ends=0.0, gap=0.0):
    """Return a change of the main road: its width (share), place across, and lengths at its joints (m)."""

    def change(lines):
        result = []
        for line in lines:
            if line.width_m != 8.0:
                result.append(line)
                continue
            (start, end), longer = line.points, ends if line.level else -ends
            along = (end - start) / np.hypot(*(end - start))
            across = shift * np.array([-along[1], along[0]])
            first = second = longer
            if not line.level:
                # The far end of an approach stays where it is.
                deck = [other for other in lines if other.level and np.hypot(*(other.points[0] - end)) < 0.01]
                first, second = (0.0, longer - gap) if deck else (longer - gap, 0.0)
            points = np.array([start - first * along + across, end + second * along + across])
            result.append(replace(line, points=points, width_m=line.width_m * width))
        return result

    return change


def _deck_heights(survey):
    """Return the true heights of the decks at the cells of a survey (m); NaN elsewhere."""
    grid = survey.data.grid
    return survey.world.height(1, *np.meshgrid(grid.eastings, grid.northings))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "deck", "approach"),
    [
        ({"width": 1.25}, 0.02, 0.03),
        ({"width": 0.75}, 0.02, 0.03),
        ({"shift": 2.0}, 0.035, 0.05),
        ({"ends": 2.0}, 0.02, 0.05),
        ({"ends": -2.0}, 0.02, 0.2),
        ({"gap": 1.0}, 0.02, 0.02),
        ({"gap": -1.0}, 0.02, 0.02),
    ],
    ids=str,
)
def test_wrong_polygons_keep_heights(tmp_path, change, deck, approach):
    core = block(80)
    survey = Survey.of(tmp_path, 0, core, changed(**change), tubes=0)
    result = survey.tile(core)
    errors = survey.errors(result)
    assert errors["deck"] <= deck
    assert errors["under"] <= 0.06
    assert errors["near"] <= 0.06
    assert errors["approach"] <= approach
    (level,) = result.road.levels
    assert len(level.joints.geoms) == 2


def test_gap_beyond_reach_is_noted_and_ends_the_ground_by_itself(tmp_path):
    core = block(80)
    survey = Survey.of(tmp_path, 0, core, changed(gap=2.5), tubes=0)
    result = survey.tile(core)
    assert any("without a joint" in note for note in result.road.notes)
    assert survey.errors(result)["deck"] <= 0.03


@pytest.mark.slow
@pytest.mark.parametrize("dtm", ["with decks", "unknown below decks"])
def test_terrain_models_tell_nothing_of_the_ground_below_decks(tmp_path, dtm):
    core = block(80)
    survey = Survey.of(tmp_path, 0, core, tubes=0)
    decks = binary_dilation(np.isfinite(_deck_heights(survey)))
    heights = survey.data.dsm if dtm == "with decks" else np.nan
    data = replace(survey.data, dtm=np.where(decks, heights, survey.data.dtm))
    survey = replace(survey, data=data, parts={})
    errors = survey.errors(survey.tile(core))
    assert errors["deck"] <= 0.02
    assert errors["under"] <= 0.06


@pytest.mark.slow
def test_deck_without_any_height_follows_its_approaches(tmp_path):
    core = block(80)
    survey = Survey.of(tmp_path, 1, core, tubes=0)
    decks = np.isfinite(_deck_heights(survey))
    data = replace(survey.data, dsm=np.where(decks, np.nan, survey.data.dsm))
    survey = replace(survey, data=data, parts={})
    errors = survey.errors(survey.tile(core))
    assert errors["deck"] <= 0.1
    assert errors["under"] <= 0.06


@pytest.mark.slow
def test_layer_of_decks_gives_the_deck_its_height(tmp_path):
    """Where crowns hide it."""
    core = block(80)
    survey = Survey.of(tmp_path, 0, core, tubes=0)
    deck = _deck_heights(survey)
    hidden = np.where(
        np.isfinite(deck), deck + 6 + np.random.default_rng(1).random(deck.shape), survey.data.dsm
    )
    errors = {}
    for name, decks in (("without", None), ("with", deck)):
        data = replace(survey.data, dsm=hidden, decks=decks)
        part = replace(survey, data=data, parts={})
        errors[name] = part.errors(part.tile(core))["deck"]
    assert errors["with"] <= 0.03
    assert errors["with"] < errors["without"]
