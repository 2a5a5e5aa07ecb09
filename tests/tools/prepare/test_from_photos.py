import os
import sys

import numpy as np
import pytest
import rasterio
from PIL import Image

from flexroad.catalog import Catalog, CatalogError
from flexroad.catalog.lazy import lazy
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tasks import TaskError
from flexroad.tools.prepare.from_photos import PhotosOptions, _coarsened, prepare_photos
from flexroad.tools.prepare.options import PrepareOptions
from flexroad.tools.prepare.photos import mvs_cpu, sfm
from flexroad.tools.prepare.points import to_rasters
from tests import make_photos

pytestmark = [pytest.mark.slow, pytest.mark.soak("photos")]

PHOTOS_OPTIONS = PhotosOptions(
    sfm=sfm.Options(image_size=640, features=1500, threads=2, calibrate="held"),
    stereo=mvs_cpu.Options(size=480, partners=3),
)


def prepare(images, out, options, log=lambda line: None):
    return prepare_photos(
        images, out, options, PHOTOS_OPTIONS, to_rasters.Options(ground="filter"), SerialExecutor(), log
    )


def test_prepare_photos_reconstructs_the_rendered_hill(tmp_path):
    (tmp_path / "photos").mkdir()
    make_photos.photographs(tmp_path / "photos")
    lines = []
    published = prepare(
        [tmp_path / "photos"], tmp_path / "out", PrepareOptions(cell_m=0.5, dop_cell_m=0.25), lines.append
    )
    (tile,) = Catalog.read(published.catalog).tiles
    assert tile.datetime.isoformat() == "2024-05-17T10:30:00+00:00"
    assert tile.dataset == "8 photographs (Test Made)"
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"catalog.parquet", "dop.tif", "dsm.tif", "dtm.tif", "road_height.tif"}
    # Cells finer than the stereo resolves are made coarser, with a note.
    assert any("cells of 0.5 m and pixels of 0.5 m, not 0.5 m and 0.25 m" in note for note in published.notes)
    assert any("semi-global matching on the CPU" in line for line in lines)
    with rasterio.open(tmp_path / "out" / "dsm.tif") as raster:
        assert raster.crs.to_epsg() == 32632
        assert "heights above mean sea level, uncorrected" in raster.tags()["SOURCE"]
        dsm = raster.read(1)
    east, north = np.meshgrid(tile.grid.eastings, tile.grid.northings)
    error = (dsm - make_photos.ground(east, north))[np.isfinite(dsm)]
    # The highest point of a cell is above its centre: by at most half the slope, plus the noise.
    assert np.abs(np.median(error)) < 0.2
    assert np.quantile(np.abs(error - np.median(error)), 0.95) < 0.3
    assert np.isfinite(dsm).sum() * tile.grid.cell**2 > 1200


@pytest.mark.parametrize(
    ("requested", "expected"),
    [((1.0, 0.5), (1.0, 0.5)), ((0.1, 0.1), (0.5, 0.5)), ((1.25, 0.25), (1.5, 0.5))],
)
def test_coarsened_cells_are_at_least_four_stereo_pixels(requested, expected):
    coarser, notes = _coarsened(PrepareOptions(cell_m=requested[0], dop_cell_m=requested[1]), pixel_m=0.08)
    assert (coarser.cell_m, coarser.dop_cell_m) == expected
    assert bool(notes) == (requested != expected)
    assert coarser.step_m == max(expected)


@pytest.mark.parametrize("invalid", ["gps", "pycolmap", "empty", "missing", "pipe", "unrelated"])
def test_prepare_photos_invalid_input_leaves_no_folder(tmp_path, monkeypatch, invalid):
    folder = tmp_path / "photos"
    folder.mkdir()
    centre = np.array([*make_photos.CORNER, 140.0])
    for number in range(0 if invalid == "empty" else 3):
        tags = Image.Exif() if invalid == "gps" else make_photos.exif(centre + number)
        Image.new("RGB", (64, 48)).save(folder / f"{number}.jpg", exif=tags)
    if invalid == "pipe":
        os.mkfifo(folder / "9.jpg")
    if invalid == "pycolmap":
        monkeypatch.setitem(sys.modules, "pycolmap", None)
        # Earlier tests have loaded it.
        monkeypatch.setattr(sfm, "pycolmap", lazy("pycolmap"))
    messages = {
        "gps": r"0\.jpg has no GNSS position",
        "pycolmap": "pip install",
        "empty": "has no photographs",
        "missing": "does not exist",
        "pipe": "9.jpg is not a file",
        "unrelated": "none of the 3 photographs match",
    }
    with pytest.raises((CatalogError, TaskError, ConfigError), match=messages[invalid]):
        prepare([folder / "nowhere" if invalid == "missing" else folder], tmp_path / "out", PrepareOptions())
    assert not (tmp_path / "out").exists()
