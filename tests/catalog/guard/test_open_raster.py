"""Source rasters are opened only in known formats; neither they nor their side-cars lead to other files."""

import numpy as np
import pytest
import rasterio

from flexroad.catalog.guard.open_raster import open_raster
from flexroad.catalog.guard.source_files import InputRejected
from tests.builders import make_special
from tests.make_rasters import UTM, write, write_xyz

FLAT = np.full((32, 32), 7.0, np.float32)


def vrt(name):
    return (
        f'<VRTDataset rasterXSize="32" rasterYSize="32"><SRS>{UTM}</SRS>'
        "<GeoTransform>295500,1,0,5629500,0,-1</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="0">{name}</SourceFilename><SourceBand>1</SourceBand>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )


def read(path):
    """Read all that the stages read of a raster."""
    with open_raster(path) as src:
        return src.read(1), src.read_masks(1), src.overviews(1), src.read(1, out_shape=(8, 8))


def check_refused(path, match):
    with pytest.raises(InputRejected, match=match):
        read(path)


@pytest.mark.parametrize("driver", ["GTiff", "AAIGrid", "PNG", "JPEG", "JP2OpenJPEG"])
def test_formats_are_read_whatever_the_suffix(tmp_path, driver):
    kind = np.uint8 if driver in ("PNG", "JPEG", "JP2OpenJPEG") else np.float32
    path = write(tmp_path / "a.raster", FLAT.astype(kind), driver=driver)
    with open_raster(path) as src:
        assert src.driver == driver
        np.testing.assert_allclose(src.read(1), FLAT, atol=1)
        assert src.transform.c == 295500
    assert (read(write_xyz(tmp_path / "a.xyz", FLAT, 295500, 5629500))[0] == 7).all()


CONTENT = {
    "vrt": vrt("/vsicurl/{url}/x.tif"),
    "curl": vrt("/vsicurl?url={url}/x.tif"),
    "wms": '<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>'
    "<DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>9</UpperLeftY><LowerRightX>9</LowerRightX>"
    "<LowerRightY>0</LowerRightY><TileLevel>1</TileLevel></DataWindow><Projection>EPSG:3857</Projection>"
    "<BandsCount>1</BandsCount></GDAL_WMS>",
    "wcs": "<WCS_GDAL><ServiceURL>{url}/wcs?</ServiceURL><CoverageName>a</CoverageName></WCS_GDAL>",
    "wmts": "<GDAL_WMTS><GetCapabilitiesUrl>{url}/wmts</GetCapabilitiesUrl></GDAL_WMTS>",
    "capabilities": '<Capabilities xmlns="http://www.opengis.net/wmts/1.0"></Capabilities>',
    "stac": '{{"type":"FeatureCollection","stac_version":"1.0.0","features":[{{"assets":{{"a":'
    '{{"href":"{url}/a.tif"}}}}}}]}}',
    "mosaic": "<GDALTileIndexDataset><IndexDataset>{url}/a.gpkg</IndexDataset></GDALTileIndexDataset>",
    "text": "ncols 2\nnrows 2 <VRTDataset></VRTDataset>",
}


@pytest.mark.parametrize("content", CONTENT.values(), ids=CONTENT)
@pytest.mark.parametrize("name", ["a.tif", "a.asc", "a.vrt"])
def test_content_under_another_name_asks_no_server(tmp_path, web, content, name):
    (tmp_path / name).write_text(content.format(url=web.url))
    check_refused(tmp_path / name, "VRT|it is no GeoTIFF")
    assert web.requests == []


VRT = b'<?xml version="1.0"?><VRTDataset></VRTDataset>'
MARK = b"\xff\xd8\xff\xfe<V<VRTDataset></VRTDataset>\0\0"
"""An image; GDAL searches the mark of a VRT before the first zero byte."""
UNKNOWN = "cannot be read: it is no GeoTIFF.* fetch it again"


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        *[("a.tif", broken, UNKNOWN) for broken in (b"", b"\0" * 99, b"<html>not found</html>", b"PK\3\4")],
        ("a.jpg", MARK, UNKNOWN),
        ("a.vrt", VRT, "is a VRT, which only names other files; give those files by a pattern"),
    ],
)
def test_files_of_no_known_format_are_named_as_such(tmp_path, name, content, match):
    (tmp_path / name).write_bytes(content)
    check_refused(tmp_path / name, match)


