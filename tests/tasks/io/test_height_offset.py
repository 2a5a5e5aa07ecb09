"""A DSM that lies above or below the DTM as a whole is noted with the number; buildings and trees are not."""

import numpy as np
import pytest

from flexroad.catalog import Grid
from flexroad.tasks.io.dsm_and_dtm import is_offset, offset_note, on_tiles, open_offset
from flexroad.tools.synthetic import make_scene

GRID = Grid("EPSG:25832", 500_000, 5_600_250, 1.0, 250, 250)
ROW, COL = np.mgrid[:250, :250]
GROUND = 100 + 0.02 * COL + 0.05 * ROW


def town(noise_m=0.03):
    """Ground under noise; a third of it are flat roofs of 8 to 20 m, a quarter rough crowns."""
    rng = np.random.default_rng(1)
    heights = GROUND + rng.normal(0, noise_m, GROUND.shape)
    for number, col in enumerate(range(10, 250, 30)):
        heights[:, col : col + 10] += 8 + 1.7 * number
    heights[:60] += rng.uniform(2, 15, (60, 250))
    return heights


@pytest.mark.parametrize("above", [47.0, 10.0, 1.5, -1.5, -10.0, -47.0])
def test_constant_offset_is_noted_with_its_number(above):
    median_m, spread_m = open_offset(town() + above, GROUND)
    assert median_m == pytest.approx(above, abs=0.02)
    assert spread_m == pytest.approx(0.03, abs=0.01)
    side = "above" if above > 0 else "below"
    note = offset_note(town() + above, GROUND)
    assert note.startswith(f"the DSM lies {abs(above):.1f} m {side} the DTM: ellipsoidal heights")
    assert is_offset(note)


@pytest.mark.parametrize("above", [0.0, 0.4, -0.4])
def test_town_with_roofs_and_trees_gives_no_note(above):
    assert open_offset(town() + above, GROUND)[0] == pytest.approx(above, abs=0.02)
    assert offset_note(town() + above, GROUND) is None


@pytest.mark.parametrize("stratum", ["urban", "suburban", "rural"])
def test_synthetic_survey_gives_no_note_also_if_swapped(stratum):
    scene = make_scene(GRID, 3, stratum)
    assert offset_note(scene.dsm, scene.dtm) is None
    assert offset_note(scene.dtm, scene.dsm) is None


def test_feet_against_metres_is_a_ratio_on_flat_and_steep_ground():
    steep = 300 + 0.3 * COL
    for ground in (GROUND, steep):
        assert offset_note(ground / 0.3048, ground) == (
            "the heights of the DSM are 3.28 times the DTM heights: the DSM in feet, the DTM in metres?"
        )
        assert offset_note(ground, ground / 0.3048) == (
            "the heights of the DSM are 0.30 times the DTM heights: the DTM in feet, the DSM in metres?"
        )


@pytest.mark.parametrize(
    ("unit", "metres", "ratios"),
    [
        ("feet", 0.3048, ("3.28", "0.30")),
        ("dm", 0.1, ("10.00", "0.10")),
        ("cm", 0.01, ("100.00", "0.010")),
        ("mm", 0.001, ("1000.00", "0.001")),
    ],
)
def test_other_unit_of_a_town_is_a_ratio(unit, metres, ratios):
    """The difference of neighbouring cells is that many times as large, too."""
    for models, ratio, which in (
        ((town() / metres, GROUND), ratios[0], f"the DSM in {unit}, the DTM in metres?"),
        ((town(), GROUND / metres), ratios[1], f"the DTM in {unit}, the DSM in metres?"),
    ):
        assert offset_note(*models) == f"the heights of the DSM are {ratio} times the DTM heights: {which}"


@pytest.mark.parametrize("stratum", ["urban", "suburban", "rural"])
def test_feet_of_a_survey_are_a_ratio(stratum):
    """In feet its differences between neighbours are more than those of open ground in metres."""
    scene = make_scene(GRID, 3, stratum)
    assert offset_note(scene.dsm / 0.3048, scene.dtm) == (
        "the heights of the DSM are 3.28 times the DTM heights: the DSM in feet, the DTM in metres?"
    )


def test_offset_over_a_coast_is_no_ratio():
    coast = 0.5 + 0.004 * COL
    assert offset_note(coast + 47, coast) == "the DSM lies 47.0 m above the DTM: ellipsoidal heights?"


def test_wood_without_open_ground_has_no_offset():
    """Crowns of 10 to 30 m everywhere: there is no open cell to compare."""
    crowns = GROUND + np.random.default_rng(2).uniform(10, 30, GROUND.shape)
    assert open_offset(crowns, GROUND) is None
    assert offset_note(crowns, GROUND) is None


def test_models_without_common_cells_give_no_note():
    nothing = np.full((3, 3), np.nan)
    assert open_offset(nothing, np.zeros((3, 3))) is None
    assert offset_note(nothing, np.zeros((3, 3))) is None


def test_notes_of_tiles_are_counted_by_their_cause():
    high, low = (offset_note(GROUND + above, GROUND) for above in (47.0, -10.0))
    assert on_tiles([high, high, low], 12) == [
        "the DSM lies 47.0 m above the DTM on 2 of 12 tiles: ellipsoidal heights?",
        "the DSM lies 10.0 m below the DTM on 1 of 12 tiles: "
        "ellipsoidal heights, or are their files swapped?",
    ]
