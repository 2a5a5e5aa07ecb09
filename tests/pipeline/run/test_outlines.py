"""Runs in which roads are polygons and a survey ends within tiles: the meshes end where these end."""

import numpy as np
import pytest
import rasterio
import shapely

from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.synthetic.scenes import write_scenes
from tests.make_roads import write
from tests.mesh_union import Union
from tests.pipeline.run.test_one_surface import glb_part, ply_part

SIZE_M = 100
LIMIT_M, SLOPE = 190.3, 0.31
"""Northing of the end of the survey in the west (m), and its descent to the east."""


def covered(x, y):
    """Whether the survey has data, by metres from the south-west corner of the four tiles."""
    return y < LIMIT_M - SLOPE * x


def near_limit(x, y):
    away = (LIMIT_M - SLOPE * x - y) / np.hypot(1, SLOPE)
    return np.abs(away) < 1


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("survey")
    scenes = Catalog.read(write_scenes(folder, 4, seed=5, size_m=SIZE_M))
    west, south = np.min([tile.grid.bounds[:2] for tile in scenes.tiles], axis=0)
    for name in ("dsm", "dtm"):
        for path in folder.glob(f"{name}/*.tif"):
            with rasterio.open(path, "r+") as raster:
                row, col = np.indices(raster.shape)
                x, y = raster.transform * (col + 0.5, row + 0.5)
                heights = raster.read(1)
                heights[~covered(x - west, y - south)] = raster.nodata
                raster.write(heights, 1)
    street = shapely.buffer(shapely.linestrings([(-30, 20.4), (96, 61.7), (240, 50)]), 4.2, cap_style="flat")
    ring = shapely.Point(100, 108).buffer(15).difference(shapely.Point(100, 108).buffer(8))
    roads = [
        shapely.transform(road, lambda points: points + np.array([west, south])) for road in (street, ring)
    ]
    write(folder / "roads.gpkg", roads, scenes.tiles[0].grid.crs)
    patterns = {"dsm": "dsm/*.tif", "dtm": "dtm/*.tif", "roads": "roads.gpkg"}
    catalog = Catalog(rasters.index(folder, patterns, tile_size_m=SIZE_M).tiles)
    made = Run.create(folder / "run", load_config("production_vector"), catalog)
    summary = run_tiles(made, SerialExecutor())
    assert (summary.done, summary.failed) == (4, 0)
    return made, catalog, roads, (west, south)


def products(run, end):
    made, catalog, *_ = run
    return [made.folder(tile.id).path / f"{tile.id}_flexroad{end}" for tile in catalog.tiles]


@pytest.mark.slow
@pytest.mark.parametrize(("end", "read"), [(".glb", glb_part), (".ply", ply_part)])
def test_meshes_join_and_end_with_the_survey(run, end, read):
    origin = run[-1]
    whole = Union.of(part for path in products(run, end) for part in read(path))
    assert whole.uses.max() == 2
    at_limit = near_limit(*(whole.middles - origin).T)
    assert (whole.uses[whole.inside & ~at_limit] == 2).all()
    assert (whole.uses[whole.inside] == 1).sum() > 50
    x, y = np.meshgrid(*[np.arange(0.5, 2 * SIZE_M)] * 2)
    assert whole.area == pytest.approx(np.count_nonzero(covered(x, y)), abs=60)


@pytest.mark.slow
def test_road_of_glb_is_that_of_polygons(run):
    import trimesh

    *_, roads, (west, south) = run
    triangles = []
    for path in products(run, ".glb"):
        scene = trimesh.load(path, process=False)
        x0, y0, _ = scene.metadata["run_origin"]
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            if name == "road":
                x, _, z = (scene.geometry[name].vertices + matrix[:3, 3]).T
                plan = np.stack([x + x0 - west, y0 - z - south], axis=1)
                triangles.append(plan[scene.geometry[name].faces])
    drawn = shapely.union_all(shapely.polygons(np.concatenate(triangles)), grid_size=1e-4)
    truth = shapely.transform(shapely.union_all(roads), lambda points: points - np.array([west, south]))
    # Away from the limit of the survey.
    ground = shapely.Polygon([(0, 0), (200, 0), (200, LIMIT_M - 200 * SLOPE - 1), (0, LIMIT_M - 1)])
    drawn, truth = (shapely.intersection(area, ground) for area in (drawn, truth))
    assert drawn.area == pytest.approx(truth.area, rel=1e-3)
    assert shapely.area(drawn ^ truth) < 0.01 * shapely.length(truth)
