"""The mosaic has the surface of the run at every cell, and nothing where no tile is finished."""

import resource
import signal
import subprocess
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer
from rio_cogeo import cog_validate
from scipy.ndimage import map_coordinates

from flexroad.catalog import Grid
from flexroad.catalog.storage.scratch import LOCK
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tools.export import mosaic
from flexroad.tools.export.driver import export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.source import Options, select
from tests import validators

NAMES = ("height", "normal", "road", "height_source")
FINE_M = 0.2


@pytest.fixture(scope="module")
def written(town, tmp_path_factory):
    out = tmp_path_factory.mktemp("mosaic")
    export(select(town.path), out, ["mosaic"], Options(), SerialExecutor())
    return out / "mosaic"


@pytest.fixture(scope="module")
def fine(town, tmp_path_factory):
    """A mosaic with cells of 0.2 m, which has overviews."""
    out = tmp_path_factory.mktemp("fine")
    export(select(town.path), out, ["mosaic"], Options(resolution_m=FINE_M), SerialExecutor())
    return out / "mosaic"


def centres(raster):
    """Eastings and northings of the cell centres."""
    columns, rows = np.arange(raster.width) + 0.5, np.arange(raster.height) + 0.5
    step = raster.transform
    return np.meshgrid(step.c + columns * step.a, step.f + rows * step.e)


def test_rasters_have_the_cells_of_the_tiles_of_the_run(town, written):
    for name in ("height", "road", "height_source"):
        with (
            rasterio.open(written / f"{name}.tif") as whole,
            rasterio.open(town.path / f"{name}.vrt") as tiles,
        ):
            assert whole.shape == (120, 120)
            assert whole.transform.almost_equals(tiles.transform)
            everywhere, expected = whole.read(1, masked=True), tiles.read(1)
            np.testing.assert_array_equal(everywhere.compressed(), expected[~everywhere.mask])
            # Only the tile that is not finished has no values.
            assert everywhere.mask.sum() == 60 * 60
    assert everywhere.mean() > 0


@pytest.mark.parametrize("which", ["written", pytest.param("fine", marks=pytest.mark.slow)])
def test_heights_and_normals_are_those_of_the_surface(town, which, request):
    folder = request.getfixturevalue(which)
    with rasterio.open(folder / "height.tif") as raster:
        heights, (x, y) = raster.read(1), centres(raster)
    with rasterio.open(folder / "normal.tif") as raster:
        # GDAL programs apply the scale of the file.
        stored = raster.read()
        normals = np.moveaxis(stored * np.array(raster.scales)[:, None, None], 0, -1)
        np.testing.assert_array_equal((stored == raster.nodata).all(axis=0), np.isnan(heights))
    known = ~np.isnan(heights)
    assert known.mean() == pytest.approx(0.75)
    expected, directions = town.at(x[known], y[known])
    assert np.abs(heights[known] - expected).max() <= FORMATS["mosaic"].precision_m
    # Half a step per component, of three components.
    assert np.linalg.norm(normals[known] - directions, axis=1).max() <= 1.8 * 0.5 / 32767
    assert np.ptp(normals[known], axis=0).min() > 0.005


@pytest.mark.parametrize("name", NAMES)
def test_rasters_are_cloud_optimised_and_say_what_they_are(town, written, fine, name):
    for folder in (written, fine):
        valid, errors, warnings = cog_validate(folder / f"{name}.tif", strict=True)
        assert (valid, errors, warnings) == (True, [], [])
    with rasterio.open(fine / f"{name}.tif") as raster:
        assert raster.res == (FINE_M, FINE_M)
        assert raster.crs.to_epsg() == 25832
        assert raster.descriptions[0].startswith(name)
        assert raster.tags(1)["MEANING"]
        assert raster.profile["compress"] == "deflate"
        assert raster.nodata is not None
        assert raster.overviews(1) == [2]


def test_mosaic_does_not_depend_on_the_memory_of_gdal(town, written, tmp_path, monkeypatch):
    """With no memory, blocks are written as soon as a tile has been added."""
    monkeypatch.setattr(mosaic, "CACHE_BYTES", 256)
    export(select(town.path), tmp_path, ["mosaic"], Options(), SerialExecutor())
    for name in NAMES:
        with (
            rasterio.open(tmp_path / "mosaic" / f"{name}.tif") as a,
            rasterio.open(written / f"{name}.tif") as b,
        ):
            np.testing.assert_array_equal(a.read(), b.read())


def test_overviews_are_averages_of_heights_and_most_frequent_classes(fine):
    with rasterio.open(fine / "height.tif") as raster:
        whole = raster.read(1).astype(float)
        half = raster.read(1, out_shape=(300, 300))
    parts = whole.reshape(300, 2, 300, 2)
    known = ~np.isnan(half)
    np.testing.assert_allclose(half[known], parts.mean(axis=(1, 3))[known], atol=1e-4)
    with rasterio.open(fine / "road.tif") as raster:
        whole, half = raster.read(1), raster.read(1, out_shape=(300, 300))
    assert set(np.unique(half)) == {0, 1, mosaic.NO_ROAD}
    # A road cell of an overview has at least two road cells of four.
    assert ((whole == 1).reshape(300, 2, 300, 2).sum(axis=(1, 3))[half == 1] >= 2).all()


def test_heights_with_a_vertical_crs_have_a_compound_crs(town, tmp_path, monkeypatch):
    source = select(town.path)
    source.__dict__["vertical"] = "EPSG:7837"
    export(source, tmp_path, ["mosaic"], Options(), SerialExecutor())
    with rasterio.open(tmp_path / "mosaic" / "height.tif") as raster:
        assert [part.to_epsg() for part in CRS(raster.crs.to_wkt()).sub_crs_list] == [25832, 7837]
    with rasterio.open(tmp_path / "mosaic" / "road.tif") as raster:
        assert raster.crs.to_epsg() == 25832


