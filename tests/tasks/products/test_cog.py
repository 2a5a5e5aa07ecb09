from xml.etree import ElementTree as ET

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rasterio.io import MemoryFile
from rio_cogeo import cog_validate

from flexroad.catalog.grid import Grid
from flexroad.tasks.errors import TaskError
from flexroad.tasks.products import cog
from flexroad.tasks.quality.height_source import HeightSource

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 600, 250)


def plane(grid: Grid) -> np.ndarray:
    heights = 100 + 0.01 * (grid.eastings - grid.west) + 0.02 * (grid.northings[:, None] - grid.south)
    heights[:5, :7] = np.nan
    return heights


def test_encode_reads_back_in_place():
    with MemoryFile(cog.encode(plane(GRID), GRID, cog.HEIGHT)) as file, file.open() as raster:
        assert np.isnan(raster.nodata)
        assert raster.overviews(1) == [2]
        assert raster.crs.to_epsg() == 25832
        assert raster.bounds == GRID.bounds
        np.testing.assert_array_equal(raster.read(1), plane(GRID).astype(np.float32))
        easting, northing = 295500.0 + 400.5, 5629250.0 + 200.5
        (value,) = next(raster.sample([(easting, northing)]))
    assert value == pytest.approx(100 + 0.01 * 400.5 + 0.02 * 200.5, abs=1e-5)
    road = plane(GRID) > 104
    with MemoryFile(cog.encode(road, GRID, cog.ROAD)) as file, file.open() as raster:
        np.testing.assert_array_equal(raster.read(1), road)


def test_encode_height_with_vertical_crs_has_compound_crs():
    with MemoryFile(cog.encode(plane(GRID), GRID, cog.HEIGHT, "EPSG:7837")) as file, file.open() as raster:
        plan, height = CRS(raster.crs.to_wkt()).sub_crs_list
        assert (plan.to_epsg(), height.to_epsg()) == (25832, 7837)
        assert raster.bounds == GRID.bounds


@pytest.mark.parametrize(
    ("band", "values"),
    [
        (cog.HEIGHT, plane(GRID)),
        (cog.ROAD, plane(GRID) > 104),
        (cog.HEIGHT_SOURCE, np.full(GRID.shape, HeightSource.DTM, np.uint8)),
    ],
    ids=["height", "road", "height_source"],
)
def test_encoded_raster_declares_what_its_band_means(band, values):
    with MemoryFile(cog.encode(values, GRID, band)) as file, file.open() as raster:
        assert raster.dtypes == (band.dtype,)
        assert raster.descriptions == (band.name,)
        assert raster.units == (band.unit or None,)
        tags = raster.tags(1)
        assert tags["MEANING"] == band.meaning
        assert [c.value for c in band.classes] == list(range(len(band.classes)))
        colours = raster.colormap(1) if band.classes else {}
        for c in band.classes:
            assert colours[c.value][:3] == c.colour
            assert tags[f"CLASS_{c.value}"].startswith(f"{c.name}: ")


def test_encode_mask_keeps_wkt():
    wkt = CRS.from_proj4("+proj=tmerc +lat_0=50 +lon_0=7 +ellps=GRS80 +units=m").to_wkt()
    grid = Grid(wkt, 0.0, 20.0, 0.5, 40, 40)
    with MemoryFile(cog.encode(np.ones(grid.shape, bool), grid, cog.ROAD)) as file, file.open() as raster:
        (latitude,) = [
            p.value for p in CRS(raster.crs.to_wkt()).coordinate_operation.params if "lat" in p.name.lower()
        ]
        assert latitude == 50
        assert raster.res == (0.5, 0.5)


def test_encode_height_wrong_shape_raises():
    with pytest.raises(TaskError, match=r"\(250, 599\).*\(250, 600\)"):
        cog.encode(plane(GRID)[:, 1:], GRID, cog.HEIGHT)


@pytest.mark.parametrize(("size", "block"), [(250, 256), (256, 256), (40, 48), (600, 512)])
def test_encode_block_is_as_large_as_a_small_raster(size, block, tmp_path):
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, size, 30)
    file = tmp_path / "height.tif"
    file.write_bytes(cog.encode(np.zeros(grid.shape), grid, cog.HEIGHT))
    assert cog_validate(file, strict=True) == (True, [], [])
    with rasterio.open(file) as raster:
        assert raster.block_shapes == [(block, block)]


@pytest.mark.parametrize("band", [cog.ROAD, cog.HEIGHT_SOURCE], ids=["road", "height_source"])
def test_encode_style_classes_have_the_names_and_colours_of_the_raster(band):
    renderer = ET.fromstring(cog.encode_style(band)).find("pipe/rasterrenderer")
    assert (renderer.attrib["type"], renderer.attrib["band"]) == ("paletted", "1")
    entries = [
        (int(entry.attrib["value"]), entry.attrib["label"], bytes.fromhex(entry.attrib["color"][1:]))
        for entry in renderer.iter("paletteEntry")
    ]
    # Nodata is transparent.
    assert entries == [(c.value, c.meaning, bytes(c.colour)) for c in band.classes if c.value != band.nodata]
    heights = ET.fromstring(cog.encode_style(cog.HEIGHT)).find("pipe/rasterrenderer")
    assert (heights.attrib["type"], len(heights)) == ("hillshade", 0)
