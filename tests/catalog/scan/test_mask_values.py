"""Values of road masks are compared with --road-value."""

import numpy as np
import pytest

from flexroad.catalog.scan import mask_values
from flexroad.catalog.scan.mask_values import mask_notes
from tests.make_rasters import write

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
    monkeypatch.setattr(mask_values, "SIDE", 8)
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