def test_whole_grid_of_a_cell_size_has_multiples_of_it():
    a = Grid("EPSG:25832", 500030.5, 5600100.0, 1.0, 50, 50)
    b = replace(a, west=500200.0)
    assert mosaic.whole_grid([a, b], 25.0) == Grid("EPSG:25832", 500025.0, 5600100.0, 25.0, 9, 2)
    # 5600100 / 0.1 is not a whole number in the arithmetic of computers.
    assert mosaic.whole_grid([a], 0.1).shape == (500, 500)
    with pytest.raises(ConfigError, match="several sizes or lattices; give --resolution METRES"):
        mosaic.whole_grid([a, b], None)
    with pytest.raises(ConfigError, match="--resolution 1e-09: .* cells are too many"):
        mosaic.whole_grid([a, b], 1e-9)


@pytest.mark.parametrize("part", [0.3, 0.99])
def test_full_disk_leaves_no_file(town, written, tmp_path, monkeypatch, part):
    """Also if the disk is full only when GDAL closes the file, which it does not report."""
    limit = int(part * (written / "height.tif").stat().st_size)
    finish = mosaic._finish
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)

    def full(*arguments):
        ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, unlimited[1]))
        try:
            finish(*arguments)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
            signal.signal(signal.SIGXFSZ, ignored)

    monkeypatch.setattr(mosaic, "_finish", full)
    with pytest.raises(OSError, match="height.tif"):
        export(select(town.path), tmp_path, ["mosaic"], Options(), SerialExecutor())
    assert list((tmp_path / "mosaic").iterdir()) == []


def test_files_of_an_export_that_was_killed_are_removed_and_rasters_have_styles_for_qgis(town, tmp_path):
    of_killed = tmp_path / "mosaic" / ".flexroad-killed"
    of_killed.mkdir(parents=True)
    (of_killed / "height").write_bytes(b"draft")
    (of_killed / LOCK).touch()
    export(select(town.path), tmp_path, ["mosaic"], Options(), SerialExecutor())
    found = {file.name: file.read_bytes() for file in (tmp_path / "mosaic").iterdir()}
    assert found.keys() == {f"{name}.tif" for name in NAMES} | {"height.qml", "road.qml", "height_source.qml"}
    assert b'type="hillshade"' in found["height.qml"]
    assert b'label="Hidden ground' in found["height_source.qml"]


def sumo_heights(folder, raster, x, y):
    """The heights that SUMO's netconvert gives to nodes, NaN where it gives none, and its warnings."""
    to_degrees = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True)
    nodes, edges = ElementTree.Element("nodes"), ElementTree.Element("edges")
    for number, (east, north) in enumerate(zip(*to_degrees.transform(x, y), strict=True)):
        ElementTree.SubElement(nodes, "node", id=str(number), x=f"{east:.10f}", y=f"{north:.10f}")
        if number % 2:
            ends = {"from": str(number - 1), "to": str(number)}
            ElementTree.SubElement(edges, "edge", {"id": f"e{number}", "numLanes": "1", **ends})
    ElementTree.ElementTree(nodes).write(folder / "nodes.xml")
    ElementTree.ElementTree(edges).write(folder / "edges.xml")
    command = [validators.program("netconvert"), "-n", "nodes.xml", "-e", "edges.xml", "-o", "net.xml"]
    command += ["--heightmap.geotiff", raster, "--proj.utm", "--precision", "6"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    heights = np.full(len(x), np.nan)
    for junction in ElementTree.parse(folder / "net.xml").getroot().iter("junction"):
        if junction.get("id").isdigit():
            heights[int(junction.get("id"))] = float(junction.get("z", "nan"))
    return heights, done.stderr


@pytest.mark.parametrize("vertical", [None, "EPSG:7837"])
def test_sumo_gives_the_nodes_of_a_network_the_heights_of_the_mosaic(town, tmp_path, vertical):
    source = select(town.path)
    source.__dict__["vertical"] = vertical
    export(source, tmp_path, ["mosaic"], Options(), SerialExecutor())
    raster = tmp_path / "mosaic" / "height.tif"
    west, south, east, north = town.tiles[0].grid.bounds
    # A quarter of the nodes lies on the second tile.
    x, y = np.random.default_rng(0).uniform([west + 1, south + 1], [east - 1, north - 1], (200, 2)).T
    x[:50] += town.tiles[1].grid.west - west
    y[:50] += town.tiles[1].grid.south - south
    heights, said = sumo_heights(tmp_path, raster, x, y)
    assert "height" not in said
    with rasterio.open(raster) as file:
        columns, rows = ~file.transform @ (x, y)
        between = map_coordinates(file.read(1).astype(float), [rows - 0.5, columns - 0.5], order=1)
    # Between cells a step beside a road is a slope, on which SUMO's rounding of places is one of heights.
    smooth = town.is_smooth(x, y, town.tiles[0].grid.cell)
    assert smooth.mean() > 0.3
    # SUMO interpolates between the cell centres.
    assert np.abs(heights - between)[smooth].max() < 0.005
    surface, _ = town.at(x, y)
    assert np.median(np.abs(heights - surface)[smooth]) < 0.002
    assert np.abs(heights - surface)[smooth].max() < 0.03
    missing = town.tiles[3].grid.bounds
    heights, said = sumo_heights(
        tmp_path, raster, np.add(missing[::2], [5, -5]), np.add(missing[1::2], [5, -5])
    )
    assert np.isnan(heights).all()
    assert said.count("Could not get height data") == 2
