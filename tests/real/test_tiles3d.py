"""3D Tiles of Barbican, London: British National Grid, real roads and heights."""

import json
import zipfile

import numpy as np
import pytest
import trimesh
from pyproj import Transformer

from flexroad.catalog import Catalog
from flexroad.catalog.ellipsoidal import Datum
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.export.driver import export
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.source import select
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.real.shown import flexroad
from tests.validators.gltf import gltf_issues

pytestmark = [pytest.mark.real, pytest.mark.slow]

LAYERS = ["--dsm", "dsm_*.tif", "--dtm", "dem_*.tif", "--road-mask", "landcover_*.tif", "--road-value", "1"]


@pytest.fixture(scope="module")
def exported(real_data, tmp_path_factory):
    """A run of four tiles, and its 3D Tiles."""
    folder = tmp_path_factory.mktemp("barbican")
    zipfile.ZipFile(real_data / "umep" / "London_BNG.zip").extractall(folder / "umep")
    flexroad(["catalog", "rasters", "umep/London_BNG", *LAYERS, "-o", "all.parquet"], folder)
    catalog = Catalog(Catalog.read(folder / "all.parquet").tiles[:4])
    run = Run.create(folder / "barbican", load_config("production"), catalog)
    assert run_tiles(run, SerialExecutor()).done == 4
    export(select(run.path), folder / "out", ["3dtiles"], Options(Datum("offset", "45.8")), SerialExecutor())
    return run, folder / "out" / "3dtiles"


def test_files_are_valid_by_the_khronos_validator(exported):
    files = list(exported[1].rglob("*.glb"))
    assert len(files) == 5
    assert gltf_issues(files) == []


def test_vertices_lie_on_the_surface(exported):
    run, folder = exported
    geographic = Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    plan = Transformer.from_crs("EPSG:27700", "EPSG:4979", always_xy=True, allow_ballpark=False)
    surfaces = {f"{tile.id}.glb": tile.surface for tile in select(run.path).finished()}
    (block,) = (folder / "blocks").iterdir()
    root = json.loads(block.read_text())["root"]
    for leaf in root["children"]:
        matrix = np.reshape(root["transform"], (4, 4)).T @ np.reshape(leaf["transform"], (4, 4)).T
        file = block.parent / leaf["content"]["uri"]
        east, up, south = trimesh.load(file).to_geometry().vertices.T
        placed = np.column_stack([east, -south, up]) @ matrix[:3, :3].T + matrix[:3, 3]
        longitude, latitude, height = geographic.transform(*placed.T)
        x, y = plan.transform(longitude, latitude, direction="INVERSE")
        surface = surfaces[file.name]
        error = np.abs(height - 45.8 - surface.height(x, y))
        inside = np.isfinite(error)
        assert inside.mean() > 0.9
        # 2 mm in plan and in height: on a slope the first is an error of height, too.
        steepest = np.hypot(*surface.slope(x[inside], y[inside]))
        assert (error[inside] <= 0.002 * (1 + steepest)).all()
