"""Heights that many cells share exactly are noted."""

import numpy as np
import pytest

from flexroad.catalog.scan.plateaus import plateau_notes
from tests.make_rasters import write, write_xyz

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
