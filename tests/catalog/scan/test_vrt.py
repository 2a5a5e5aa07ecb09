"""A VRT may be nothing but a plain mosaic: whatever is not known to be harmless is refused."""

from pathlib import Path

import pytest

from flexroad.catalog.guard.open_raster import vrt_sources
from flexroad.catalog.guard.refused import Refused

BAND = '<VRTRasterBand dataType="Byte" band="1">{}</VRTRasterBand>'
SOURCE = "<SimpleSource>{}</SimpleSource>"
FILE = '<SourceFilename relativeToVRT="1">a.tif</SourceFilename>'


def dataset(inner, attributes=""):
    return f'<VRTDataset rasterXSize="2" rasterYSize="2"{attributes}>{inner}</VRTDataset>'


def check_refused(path, text, match="only mosaics"):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(Refused, match=match):
        vrt_sources(path)


def test_sources_are_full_names(tmp_path):
    path = tmp_path / "a.vrt"
    names = ('"1">b/../a.tif', '"0">/data/b &amp; c.tif')
    files = "".join(SOURCE.format(f"<SourceFilename relativeToVRT={name}</SourceFilename>") for name in names)
    path.write_text(dataset(BAND.format(files + files)))
    assert vrt_sources(path) == (f"{tmp_path}/b/../a.tif", "/data/b & c.tif")


@pytest.mark.parametrize(
    "name",
    [
        "",
        " a.tif",
        "a.tif ",
        "/vsicurl/http://127.0.0.1/a.tif",
        "//vsicurl/http://127.0.0.1/a.tif",
        "vrt://a.tif",
        "GTIFF_DIR:1:a.tif",
        "http://127.0.0.1/a.tif",
        "&lt;VRTDataset/>",
        "a.tif<!-- -->b",
        "<![CDATA[a.tif]]>",
        "<b/>a.tif",
    ],
)
def test_names_that_gdal_may_take_for_more_are_refused(tmp_path, name):
    text = f'<SourceFilename relativeToVRT="1">{name}</SourceFilename>'
    check_refused(tmp_path / "a.vrt", dataset(BAND.format(SOURCE.format(text))))


@pytest.mark.parametrize(
    "text",
    [
        dataset(BAND.format(SOURCE.format('<SourceFilename relativeToVRT="0">a.tif</SourceFilename>'))),
        dataset(BAND.format(SOURCE.format('<SourceFilename relativeToVRT="1">/a.tif</SourceFilename>'))),
        dataset(BAND.format(SOURCE.format('<SourceFilename relativeToVRT="2">a.tif</SourceFilename>'))),
        dataset(BAND.format(SOURCE.format("<sourcefilename>/etc/a</sourcefilename>" + FILE))),
        dataset(BAND.format('<SimpleSource SourceFilename="/etc/a">' + FILE + "</SimpleSource>")),
        dataset(BAND.format(SOURCE.format(FILE + '<OpenOptions><OOI key="X">1</OOI></OpenOptions>'))),
        dataset(BAND.format("<PixelFunctionType>f</PixelFunctionType>" + SOURCE.format(FILE))),
        dataset(BAND.format("<Overview>" + FILE + "</Overview>")),
        dataset("", ' subClass="VRTWarpedDataset"'),
        dataset('<VRTRasterBand band="1" subClass="VRTDerivedRasterBand"/>'),
        dataset("", ' xmlns="x"'),
        "<!DOCTYPE a [<!ENTITY b SYSTEM '/etc/passwd'>]>" + dataset(""),
        "<?xml version='1.0'?><?other?>" + dataset(""),
        dataset("").encode("utf-16"),
    ],
)
def test_anything_but_a_plain_mosaic_is_refused(tmp_path, text):
    check_refused(tmp_path / "a.vrt", text)


def test_damaged_and_huge_vrt_are_refused(tmp_path, monkeypatch):
    check_refused(tmp_path / "a.vrt", "<VRTDataset>", "damaged")
    check_refused(tmp_path / "b.vrt", b"<VRTDataset>\xff</VRTDataset>", "damaged")
    monkeypatch.setattr("flexroad.catalog.guard.open_raster.MAX_VRT_BYTES", 10)
    check_refused(tmp_path / "c.vrt", dataset(""), "divide it")


def test_vrt_written_by_gdal_is_plain(tmp_path):
    import numpy as np
    import rasterio
    from rasterio.shutil import copy

    from tests.make_rasters import write

    raster = write(
        tmp_path / "a.tif", np.ones((8, 8), np.float32), tags={"A": "b"}, unit="m", scale=(2.0, 1.0)
    )
    with rasterio.open(raster, "r+") as src:
        src.nodata, src.descriptions = -1.0, ["heights"]
    copy(raster, tmp_path / "a.vrt", driver="VRT")
    assert [Path(name).name for name in vrt_sources(tmp_path / "a.vrt")] == ["a.tif"]
