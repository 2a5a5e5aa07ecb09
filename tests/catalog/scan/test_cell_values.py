"""Values of cells: masks, and heights that many cells share."""

from __future__ import annotations

import numpy as np
import pytest

from flexroad.catalog.scan import cell_values
from flexroad.catalog.scan.cell_values import mask_notes, plateau_notes
from tests.make_rasters import write, write_xyz

CLASSES = np.array([[1, 2], [5, 7]], np.uint8).repeat(20, 0).repeat(20, 1)


@pytest.mark.parametrize(
    ("values", "nodata", "road", "note"),
    [
        (CLASSES, None, (99,), "no cell has --road-value 99 but 1, 2, 5, 7"),
        (CLASSES, None, (98, 99), "no cell has --road-value 98 or 99 but 1, 2, 5, 7"),
        (CLASSES, None, (7, 99), None),
        (CLASSES, None, (), "values are 1, 2, 5, 7, and all but 0 count as road; name the roads'"),
        (CLASSES // 3, None, (), "values are 0, 1, 2, and all but 0 count as road; name the roads'"),
        (CLASSES, 7, (7,), "no cell has --road-value 7 but 1, 2, 5"),
        (CLASSES * 0 + 1, None, (), "every cell counts as road, with the value 1; name the roads'"),
        (
            CLASSES / 14,
            None,
            (),
            "values are 0.0714286, 0.142857, 0.357143, 0.5, as of probabilities, and all",
        ),
        (CLASSES // 7, None, (), None),
        (CLASSES // 7 * 255, None, (), None),
        (CLASSES // 7, 0, (), None),
        (CLASSES * 0, None, (), None),
        (np.arange(40).reshape(4, 10), None, (50,), "no cell has --road-value 50 but 0, 1, 2, 3, 4, 5, 6, 7"),
    ],
)
def test_values_that_do_not_fit_are_noted(values, nodata, road, note, tmp_path):
    write(tmp_path / "m.tif", values.astype(np.float64), nodata=nodata)
    notes = mask_notes(tmp_path, "road_mask", ["m.tif"], road)
    assert len(notes) == (note is not None)
    assert note is None or notes[0].startswith(f"road_mask: {note}")
    assert note is None or notes[0].endswith("in the parts read of m.tif")


def test_of_a_large_mask_parts_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(cell_values, "SIDE", 8)
    values = np.zeros((40, 6), np.uint8)
    values[-1, -1] = 3
    write(tmp_path / "m.tif", values)
    assert mask_notes(tmp_path, "road_mask", ["m.tif"], (3,)) == []
    values[-1, -1], values[5, 2] = 0, 3
    write(tmp_path / "m.tif", values)
    assert "no cell has --road-value 3 but 0" in mask_notes(tmp_path, "road_mask", ["m.tif"], (3,))[0]


def test_some_of_many_files_are_read_and_broken_ones_left_out(tmp_path):
    names = [f"{number:02}.tif" for number in range(20)]
    for name in names:
        write(tmp_path / name, CLASSES)
    (tmp_path / "00.tif").write_bytes(b"no raster")
    (note,) = mask_notes(tmp_path, "road_mask", names, (9,))
    assert note.endswith("but 1, 2, 5, 7, in the parts read of 03.tif, 06.tif, 09.tif and 3 more")


def test_masks_in_text_formats_are_not_read(tmp_path):
    assert mask_notes(tmp_path, "road_mask", ["gone.xyz", "gone.asc"], (9,)) == []


PLANE = 100 + 0.02 * np.add.outer(np.arange(40.0), 2.3 * np.arange(60.0))


def notes(path):
    return plateau_notes("dsm", {path.name: path})


@pytest.mark.parametrize("value", [0, -9999, 9999, 105.5])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_undeclared_void_is_noted_with_value_and_share(value, dtype, tmp_path):
    heights = PLANE.copy()
    heights[:5] = value
    (note,) = notes(write(tmp_path / "a.tif", heights.astype(dtype)))
    assert note.startswith(f"dsm: many cells have the exact height {value:g}: a.tif (12.5%); if they")
    assert f"gdal_translate -a_nodata {value:g} FILE" in note


def test_declared_and_small_voids_are_not_noted(tmp_path):
    heights = PLANE.copy()
    heights[:2] = 0  # 5.0%
    assert notes(write(tmp_path / "a.tif", heights)) == []
    heights[:5] = 0
    assert notes(write(tmp_path / "a.tif", heights, nodata=0)) == []
    heights[:5] = np.nan
    assert notes(write(tmp_path / "a.tif", heights)) == []


def test_heights_in_whole_metres_are_no_plateaus_but_voids_among_them_are(tmp_path):
    heights = PLANE.round().astype(np.int16)
    assert np.unique(heights, return_counts=True)[1].max() > 0.3 * heights.size
    assert notes(write(tmp_path / "a.tif", heights)) == []
    heights[:5] = 0
    (note,) = notes(write(tmp_path / "a.tif", heights))
    assert "many cells have the exact height 0: a.tif (12.5%);" in note


def test_value_of_a_scaled_band_is_its_height_and_the_remedy_has_the_stored_one(tmp_path):
    stored = np.round(PLANE * 100).astype(np.int32)
    stored[:5] = 7
    (note,) = notes(write(tmp_path / "a.tif", stored, scale=(0.01, -50.0)))
    assert "many cells have the exact height -49.93: a.tif (12.5%);" in note
    assert note.endswith("gdal_translate -a_nodata 7 FILE NEW.tif")


def test_remedy_has_all_digits_of_the_value(tmp_path):
    heights = PLANE.astype(np.float32)
    heights[:5] = np.finfo(np.float32).min
    (note,) = notes(write(tmp_path / "a.tif", heights))
    assert note.endswith("gdal_translate -a_nodata -3.4028234663852886e+38 FILE NEW.tif")


def test_files_with_the_same_value_are_one_note(tmp_path):
    heights = PLANE.copy()
    heights[:5] = 0
    names = [f"{number}.tif" for number in range(5)]
    paths = {name: write(tmp_path / name, heights) for name in names}
    (note,) = plateau_notes("dtm", paths)
    assert note.startswith("dtm: many cells have the exact height 0: 0.tif (12.5%), 1.tif (12.5%), 2.tif")


def test_file_of_one_height_is_no_plateau(tmp_path):
    assert notes(write(tmp_path / "a.tif", np.full((40, 60), 7.0))) == []


def test_text_is_read_and_damaged_files_are_left_out(tmp_path):
    heights = PLANE.copy()
    heights[:5] = -9999
    path = write_xyz(tmp_path / "a.xyz", heights, 295500.0, 5629500.0)
    (note,) = notes(path)
    assert "many cells have the exact height -9999: a.xyz (12.5%);" in note
    (tmp_path / "b.tif").write_bytes(b"no raster")
    assert plateau_notes("dsm", {name: tmp_path / name for name in ("b.tif", "gone.xyz", "gone.tif")}) == []
