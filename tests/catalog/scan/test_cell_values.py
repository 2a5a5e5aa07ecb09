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
    # Masks in text formats are not read.
    assert mask_notes(tmp_path, "road_mask", ["gone.xyz", "gone.asc"], (9,)) == []


PLANE = 100 + 0.02 * np.add.outer(np.arange(40.0), 2.3 * np.arange(60.0))


LEAST = np.finfo(np.float32).min


@pytest.mark.parametrize(
    ("rows", "value", "dtype", "options", "height", "stored"),
    [
        *[(5, v, kind, {}, f"{v:g}", f"{v:g}") for v in (0, -9999, 105.5) for kind in ("float32", "float64")],
        (5, 9999, "float32", {}, "9999", "9999"),
        (5, LEAST, "float32", {}, "-3.40282e+38", "-3.4028234663852886e+38"),  # all digits in the remedy
        (5, 0, "int16", {}, "0", "0"),
        (5, 7, "int32", {"scale": (0.01, -50.0)}, "-49.93", "7"),
        (0, 0, "int16", {}, "", ""),  # whole metres are no plateaus
        (2, 0, "float64", {}, "", ""),  # 5.0%
        (5, 0, "float64", {"nodata": 0}, "", ""),
        (5, np.nan, "float64", {}, "", ""),
        (40, 7, "float64", {}, "", ""),  # one height
    ],
)
def test_undeclared_void_is_noted_with_value_and_share(rows, value, dtype, options, height, stored, tmp_path):
    plane = PLANE * 100 if "scale" in options else PLANE
    heights = (plane if dtype.startswith("float") else plane.round()).astype(dtype)
    heights[:rows] = value
    paths = {name: write(tmp_path / name, heights, **options) for name in ("a.tif", "b.tif")}
    notes = plateau_notes("dsm", paths)
    assert bool(notes) == bool(height)
    for note in notes:
        assert f"dsm: many cells have the exact height {height}: a.tif (12.5%), b.tif (12.5%);" in note
        assert note.endswith(f"gdal_translate -a_nodata {stored} FILE NEW.tif")


def test_text_is_read_and_damaged_files_are_left_out(tmp_path):
    heights = PLANE.copy()
    heights[:5] = -9999
    path = write_xyz(tmp_path / "a.xyz", heights, 295500.0, 5629500.0)
    (note,) = plateau_notes("dsm", {path.name: path})
    assert "many cells have the exact height -9999: a.xyz (12.5%);" in note
    (tmp_path / "b.tif").write_bytes(b"no raster")
    assert plateau_notes("dsm", {name: tmp_path / name for name in ("b.tif", "gone.xyz", "gone.tif")}) == []
