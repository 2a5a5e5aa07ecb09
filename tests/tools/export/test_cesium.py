"""Heights and levels that CesiumJS shows, in headless Chromium, from tilesets on the local machine."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.driver import export
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select
from flexroad.tools.synthetic.scenes import write_scenes
from tests import validators

pytestmark = [pytest.mark.slow, pytest.mark.soak("pages")]

SCRIPT = Path(validators.__file__).with_name("cesium_page.py")
DATUM = Datum("offset", "47.5")


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A run of two tiles of 250 m, and its tileset."""
    validators.browser()
    folder = tmp_path_factory.mktemp("globe")
    catalog = Catalog.read(write_scenes(folder / "survey", 2, seed=0))
    run = Run.create(folder / "city", load_config("production"), catalog)
    assert run_tiles(run, SerialExecutor()).done == 2
    export(select(run.path), folder / "out", ["3dtiles"], Options(DATUM), SerialExecutor())
    return run, folder / "out" / "3dtiles"


def seen(folder, task, tmp_path):
    """What the page reports: no error, no failed tile, and no request to another machine."""
    file = tmp_path / "task.json"
    file.write_text(json.dumps(task))
    command = [validators.python(), SCRIPT, validators.package("cesium"), validators.browser(), folder, file]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert [result[name] for name in ("failures", "outside", "errors")] == [[], [], []]
    return result


def test_picked_heights_are_those_of_the_surface_within_5_mm(city, tmp_path):
    run, folder = city
    rng = np.random.default_rng(0)
    places, heights = [], []
    for tile in select(run.path).finished():
        # Where the mesh has no steps: on small faces; large ones on the road's edge reach into the terrain.
        mesh, surface = tile.mesh, without_steps(tile.surface)
        small = np.ptp(mesh.vertices[mesh.faces, :2], axis=1).max(axis=1) < 1.5
        road = mesh.faces[mesh.road & small]
        faces = road[rng.choice(len(road), 25, replace=False)]
        x, y, _ = (mesh.vertices[faces] + mesh.origin).mean(axis=1).T
        longitude, latitude, height = DATUM.geographic("EPSG:25832", x, y, surface.height(x, y))
        places += np.column_stack([longitude, latitude]).tolist()
        heights += height.tolist()
    assert len(places) == 50
    picked = np.array(seen(folder, {"points": places}, tmp_path)["heights"], float)
    assert np.abs(picked - heights).max() < 0.005


@pytest.mark.parametrize(("range_m", "folders"), [(400.0, {"tiles"}), (6000.0, {"coarse"})])
def test_coarse_mesh_is_shown_from_afar_and_the_tiles_from_nearby(city, tmp_path, range_m, folders):
    _, folder = city
    west, south, east, north, low, high = json.loads((folder / "tileset.json").read_text())["root"][
        "boundingVolume"
    ]["region"]
    centre = [*np.degrees([(west + east) / 2, (south + north) / 2]).tolist(), (low + high) / 2]
    camera = {"centre": centre, "heading": 0, "pitch": -60, "range": range_m, "error_px": 16}
    picture = tmp_path / "picture.png"
    shown = seen(folder, {"camera": camera, "picture": str(picture)}, tmp_path)["shown"]
    assert {Path(name).parent.name for name in shown} == folders
    assert picture.stat().st_size > 1000