VRT_ELSEWHERE = vrt("/vsicurl/WEB/x.tif")
OVERVIEWS = (
    '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="&#79;VERVIEW_FILE">/vsicurl/WEB/o.tif</MDI>'
    "</Metadata></PAMDataset>"
)


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("a.tif.ovr", VRT_ELSEWHERE, "side-car file"),
        ("a.tif.msk", VRT_ELSEWHERE, "side-car file"),
        ("a.tif.aux.xml", OVERVIEWS, "side-car file|overviews"),
        ("a.aux", "EHFA_HEADER_TAG", "side-car file"),
        ("a.tif.ovr.aux.xml", OVERVIEWS, "a.tif.ovr, which names another file"),
        ("a.tif.ovr.ovr", VRT_ELSEWHERE, "a.tif.ovr, which has the side-car file a.tif.ovr.ovr, which is no"),
        ("", "", "names another file as its overviews"),
    ],
)
def test_side_cars_that_lead_elsewhere_are_refused(tmp_path, web, name, content, match):
    path = write(tmp_path / "a.tif", FLAT)
    if name.startswith("a.tif.ovr."):
        write(tmp_path / "a.tif.ovr", FLAT[:16, :16], driver="GTiff")
    assert (read(path)[0] == 7).all()
    if name:
        (tmp_path / name).write_text(content.replace("WEB", web.url))
    else:
        with rasterio.open(path, "r+") as src:
            src.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"/vsicurl/{web.url}/x.tif")
    check_refused(path, match)
    assert web.requests == []


def test_harmless_side_cars_are_used(tmp_path):
    path = write(
        tmp_path / "a.png", FLAT.astype(np.uint8), driver="PNG", transform=rasterio.Affine.identity()
    )
    path.with_name("a.png.aux.xml").unlink(missing_ok=True)
    path.with_suffix(".pgw").write_text("1\n0\n0\n-1\n295500.5\n5629499.5\n")
    path.with_name("a.png.aux.xml").write_text(f"<PAMDataset><SRS>{UTM}</SRS></PAMDataset>")
    with open_raster(path) as src:
        assert (src.transform.c, src.crs) == (295500, UTM)


@pytest.mark.parametrize("kind", ["folder", "pipe", "link to a pipe", "socket"])
@pytest.mark.parametrize("name", ["a.tif", "a.tif.aux.xml", "a.tfw", "a.tif.msk", "a.prj"])
def test_only_regular_files_are_opened(tmp_path, kind, name):
    path = write(tmp_path / "a.tif", FLAT)
    make_special(tmp_path / name, kind)
    check_refused(path, "is not a regular file")


@pytest.mark.parametrize("name", ["a.tif.aux.xml", "a.tfw", "a.tif.ovr", "a.prj"])
def test_side_car_is_no_link_to_another_folder(tmp_path, name):
    path = write(tmp_path / "home" / "a.tif", FLAT)
    secret = write(tmp_path / "secret.tif", FLAT)
    (path.parent / name).symlink_to(secret)
    check_refused(path, f"has the side-car file {name}, which is a link to another folder")


def test_side_car_of_a_folder_of_links_is_used(tmp_path):
    path = write(tmp_path / "a.tif", FLAT, crs=None)
    path.with_name("a.tif.aux.xml").write_text(f"<PAMDataset><SRS>{UTM}</SRS></PAMDataset>")
    (tmp_path / "home").mkdir()
    for name in ("a.tif", "a.tif.aux.xml"):
        (tmp_path / "home" / name).symlink_to(tmp_path / name)
    with open_raster(tmp_path / "home" / "a.tif") as src:
        assert src.crs == UTM


def test_missing_file_is_told_from_a_refused_one(tmp_path):
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "a.tif")
