"""DSM against DTM before a run: offset, ratio, step between sheets, units; on planes with known heights."""

import numpy as np
import pytest

from flexroad.catalog import LAYERS, Catalog
from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.check import trial
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.check.trial import height_findings, trials
from flexroad.pipeline.config.loading import load_config
from flexroad.tasks.load import Options, load
from tests.make_rasters import write

WEST, NORTH = 499_980.0, 5_600_040.0
PLANE = np.tile(100 + 0.02 * np.arange(120, dtype=np.float32), (60, 1))
"""Ground of two tiles of 60 m, side by side."""
EAST = np.arange(120) >= 60


def said(folder, dsm, dtm, unit=None):
    """Return what the check says of a catalog of a DSM and a DTM, either in one file or in two sheets."""
    for name, values in (("dsm", dsm), ("dtm", dtm)):
        if isinstance(values, dict):
            for sheet, (west, part) in values.items():
                write(folder / name / f"{sheet}.tif", part, WEST + west, NORTH, unit=unit)
        else:
            write(folder / name / "all.tif", values.astype(np.float32), WEST, NORTH, unit=unit)
    tiles = index(folder, {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif"}, tile_size_m=60).tiles
    assert len(tiles) == 2
    return found(tiles)


def found(tiles):
    read, faults = trials(tiles, load_config("production"), (), (), ())
    return [finding.text for finding in (*faults, *height_findings(read))]


@pytest.mark.parametrize(
    ("dsm", "dtm", "expected"),
    [
        (PLANE + 0.1, PLANE, ""),
        (PLANE + 47, PLANE, "the DSM lies 47.0 m above the DTM on 2 of 2 tiles: ellipsoidal heights?"),
        (
            PLANE - 10,
            PLANE,
            "the DSM lies 10.0 m below the DTM on 2 of 2 tiles: "
            "ellipsoidal heights, or are their files swapped?",
        ),
        (PLANE + 20 * EAST, PLANE, "the DSM lies 20.0 m above the DTM on 1 of 2 tiles: ellipsoidal heights?"),
        (
            PLANE / 0.3048,
            PLANE,
            "the heights of the DSM are 3.28 times the DTM heights on 2 of 2 tiles: "
            "the DSM in feet, the DTM in metres?",
        ),
        (
            PLANE,
            {"west": (0, PLANE[:, :60]), "east": (60, PLANE[:, 60:] + np.float32(0.4))},
            "DSM minus DTM is -0.40 m on 1 tile (dtm east.tif) and 0.00 m on 1 tile (dtm west.tif): "
            "files of two vertical references?",
        ),
        (
            PLANE + 0.4 * EAST,
            PLANE,
            "DSM minus DTM is 0.00 m on 1 tile (499980_5599980) and 0.40 m on 1 tile (500040_5599980): "
            "files of two vertical references?",
        ),
    ],
    ids=["clean", "above", "below", "on one tile", "feet", "step between sheets", "step in a file"],
)
def test_offset_ratio_or_step_is_one_line_with_its_number(tmp_path, dsm, dtm, expected):
    assert said(tmp_path, dsm, dtm) == ([expected] if expected else [])


def test_heights_in_feet_are_noted_and_a_single_band_in_feet_would_fail(tmp_path):
    said_of_both = said(tmp_path, PLANE / 0.3048, PLANE / 0.3048, unit="ft")
    assert said_of_both == [
        f"{layer}: heights in ft, as the file says, converted to metres: "
        "if they are in metres, correct the unit"
        for layer in ("dsm", "dtm")
    ]
    write(tmp_path / "dtm" / "all.tif", PLANE, WEST, NORTH)
    tiles = index(tmp_path, {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif"}, tile_size_m=60).tiles
    (line,) = found(tiles)
    ids = f"{tiles[0].id}, {tiles[1].id}"
    assert line.startswith(f"{ids} would fail: dsm dsm/all.tif has heights in ft, dtm dtm/all.tif in ")


def test_sample_has_a_tile_of_each_sheet(tmp_path, monkeypatch):
    """A step in one of four sheets is found though two tiles of eight are read."""
    monkeypatch.setattr(trial, "MOST_TILES", 4)
    wide = np.tile(PLANE, (1, 4))
    for number in range(4):
        part = wide[:, 120 * number : 120 * (number + 1)] + np.float32(0.5 * (number == 2))
        write(tmp_path / "dtm" / f"{number}.tif", part, 480_000 + 120 * number, NORTH)
    write(tmp_path / "dsm.tif", wide, 480_000, NORTH)
    tiles = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm/*.tif"}, tile_size_m=60).tiles
    assert len(tiles) == 8
    (line,) = found(tiles)
    assert line.startswith("DSM minus DTM is -0.50 m on 1 tile (dtm 2.tif) and 0.00 m on 3 tiles (")


def with_road(folder, dsm, dtm):
    """Return the tiles of a DSM and a DTM with a road from west to east."""
    road = np.zeros(PLANE.shape)
    road[26:34] = 1
    layers = {"dsm": dsm, "dtm": dtm, "road_mask": road}
    for name, values in layers.items():
        write(folder / f"{name}.tif", values.astype(np.float32), WEST, NORTH)
    return index(folder, {name: f"{name}.tif" for name in layers}, tile_size_m=60).tiles


@pytest.mark.parametrize(
    ("step", "line"),
    [
        (0.4, "note: the road lies 0.40 m below the DTM on 1 of 2 tiles: another vertical reference? "),
        (
            -0.7,
            "note: the road lies 0.70 m above the DTM on 1 of 2 tiles: another vertical reference? ",
        ),
        (0.2, ""),
    ],
)
def test_run_names_a_step_between_tiles(tmp_path, flexroad, step, line):
    Catalog(with_road(tmp_path, PLANE, PLANE + step * EAST)).write(tmp_path / "catalog.json")
    run = ["run", "--catalog", tmp_path / "catalog.json", "--out", tmp_path / "run", "--executor", "serial"]
    for _ in ("computed", "up to date"):
        notes = [text for text in flexroad(*run).expected(0).err.splitlines() if text.startswith("note: ")]
        assert notes == ([f"{line}`flexroad catalog check` compares them"] if line else [])


def test_road_off_the_dtm_on_all_tiles_is_a_remark(tmp_path):
    """Without a step, fields of crops would be off, too, but a road is not."""
    tiles = with_road(tmp_path, PLANE + 0.6, PLANE)
    findings = list(expected_failures(tiles, load_config("paper"), LAYERS))
    assert [(one.text, one.fault) for one in findings] == [
        ("the road lies 0.60 m above the DTM on 2 of 2 tiles: another vertical reference?", False)
    ]


def test_neighbours_of_other_heights_do_not_hide_an_offset_from_the_run(tmp_path):
    write(tmp_path / "dsm.tif", (PLANE + 20 * EAST).astype(np.float32), WEST, NORTH)
    write(tmp_path / "dtm.tif", PLANE, WEST, NORTH)
    west, east = index(tmp_path, {"dsm": "dsm.tif", "dtm": "dtm.tif"}, tile_size_m=60).tiles
    options = Options(halo_m=50)
    assert load(east, options).notes == ("the DSM lies 20.0 m above the DTM: ellipsoidal heights?",)
    assert load(west, options).notes == ()


def test_synthetic_survey_is_clean(survey):
    assert list(expected_failures(Catalog.read(survey).tiles, load_config("paper"), LAYERS)) == []
