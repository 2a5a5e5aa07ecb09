"""Notes on swapped models, offsets, other units, dates and vertical datums of DSM and DTM."""

from datetime import UTC, datetime

import numpy as np
import pytest

from flexroad.catalog import Grid, Layer, Tile
from flexroad.tasks.io.dsm_and_dtm import (
    below_ground_note,
    is_offset,
    offset_note,
    on_tiles,
    open_offset,
    survey_difference,
    vertical_crs,
)
from flexroad.tools.synthetic import make_scene
from tests.builders import make_grid
from tests.make_rasters import UTM, write

GRID = Grid("EPSG:25832", 500_000, 5_600_250, 1.0, 250, 250)
ROW, COL = np.mgrid[:250, :250]
GROUND = 100 + 0.02 * COL + 0.05 * ROW
COAST = 0.5 + 0.004 * COL
DHHN, OTHER = "EPSG:25832+7837", "EPSG:25832+5783"
SPRING, AUTUMN = {"ACQUISITIONDATE": "2020-04-01"}, {"ACQUISITIONDATE": "2020-10-01"}


def town():
    """Ground under noise; a third of it are flat roofs of 8 to 20 m, a quarter rough crowns."""
    rng = np.random.default_rng(1)
    heights = GROUND + rng.normal(0, 0.03, GROUND.shape)
    for number, col in enumerate(range(10, 250, 30)):
        heights[:, col : col + 10] += 8 + 1.7 * number
    heights[:60] += rng.uniform(2, 15, (60, 250))
    return heights


@pytest.mark.parametrize("stratum", ["urban", "suburban", "rural"])
def test_survey_has_a_note_only_if_swapped_or_in_feet(stratum):
    """In feet its differences between neighbours are larger than on open ground in metres."""
    scene = make_scene(GRID, 3, stratum)
    assert below_ground_note(scene.dsm, scene.dtm) is None
    assert below_ground_note(scene.dtm, scene.dsm).endswith("are their files swapped?")
    assert offset_note(scene.dsm, scene.dtm) is None
    assert offset_note(scene.dtm, scene.dsm) is None
    in_feet = offset_note(scene.dsm / 0.3048, scene.dtm)
    assert in_feet.startswith("the heights of the DSM are 3.28 times the DTM heights: the DSM in feet")


def test_ground_dug_off_between_the_surveys_is_not_noted():
    dtm = np.zeros((100, 100))
    dsm = dtm.copy()
    dsm[:20] = -5.0
    dsm[50:60] = 8.0
    assert below_ground_note(dsm, dtm) is None
    assert "in 20% of the cells and above it in 0%" in below_ground_note(np.minimum(dsm, 0), dtm)


@pytest.mark.parametrize("above", [47.0, 10.0, 1.5, -1.5, -10.0, -47.0, 0.0, 0.4, -0.4])
def test_constant_offset_is_noted_with_its_number(above):
    median_m, spread_m = open_offset(town() + above, GROUND)
    assert median_m == pytest.approx(above, abs=0.02)
    assert spread_m == pytest.approx(0.03, abs=0.01)
    note = offset_note(town() + above, GROUND)
    if abs(above) < 1:
        assert note is None
    else:
        side = "above" if above > 0 else "below"
        assert note.startswith(f"the DSM lies {abs(above):.1f} m {side} the DTM: ellipsoidal heights")
        assert is_offset(note)


def test_offset_over_a_coast_is_no_ratio():
    assert offset_note(COAST + 47, COAST) == "the DSM lies 47.0 m above the DTM: ellipsoidal heights?"


