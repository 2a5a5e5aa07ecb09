"""Swapped DSM and DTM are noted."""

from datetime import UTC, datetime

import numpy as np
import pytest

from flexroad.catalog import Grid, Layer, Tile
from flexroad.tasks.io.dsm_and_dtm import below_ground_note, survey_difference
from flexroad.tools.synthetic import make_scene
from tests.make_rasters import UTM, write

GRID = Grid(UTM, 295500.0, 5629500.0, 1.0, 20, 20)
DHHN, OTHER = "EPSG:25832+7837", "EPSG:25832+5783"
SPRING, AUTUMN = {"ACQUISITIONDATE": "2020-04-01"}, {"ACQUISITIONDATE": "2020-10-01"}


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


@pytest.mark.parametrize(
    ("dsm", "dtm", "expected"),
    [
        ((DHHN, SPRING), (DHHN, SPRING), ("", "")),
        ((DHHN, SPRING), (DHHN, AUTUMN), ("date: dsm 2020-04-01, dtm 2020-10-01", "")),
        ((UTM, SPRING), (DHHN, SPRING), ("", "vertical CRS")),
        ((UTM, {}), (UTM, {}), ("", "date and vertical CRS")),
        ((UTM, SPRING), (UTM, AUTUMN), ("date: dsm 2020-04-01, dtm 2020-10-01", "vertical CRS")),
    ],
)
def test_survey_difference_names_what_differs_and_what_is_missing(tmp_path, dsm, dtm, expected):
    for name, (crs, tags) in (("dsm", dsm), ("dtm", dtm)):
        write(tmp_path / f"{name}.tif", np.full((20, 20), 100.0), crs=crs, tags=tags)
    layers = tuple(Layer(name, (f"{name}.tif",)) for name in ("dsm", "dtm"))
    tile = Tile("a", GRID, layers, str(tmp_path), datetime(2020, 5, 1, tzinfo=UTC))
    assert survey_difference(tile) == expected


def test_survey_difference_of_vertical_datums(tmp_path):
    for name, crs in (("dsm", DHHN), ("dtm", OTHER)):
        write(tmp_path / f"{name}.tif", np.full((20, 20), 100.0), crs=crs, tags=SPRING)
    layers = tuple(Layer(name, (f"{name}.tif", "gone.tif")) for name in ("dsm", "dtm"))
    tile = Tile("a", GRID, layers, str(tmp_path), datetime(2020, 5, 1, tzinfo=UTC))
    differs, missing = survey_difference(tile)
    assert differs.startswith("vertical CRS: dsm ")
    assert missing == ""
