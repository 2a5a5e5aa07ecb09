"""All formats of a tile against the surface that its mesh was sampled from."""

import io
import json
from datetime import datetime
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from flexroad.catalog.grid import Grid
from flexroad.tasks.products import glb
from flexroad.tasks.sample import Options, sample
from flexroad.tasks.spline.surface import NurbsSurface, uniform_knots
from flexroad.tasks.types import Mesh, RoadClusters, RoadMask
from flexroad.tools.export import cityjson, landxml, obj
from flexroad.tools.export.georeference import Georeference

GRID = Grid("EPSG:25832", 295500.0, 5629350.0, 1.0, 100, 100)
PLACE = Georeference(GRID.crs, (295000.0, 5629000.0, 0.0))
"""What all tiles of a run are relative to."""
CENTRE = (295550.0, 5629300.0, 100.0)


@pytest.fixture(scope="module")
def surface() -> NurbsSurface:
    """Hills of some metres with slopes up to 0.3."""
    heights = 163 + np.random.default_rng(3).normal(0, 1.5, (14, 14))
    knots = uniform_knots(0, 11, 3)
    return NurbsSurface(
        GRID.crs, GRID.bounds, (3, 3), knots, knots, heights, np.ones((14, 14)), 0.0, (295500.0, 5629250.0)
    )


@pytest.fixture(scope="module")
def mesh(surface) -> Mesh:
    x, y = np.meshgrid(GRID.eastings - GRID.west, GRID.northings - GRID.south)
    street = np.abs(x - y) < 5
    road = RoadMask(GRID, GRID, street, np.zeros(GRID.shape, bool))
    return sample(surface, road, RoadClusters(GRID, street.astype(np.int32)), Options(terrain_m=5.0))


def of_landxml(mesh: Mesh) -> np.ndarray:
    file = io.BytesIO()
    landxml.join(file, [landxml.part(mesh)], landxml.Project("tile", datetime(2026, 5, 4)))
    texts = [p.text for p in ElementTree.fromstring(file.getvalue()).iter() if p.tag.endswith("}P")]
    return np.array([text.split() for text in texts], float)[:, [1, 0, 2]]


def of_cityjson(mesh: Mesh) -> np.ndarray:
    lines = cityjson.features("tile", mesh, CENTRE).splitlines()
    return np.concatenate([json.loads(line)["vertices"] for line in lines]) * 0.001 + CENTRE


def of_obj(mesh: Mesh) -> np.ndarray:
    lines = obj.encode(mesh, "tile.mtl", PLACE).decode().splitlines()
    return np.array([line.split()[1:] for line in lines if line.startswith("v ")], float) + PLACE.origin


def of_glb(mesh: Mesh) -> np.ndarray:
    scene = trimesh.load_scene(io.BytesIO(glb.encode(mesh, CENTRE)), file_type="glb", process=False)
    x, y, z = np.concatenate([part.vertices for part in scene.dump()]).T
    return np.c_[x, -z, y] + CENTRE


@pytest.mark.parametrize(
    ("read", "plan_m", "height_m"),
    [
        (of_landxml, 0.5e-4, 0.5e-4),
        (of_cityjson, 0.5e-3, 0.5e-3),
        (of_obj, 0.5e-4, 0.5e-4),
        (of_glb, 1e-5, 1e-5),
    ],
)
def test_vertices_lie_on_the_surface_within_the_precision(surface, mesh, read, plan_m, height_m):
    x, y, z = read(mesh).T
    steepest = np.hypot(*surface.slope(x, y)).max()
    assert len(x) > 1000
    difference = np.abs(z - surface.height(x, y))
    assert difference.max() <= height_m + 2 * plan_m * steepest
