"""Barbican, London, in all formats of exports: read back, the heights equal the fitted surfaces."""

import csv
import json
import shutil
import zipfile
from xml.etree import ElementTree

import geopandas
import numpy as np
import pyopencrg
import pytest
import rasterio
import shapely
from pyproj import Transformer
from rio_cogeo import cog_validate

from flexroad import open_run
from flexroad.catalog import Catalog
from flexroad.catalog.sources.rasters import index
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.driver import export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select
from tests.read_exports import OFFSET_M, off_surface, spline_heights, true_heights, vertices
from tests.read_opendrive import quality_issues
from tests.real.streets import STREETS
from tests.validators.gltf import gltf_issues
from tests.validators.opencascade import read_step
from tests.validators.opendrive import by_carla, by_sumo, in_crs, printed_mm

pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def barbican(real_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("barbican")
    with zipfile.ZipFile(real_data / "umep" / "London_BNG.zip") as archive:
        archive.extractall(folder)
    layers = {"dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "road_mask": "landcover*.tif"}
    catalog = Catalog(tuple(index(folder / "London_BNG", layers, road_values=(1,)).tiles))
    run = Run.create(folder / "run", load_config("production"), catalog)
    run_tiles(run, SerialExecutor())
    return run.path


@pytest.fixture(scope="module")
def exported(barbican, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    lines = geopandas.GeoDataFrame(
        {"name": list(STREETS), "width": 9.0, "lanes": 2},
        geometry=[shapely.LineString(places) for places in STREETS.values()],
        crs="EPSG:27700",
    )
    lines.to_file(out / "streets.gpkg")
    options = Options(Datum("offset", str(OFFSET_M)), roads=str(out / "streets.gpkg"), left_hand=True)
    export(select(barbican), out, list(FORMATS), options, SerialExecutor())
    return out


@pytest.fixture(scope="module")
def tiles(barbican):
    return {tile.id: tile for tile in select(barbican).finished()}


def test_vertices_lie_on_the_surface(barbican, exported):
    for name, points in vertices(exported, "EPSG:27700").items():
        assert len(points) > 100_000
        error = off_surface(barbican, points)
        # On a slope, the error in plan is also one in height; vertices on borders may be just outside.
        assert np.nanmax(error) <= 2 * FORMATS[name].precision_m, name
        assert np.isfinite(error).mean() > 0.99


def test_step_is_the_surface_of_each_tile(tiles, exported):
    for name, tile in tiles.items():
        valid, points = read_step(exported / "step" / f"{name}.stp", 30)
        assert valid
        place = json.loads((exported / "step" / f"{name}_stp.json").read_text())
        west, south, east, north = place["bounds"]
        x, y = (points[:, :2] + place["origin"][:2]).T
        assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((west, east, south, north), abs=1e-8)
        # A northing of 181,750 m has a rounding error of 3e-11 m; slopes here are below 10.
        np.testing.assert_allclose(points[:, 2], without_steps(tile.surface).height(x, y), rtol=0, atol=1e-9)


def test_glb_files_have_no_issue(exported):
    files = sorted((exported / "3dtiles").rglob("*.glb"))
    assert len(files) > 9
    assert gltf_issues(files) == []


def test_opencrg_is_within_2_mm_of_the_surface(barbican, exported):
    """By PyOpenCRG, at places in the run's CRS; beyond the ends of a road it repeats the last heights."""
    with (exported / "crg" / "roads.csv").open() as file:
        roads = list(csv.DictReader(file))
    assert {road["name"] for road in roads} == set(STREETS)
    root = ElementTree.parse(next((exported / "xodr").glob("*.xodr"))).getroot()
    degrees = Transformer.from_crs("EPSG:27700", "EPSG:4326", always_xy=True)
    frame = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step "
        + root.findtext("header/geoReference")
    )
    for road, rng in zip(roads, np.random.default_rng(0).spawn(len(roads)), strict=True):
        line = shapely.LineString(STREETS[road["name"]])
        along = shapely.line_interpolate_point(line, rng.uniform(3, line.length - 3, 2000))
        places = shapely.get_coordinates(along) + rng.uniform(-2, 2, (2000, 2))
        crg = pyopencrg.CrgRoad.read(exported / "crg" / f"{road['id']}.crg")
        height = crg.xy_to_z(*frame.transform(*degrees.transform(*places.T)))
        error = np.abs(height - spline_heights(barbican, places))
        assert error.max() < 2e-3
        assert float(road["crg_max_mm"]) < 2


def test_opendrive_has_no_issue(exported, tmp_path):
    file = shutil.copy(next((exported / "xodr").glob("*.xodr")), tmp_path / "roads.xodr")
    assert quality_issues(file) == []


@pytest.mark.parametrize("program", ["carla", "sumo"])
def test_opendrive_in_other_programs_is_within_the_error_of_the_report(barbican, exported, tmp_path, program):
    (file,) = (exported / "xodr").glob("*.xodr")
    roads, places = by_carla(file) if program == "carla" else by_sumo(file, tmp_path)
    x, y = in_crs(file, "EPSG:27700", *places[:, :2].T)
    error = 1000 * np.abs(places[:, 2] - open_run(barbican).height(x, y))
    columns = ("elevation_max_mm", "carriageway_steps_max_mm")
    printed = printed_mm(file.with_name("roads.csv"), *columns)
    assert set(roads) == set(printed)
    known = np.isfinite(error)
    assert known.mean() > 0.99
    assert (error <= [printed[road] for road in roads])[known].all()


def test_mosaic_has_the_heights_of_the_surfaces(barbican, exported):
    for file in (exported / "mosaic").glob("*.tif"):
        assert cog_validate(file)[0]
    with rasterio.open(exported / "mosaic" / "height.tif") as raster:
        heights = raster.read(1, masked=True)
        rows, columns = np.nonzero(~np.ma.getmaskarray(heights))
        x, y = raster.xy(rows, columns)
    truth = true_heights(barbican, np.column_stack([x, y]))
    np.testing.assert_allclose(heights[rows, columns], truth, rtol=0, atol=FORMATS["mosaic"].precision_m)


def test_road_lines_lie_on_the_surface(barbican, exported):
    (file,) = (exported / "lines").glob("*.gpkg")
    roads = geopandas.read_file(file, layer="roads")
    assert set(roads["name"]) == set(STREETS)
    places = shapely.get_coordinates(roads.geometry, include_z=True)
    assert len(places) > 800
    # The ends lie on the limit of the tiles or of the survey.
    heights = spline_heights(barbican, places[:, :2])
    known = np.isfinite(heights)
    assert known.mean() > 0.99
    np.testing.assert_allclose(places[known, 2], heights[known], rtol=0, atol=1e-4)
