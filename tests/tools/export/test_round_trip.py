"""A simulation engineer's four files agree: OpenDRIVE with OpenCRG, LandXML, GLB, and the surface itself."""

import csv
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from pyproj import Transformer

from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.driver import export
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select
from tests.make_city import CRS, TILE_M, make_city, south_west
from tests.read_exports import on_mesh
from tests.read_opendrive import plan, polynomial

POINTS = 1000
GEOGRAPHIC = "EPSG:4258"
"""Longitude and latitude on the ellipsoid of the OpenDRIVE file, GRS80."""
LANDXML = "{http://www.landxml.org/schema/LandXML-1.2}"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    return make_city(tmp_path_factory.mktemp("round_trip"))


@pytest.fixture(scope="module")
def exported(city):
    out = city.parent / "out"
    options = Options(Datum("offset", "47.5"))
    export(select(city), out, ["crg", "xodr", "landxml", "3dtiles"], options, SerialExecutor())
    return out


@pytest.fixture(scope="module")
def places(city, exported):
    """1,000 random places on the carriageways, by the text of the OpenDRIVE file alone.

    Columns: x, y, easting, northing, height by OpenDRIVE; and the road of each.
    """
    root = ElementTree.parse(next((exported / "xodr").glob("*.xodr"))).getroot()
    roads, rng = root.findall("road"), np.random.default_rng(0)
    lengths = np.array([float(road.attrib["length"]) for road in roads])
    rows, owners = [], []
    for k in rng.choice(len(roads), 2 * POINTS, p=lengths / lengths.sum()):
        road, s = roads[k], rng.uniform(0, lengths[k])
        x, y, heading = plan(road, s)
        t = rng.uniform(-1.5, 1.5)
        slope = np.tan(polynomial(road, "lateralProfile/superelevation", s))
        height = polynomial(road, "elevationProfile/elevation", s) + t * slope
        rows.append((x - t * np.sin(heading), y + t * np.cos(heading), height))
        owners.append(road)
    x, y, height = np.array(rows).T
    proj = root.findtext("header/geoReference")
    degrees = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv {proj} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    ).transform(x, y)
    easting, northing = Transformer.from_crs(GEOGRAPHIC, CRS, always_xy=True).transform(*degrees)
    # Beside the ends of roads there may be no tile.
    west, south = south_west(city)
    east, north = west + 2 * TILE_M, south + 2 * TILE_M
    on = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
    chosen = np.flatnonzero(on)[:POINTS]
    table = np.column_stack([x, y, easting, northing, height])
    return table[chosen], [owners[k] for k in chosen]


@pytest.fixture(scope="module")
def truth(city, places):
    """The height of the fitted surfaces there."""
    _, _, easting, northing, _ = places[0].T
    height = np.full(POINTS, np.nan)
    for tile in select(city).finished():
        west, south, east, north = tile.tile.grid.bounds
        inside = (west <= easting) & (easting <= east) & (south <= northing) & (northing <= north)
        height[inside] = without_steps(tile.surface).height(easting[inside], northing[inside])
    assert np.isfinite(height).all()
    return height


def of_landxml(exported, easting, northing):
    """Return the heights of the surfaces ``road`` and ``ground`` at places, NaN where it has no face."""
    root = ElementTree.parse(next((exported / "landxml").iterdir())).getroot()
    heights = {}
    for surface in root.iter(f"{LANDXML}Surface"):
        points = [p.text.split() for p in surface.iter(f"{LANDXML}P")]
        names = {p.attrib["id"]: k for k, p in enumerate(surface.iter(f"{LANDXML}P"))}
        faces = [[names[name] for name in face.text.split()] for face in surface.iter(f"{LANDXML}F")]
        vertices = np.array(points, float)[:, [1, 0, 2]]
        heights[surface.attrib["name"]] = on_mesh(vertices, np.array(faces), easting, northing)
    return heights["road"], heights["ground"]


def of_glb(city, easting, northing):
    height = np.full(len(easting), np.nan)
    run = Run.open(city)
    for file in sorted(city.glob("tiles/*/*.glb")):
        x, y, z = (mesh := trimesh.load(file).to_geometry()).vertices.T
        vertices = np.column_stack([x + run.origin[0], -z + run.origin[1], y])
        found = on_mesh(vertices, mesh.faces, easting, northing)
        height = np.where(np.isnan(height), found, height)
    return height


def test_opencrg_at_places_of_opendrive_is_within_2_mm_of_the_surface(exported, places, truth):
    pyopencrg = pytest.importorskip("pyopencrg")
    table, owners = places
    height = np.full(POINTS, np.nan)
    for road in {owner.attrib["id"]: owner for owner in owners}.values():
        reference = road.find("surface/CRG").attrib["file"]
        crg = pyopencrg.CrgRoad.read(exported / "xodr" / reference)
        mine = np.array([owner is road for owner in owners])
        height[mine] = crg.xy_to_z(*table[mine, :2].T)
    error = np.abs(height - truth)
    # A line of OpenDRIVE is up to half a chord longer than that of its OpenCRG.
    assert np.isfinite(error).mean() > 0.99
    assert np.nanmax(error) < 0.002


def test_opendrive_alone_misses_the_surface_as_the_report_says(exported, places, truth):
    table, owners = places
    with (exported / "xodr" / "roads.csv").open() as file:
        report = {row["id"]: row for row in csv.DictReader(file)}
    largest = np.array([float(report[owner.attrib["id"]]["profiles_max_mm"]) for owner in owners])
    error = np.abs(table[:, 4] - truth) * 1000
    # Between the nodes of the grid it may be a little more than at them.
    assert (error < 1.2 * largest + 2).all()
    assert error.max() > 5


def test_landxml_glb_and_3d_tiles_agree_and_are_near_the_surface(city, exported, places, truth):
    _, _, easting, northing, _ = places[0].T
    road, ground = of_landxml(exported, easting, northing)
    xml, glb = np.where(np.isnan(road), ground, road), of_glb(city, easting, northing)
    # LandXML has steps of 0.1 mm in plan and height, GLB has float32.
    assert np.abs(xml - glb).max() < 0.0001 + 0.0001
    # Faces of 1 m on roads cut the curved surface; beside them the mesh is coarse.
    error = np.abs(xml - truth)[np.isfinite(road)]
    assert len(error) > 0.9 * POINTS
    assert np.quantile(error, 0.99) < 0.003
    tiles = {file.name: file.read_bytes() for file in (exported / "3dtiles" / "tiles").iterdir()}
    assert sorted(tiles.values()) == sorted(file.read_bytes() for file in city.glob("tiles/*/*.glb"))
