"""Swapped DSM and DTM are noted."""

import numpy as np
import pytest

from flexroad.catalog import Grid
from flexroad.tasks.io.dsm_and_dtm import below_ground_note
from flexroad.tasks.synthetic import make_scene


@pytest.mark.parametrize("stratum", ["urban", "suburban", "rural"])
def test_swapped_models_are_noted_and_right_ones_are_not(stratum):
    scene = make_scene(Grid("EPSG:25832", 500_000, 5_600_250, 1.0, 250, 250), 3, stratum)
    assert below_ground_note(scene.dsm, scene.dtm) is None
    assert below_ground_note(scene.dtm, scene.dsm).endswith("are their files swapped?")


def test_ground_dug_off_between_the_surveys_is_not_noted():
    dtm = np.zeros((100, 100))
    dsm = dtm.copy()
    dsm[:20] = -5.0
    dsm[50:60] = 8.0
    assert below_ground_note(dsm, dtm) is None
    assert "in 20% of the cells and above it in 0%" in below_ground_note(np.minimum(dsm, 0), dtm)


def test_models_without_common_cells_give_no_note():
    assert below_ground_note(np.full((3, 3), np.nan), np.zeros((3, 3))) is None
