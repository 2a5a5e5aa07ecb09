"""Crossings whose vectors are wrong, or whose rasters lack something: heights stay right, with notes."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from scipy.ndimage import binary_dilation

from flexroad.tasks.metrics.mesh_check import faults
from flexroad.tasks.quality.assess import NO_RISE, Options, assess
from flexroad.tasks.quality.height_source import HeightSource
from flexroad.tasks.sample import Options as SampleOptions
from flexroad.tasks.sample import sample
from tests.make_crossings import Survey, block

CORE = block(80)


def changed(width=1.0, shift=0.0, ends=0.0, gap=0.0):
    """Return a change of the main road: its width (share), place across, and lengths at its abutments (m)."""

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
        ({"ends": 3.0}, 0.02, 0.05),
        ({"ends": -3.0}, 0.02, 0.2),
        ({"gap": 1.0}, 0.02, 0.02),
        ({"gap": -1.0}, 0.02, 0.02),
    ],
    ids=str,
)
def test_wrong_polygons_keep_heights(tmp_path, change, deck, approach):
    survey = Survey.of(tmp_path, 0, CORE, changed(**change), tunnels=0)
    result = survey.tile(CORE)
    errors = survey.errors(result)
    assert errors["deck"] <= deck
    assert errors["under"] <= 0.06
    assert errors["near"] <= 0.06
    assert errors["approach"] <= approach
    (level,) = result.road.levels
    assert len(level.abutments.geoms) == 2


def test_gap_beyond_reach_is_noted_and_ends_the_ground_by_itself(tmp_path):
    survey = Survey.of(tmp_path, 0, CORE, changed(gap=2.5), tunnels=0)
    result = survey.tile(CORE)
    assert any("without an abutment" in note for note in result.road.notes)
    assert survey.errors(result)["deck"] <= 0.03


def quality_of(result):
    """Return the quality of level 0, and of level 1."""
    own = assess(result.data, result.road, result.clusters, result.surface, Options())
    return own, dict(own.levels)[1]


def test_deck_drawn_on_the_ground_is_flagged_and_keeps_the_road(tmp_path):
    def change(lines):
        """Cut the street below the deck, and lift a piece of it where it is on the ground."""
        result = []
        for line in lines:
            if line.width_m == 8.0:
                result.append(replace(line, level=0))
                continue
            start, end = line.points
            places = [start + share * (end - start) for share in (0, 0.25, 0.4, 1)]
            pieces = zip(places[:-1], places[1:], (0, 1, 0), strict=True)
            result += [replace(line, points=np.array(piece[:2]), level=piece[2]) for piece in pieces]
        return result

    survey = Survey.of(tmp_path, 0, CORE, change, tunnels=0)
    result = survey.tile(CORE)
    own, deck = quality_of(result)
    assert NO_RISE in own.flags
    assert NO_RISE in deck.flags
    assert deck.structures.abutments > 0
    x, y = np.meshgrid(CORE.eastings, CORE.northings)
    off = result.surface.at(1).height(x, y) - survey.world.height(0, x, y)
    assert np.abs(off[result.road.levels[0].covers(x, y)]).mean() <= 0.02


@pytest.mark.parametrize("beyond", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_deck_at_the_rim_of_the_survey_ends_there(tmp_path, beyond):
    """The survey ends so far (m) beyond an abutment."""
    survey = Survey.of(tmp_path, 0, CORE, tunnels=0)
    ends = [line.centroid for line in shapely.get_parts(survey.tile(CORE).road.levels[0].abutments)]
    (x, y), (east, north) = (np.array(end.coords[0]) for end in ends)
    at = np.meshgrid(survey.data.grid.eastings, survey.data.grid.northings)
    gone = (at[0] - x) * (x - east) + (at[1] - y) * (y - north) > beyond * np.hypot(x - east, y - north)
    dsm, dtm = (np.where(gone, np.nan, heights) for heights in (survey.data.dsm, survey.data.dtm))
    survey = replace(survey, data=replace(survey.data, dsm=dsm, dtm=dtm), parts={})
    result = survey.tile(CORE)
    mesh = sample(result.surface, result.road, result.clusters, SampleOptions())
    assert mesh.numbers == (0, 1)
    assert [faults(mesh.at(number)) for number in mesh.numbers] == [(), ()]
    assert survey.errors(result)["deck"] <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize("dtm", ["with decks", "unknown below decks"])
def test_terrain_models_tell_nothing_of_the_ground_below_decks(tmp_path, dtm):
    survey = Survey.of(tmp_path, 0, CORE, tunnels=0)
    decks = binary_dilation(np.isfinite(_deck_heights(survey)))
    heights = survey.data.dsm if dtm == "with decks" else np.nan
    data = replace(survey.data, dtm=np.where(decks, heights, survey.data.dtm))
    survey = replace(survey, data=data, parts={})
    errors = survey.errors(survey.tile(CORE))
    assert errors["deck"] <= 0.02
    assert errors["under"] <= 0.06


@pytest.mark.slow
def test_deck_without_any_height_follows_its_approaches(tmp_path):
    survey = Survey.of(tmp_path, 1, CORE, tunnels=0)
    decks = np.isfinite(_deck_heights(survey))
    data = replace(survey.data, dsm=np.where(decks, np.nan, survey.data.dsm))
    survey = replace(survey, data=data, parts={})
    result = survey.tile(CORE)
    errors = survey.errors(result)
    assert errors["deck"] <= 0.1
    assert errors["under"] <= 0.06
    deck = quality_of(result)[1]
    assert deck.inferred_road > 0.9
    assert HeightSource.DTM not in deck.height_source


@pytest.mark.slow
def test_layer_of_decks_gives_the_deck_its_height(tmp_path):
    """Where crowns hide it."""
    survey = Survey.of(tmp_path, 0, CORE, tunnels=0)
    deck = _deck_heights(survey)
    crowns = deck + 6 + np.random.default_rng(1).random(deck.shape)
    hidden = np.where(np.isfinite(deck), crowns, survey.data.dsm)
    errors, qualities = {}, {}
    for name, decks in (("without", None), ("with", deck)):
        data = replace(survey.data, dsm=hidden, decks=decks)
        part = replace(survey, data=data, parts={})
        result = part.tile(CORE)
        errors[name] = part.errors(result)["deck"]
        qualities[name] = quality_of(result)[1]
    assert qualities["without"].dropped_road > 0.9
    assert {"dropped", "error-estimate"} <= set(qualities["without"].flags)
    assert "error-estimate" not in qualities["with"].flags
    assert errors["with"] <= 0.03
    assert errors["with"] < errors["without"]
