"""Rasters without heights or a place are named by `flexroad catalog` and by `load`; messages of GDAL."""

import subprocess
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
import rasterio

from flexroad.catalog import CatalogError, Grid, Layer, Tile
from flexroad.catalog.scan.rasters import quiet
from flexroad.catalog.sources import rasters
from flexroad.tasks import TaskError
from flexroad.tasks.load import Options, load
from tests.make_rasters import UTM, write

GRID = Grid(UTM, 295_500.0, 5_629_500.0, 1.0, 20, 20)
HEIGHTS = np.full((20, 20), 100, np.float32)


def bands(path, count, dtype="uint8", **profile):
    write(path, np.ones((20, 20), dtype), count=count, **profile)
    if profile.get("photometric") == "PALETTE":
        with rasterio.open(path, "r+") as raster:
            raster.write_colormap(1, {0: (0, 0, 0), 1: (9, 9, 9)})


def refused(root, name, match):
    """Check that a DSM is refused by both commands; a DTM is beside it."""
    with pytest.raises(CatalogError, match=f"skipped {name} .dsm.: it {match}") as error:
        rasters.index(root, {"dsm": name, "dtm": "dtm.tif"})
    assert "\n" not in str(error.value)
    layers = Layer("dsm", (name,)), Layer("dtm", ("dtm.tif",))
    with pytest.raises(TaskError, match=f"dsm {name} {match}") as failed:
        load(Tile("t", GRID, layers, root=str(root), datetime=datetime.now(UTC)), Options())
    assert "\n" not in str(failed.value)


@pytest.mark.parametrize(
    ("count", "more", "match"),
    [
        (
            3,
            {"photometric": "RGB"},
            r"has 3 bands \(red, green, blue\), but heights are one; keep theirs",
        ),
        (2, {"photometric": "MINISBLACK"}, r"has 2 bands \(gray, undefined\), but heights are one"),
        (1, {"photometric": "PALETTE"}, "has a palette of colours, no heights; give a raster of heights"),
        (1, {"dtype": "complex64"}, r"has complex numbers \(complex64\), no heights; give a raster"),
    ],
)
def test_raster_without_heights_is_refused(tmp_path, count, more, match):
    write(tmp_path / "dtm.tif", HEIGHTS)
    bands(tmp_path / "a.tif", count, **more)
    refused(tmp_path, "a.tif", match)


def test_alpha_band_is_no_height_and_bands_described_as_road_height_are_heights(tmp_path):
    write(tmp_path / "dtm.tif", HEIGHTS)
    bands(tmp_path / "dsm.tif", 2, "uint8", photometric="MINISBLACK", alpha="YES")
    bands(tmp_path / "road_height.tif", 3, "float32")
    patterns = {"dsm": "dsm.tif", "dtm": "dtm.tif", "road_height": "road_height.tif"}
    with pytest.raises(CatalogError, match="road_height.*has 3 bands"):
        rasters.index(tmp_path, patterns, tile_size_m=20, min_cover=0)
    with rasterio.open(tmp_path / "road_height.tif", "r+") as raster:
        raster.descriptions = ("height", "count", "spread")
    (tile,) = rasters.index(tmp_path, patterns, tile_size_m=20, min_cover=0).tiles
    assert tile.layer("road_height").files == ("road_height.tif",)


@pytest.mark.parametrize(
    ("numbers", "match"),
    [
        ("295500, 0, 0, 5629500, 0, -1", "has cells of 0 x -1; give it its georeference"),
        ("295500, 1, 0, 5629500, 0, 0", "has cells of 1 x 0; give it"),
        (
            "nan, 1, 0, 5629500, 0, -1",
            "has the origin nan, 5.6295e.06 and cells of 1 x -1, which is no",
        ),
        ("295500, 1, 0, inf, 0, -1", "has the origin 295500, inf and cells of"),
        ("295500, inf, 0, 5629500, 0, -1", "has the origin .* and cells of inf x -1, which is no place"),
        ("1e300, 1, 0, 5629500, 0, -1", r"reaches from 1e.300, .* which is no place"),
    ],
)
def test_raster_at_no_place_is_refused(tmp_path, numbers, match):
    write(tmp_path / "dtm.tif", HEIGHTS)
    place = f"<SRS>{UTM}</SRS><GeoTransform>{numbers}</GeoTransform>"
    nowhere = {"crs": None, "transform": rasterio.Affine.identity()}
    write(tmp_path / "a.png", HEIGHTS.astype(np.uint8), driver="PNG", **nowhere)
    (tmp_path / "a.png.aux.xml").write_text(f"<PAMDataset>{place}</PAMDataset>")
    refused(tmp_path, "a.png", match)


VRT = b"""<VRTDataset rasterXSize="9" rasterYSize="9">
<VRTRasterBand dataType="\xff" band="1"/></VRTDataset>"""
READ = """
import sys, rasterio
from flexroad.catalog.scan.rasters import quiet
try:
    with quiet(), rasterio.open(sys.argv[1]):
        pass
except (rasterio.RasterioIOError, UnicodeDecodeError):
    print("refused")
"""


def test_message_that_is_no_text_prints_nothing(tmp_path):
    (tmp_path / "a.vrt").write_bytes(VRT)
    words = (sys.executable, "-c", READ, tmp_path / "a.vrt")
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("refused\n", "")


def test_other_errors_are_still_printed(monkeypatch):
    seen = []
    monkeypatch.setattr(sys, "unraisablehook", lambda event: seen.append(event.exc_type))
    monkeypatch.setattr(sys, "excepthook", lambda kind, value, trace: seen.append(kind))
    before = sys.unraisablehook, sys.excepthook

    class Fails:
        def __del__(self):
            raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no text")

    with quiet(), quiet():
        assert (sys.unraisablehook, sys.excepthook) != before
        Fails()
        sys.excepthook(KeyError, KeyError("a"), None)
        with pytest.raises(UnicodeDecodeError) as error:
            b"\xff".decode()
        sys.excepthook(UnicodeDecodeError, error.value, error.tb)
    assert seen == [UnicodeDecodeError, KeyError, UnicodeDecodeError]
    assert (sys.unraisablehook, sys.excepthook) == before