@pytest.mark.parametrize(
    ("unit", "metres", "ratios"),
    [
        ("feet", 0.3048, ("3.28", "0.30")),
        ("dm", 0.1, ("10.00", "0.10")),
        ("cm", 0.01, ("100.00", "0.010")),
        ("mm", 0.001, ("1000.00", "0.001")),
    ],
)
@pytest.mark.parametrize(("dsm", "dtm"), [(town(), GROUND), (300 + 0.3 * COL,) * 2], ids=["town", "steep"])
def test_other_unit_is_a_ratio(unit, metres, ratios, dsm, dtm):
    """The difference of neighbouring cells is that many times as large, too."""
    said = "the heights of the DSM are {} times the DTM heights: the {} in {}, the {} in metres?"
    assert offset_note(dsm / metres, dtm) == said.format(ratios[0], "DSM", unit, "DTM")
    assert offset_note(dsm, dtm / metres) == said.format(ratios[1], "DTM", unit, "DSM")


@pytest.mark.parametrize(
    ("dsm", "dtm"),
    [
        (GROUND + np.random.default_rng(2).uniform(10, 30, GROUND.shape), GROUND),
        (np.full((3, 3), np.nan), np.zeros((3, 3))),
    ],
    ids=["wood everywhere", "no common cell"],
)
def test_models_without_open_ground_have_no_note(dsm, dtm):
    assert open_offset(dsm, dtm) is offset_note(dsm, dtm) is below_ground_note(dsm, dtm) is None


def test_notes_of_tiles_are_counted_by_their_cause():
    high, low = (offset_note(GROUND + above, GROUND) for above in (47.0, -10.0))
    assert on_tiles([high, high, low], 12) == [
        "the DSM lies 47.0 m above the DTM on 2 of 12 tiles: ellipsoidal heights?",
        "the DSM lies 10.0 m below the DTM on 1 of 12 tiles: "
        "ellipsoidal heights, or are their files swapped?",
    ]


def declared(root, dsm, dtm, given=None, more=()) -> Tile:
    """Return a tile whose files declare these CRSs and tags; ``given`` is the CRS of files without."""
    for name, (crs, tags) in (("dsm", dsm), ("dtm", dtm)):
        write(root / f"{name}.tif", np.full((20, 20), 100.0), crs=crs, tags=tags)
    layers = tuple(Layer(name, (f"{name}.tif", *more), (), given) for name in ("dsm", "dtm"))
    return Tile("a", make_grid(20, 20), layers, str(root), datetime(2020, 5, 1, tzinfo=UTC))


@pytest.mark.parametrize(
    ("dsm", "dtm", "differs", "missing"),
    [
        ((DHHN, SPRING), (DHHN, SPRING), "", ""),
        ((DHHN, SPRING), (DHHN, AUTUMN), "date: dsm 2020-04-01, dtm 2020-10-01", ""),
        ((UTM, SPRING), (DHHN, SPRING), "", "vertical CRS"),
        ((UTM, {}), (UTM, {}), "", "date and vertical CRS"),
        ((UTM, SPRING), (UTM, AUTUMN), "date: dsm 2020-04-01, dtm 2020-10-01", "vertical CRS"),
        ((DHHN, SPRING), (OTHER, SPRING), "vertical CRS: dsm EPSG:7837, dtm EPSG:5783", ""),
    ],
)
def test_survey_difference_names_what_differs_and_what_is_missing(tmp_path, dsm, dtm, differs, missing):
    assert survey_difference(declared(tmp_path, dsm, dtm, more=["gone.tif"])) == (differs, missing)


@pytest.mark.parametrize(
    ("dsm", "dtm", "given", "expected"),
    [
        (DHHN, DHHN, None, "EPSG:7837"),
        (DHHN, UTM, None, None),
        (DHHN, OTHER, None, None),
        (UTM, UTM, None, None),
        (None, None, DHHN, "EPSG:7837"),
        (DHHN, None, None, None),
    ],
)
def test_vertical_crs_is_known_if_all_heights_declare_the_same(dsm, dtm, given, expected, tmp_path):
    assert vertical_crs(declared(tmp_path, (dsm, {}), (dtm, {}), given)) == expected


def test_vertical_crs_ignores_a_file_that_cannot_be_read(tmp_path):
    tile = declared(tmp_path, (DHHN, {}), (DHHN, {}))
    (tmp_path / "dtm.tif").write_bytes(b"no raster")
    assert vertical_crs(tile) == "EPSG:7837"
