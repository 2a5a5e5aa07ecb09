import sys
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from PIL import Image

from flexroad.catalog import Catalog
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.prepare.asked import Asked
from flexroad.pipeline.prepare.photos import PhotosAsked, _resolved, prepare_photos
from flexroad.tasks import TaskError
from flexroad.tasks.acquire.photos import mvs_cpu, sfm
from flexroad.tasks.acquire.points import to_rasters
from tests import make_photos

pytestmark = pytest.mark.slow

ASKED = PhotosAsked(
    sfm=sfm.Options(image_size=640, features=1500, threads=2, calibrate="held"),
    stereo=mvs_cpu.Options(size=480, partners=3),
)


def prepare(images, out, asked, say=lambda line: None):
    return prepare_photos(
        images, out, asked, ASKED, to_rasters.Options(ground="filter"), SerialExecutor(), say
    )


def test_photographs_become_the_rasters_of_the_hill(tmp_path):
    (tmp_path / "photos").mkdir()
    make_photos.photographs(tmp_path / "photos")
    said = []
    published = prepare(
        [tmp_path / "photos"], tmp_path / "out", Asked(cell_m=0.5, dop_cell_m=0.25), said.append
    )
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.datetime.isoformat() == "2024-05-17T10:30:00+00:00"
    assert tile.dataset == "8 photographs (Test Made)"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "catalog.parquet",
        "dop.tif",
        "dsm.tif",
        "dtm.tif",
    ]
    # Finer than the stereo resolves: taken coarser, and said.
    assert any("cells of 0.5 m and pixels of 0.5 m, not 0.5 m and 0.25 m" in note for note in published.notes)
    assert any("semi-global matching on the CPU" in line for line in said)
    with rasterio.open(tmp_path / "out" / "dsm.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert "heights above mean sea level, uncorrected" in raster.tags()["SOURCE"]
        dsm = raster.read(1)
    east, north = np.meshgrid(tile.grid.eastings, tile.grid.northings)
    wrong = (dsm - make_photos.ground(east, north))[np.isfinite(dsm)]
    # The highest of the points in a cell lies above its centre: by half the slope at most, and the noise.
    assert np.abs(np.median(wrong)) < 0.2
    assert np.quantile(np.abs(wrong - np.median(wrong)), 0.95) < 0.3
    assert np.isfinite(dsm).sum() * tile.grid.cell**2 > 1200


@pytest.mark.parametrize(
    ("asked", "taken"), [((1.0, 0.5), (1.0, 0.5)), ((0.1, 0.1), (0.5, 0.5)), ((1.25, 0.25), (1.5, 0.5))]
)
def test_cells_are_no_finer_than_four_pixels_of_the_stereo(asked, taken):
    coarser, notes = _resolved(Asked(cell_m=asked[0], dop_cell_m=asked[1]), pixel_m=0.08)
    assert (coarser.cell_m, coarser.dop_cell_m) == taken
    assert bool(notes) == (asked != taken)
    assert coarser.step_m == max(taken)


@pytest.mark.parametrize("spoil", ["gps", "pycolmap", "empty", "missing"])
def test_what_cannot_be_used_leaves_nothing(tmp_path, monkeypatch, spoil):
    folder = tmp_path / "photos"
    folder.mkdir()
    centre = np.array([*make_photos.CORNER, 140.0])
    for number in range(0 if spoil == "empty" else 3):
        tags = Image.Exif() if spoil == "gps" else make_photos.exif(centre + number)
        Image.new("RGB", (64, 48)).save(folder / f"{number}.jpg", exif=tags)
    if spoil == "pycolmap":
        monkeypatch.setitem(sys.modules, "pycolmap", None)
    told = {
        "gps": r"0\.jpg has no GNSS position",
        "pycolmap": "pip install",
        "empty": "has no photographs",
        "missing": "is no file or folder",
    }
    with pytest.raises((TaskError, ConfigError), match=told[spoil]):
        prepare([folder / "nowhere" if spoil == "missing" else folder], tmp_path / "out", Asked())
    assert not (tmp_path / "out").exists()


def test_a_failure_in_the_middle_keeps_what_was_there(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "dsm.tif").write_text("old")
    centre = np.array([*make_photos.CORNER, 140.0])
    for number in range(3):
        Image.new("RGB", (320, 240)).save(tmp_path / f"{number}.jpg", exif=make_photos.exif(centre + number))
    with pytest.raises(TaskError, match="none of the 3 photographs match"):
        prepare(sorted(tmp_path.glob("*.jpg")), tmp_path / "out", replace(Asked(), cell_m=1))
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["dsm.tif"]
