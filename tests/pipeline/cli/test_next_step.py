"""The line ``next: ...`` after a catalog was written is a command that runs as it is printed."""

import shlex

import numpy as np
import pytest
import yaml
from shapely import box

from flexroad.pipeline.graph.layers import PRODUCTION
from tests.make_rasters import write
from tests.make_roads import write as write_roads

WEST, NORTH = 400_020.0, 5_700_060.0


@pytest.fixture
def rasters(tmp_path, monkeypatch):
    """A folder, with a space in its name, of heights, a road mask and vector roads of one tile of 60 m."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "my data"
    rows, columns = np.mgrid[:60, :60]
    ground = (100 + 0.02 * rows + 0.01 * columns).astype(np.float32)
    for name in ("dsm", "dtm"):
        write(folder / f"{name}.tif", ground, WEST, NORTH)
    write(folder / "mask.tif", (abs(rows - 30) < 5).astype(np.uint8), WEST, NORTH)
    write_roads(folder / "roads.gpkg", [box(WEST, NORTH - 35, WEST + 60, NORTH - 25)])
    return folder


def made(flexroad, folder, output, *words) -> str:
    """Make a catalog; return the last line of the output."""
    command = ("catalog", "rasters", folder, "--dsm", "dsm.tif", "--dtm", "dtm.tif", "--tile-size", 60)
    return flexroad(*command, "-o", output, *words).expected(0).out.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "layer", "place"),
    [
        (("--road-mask", "mask.tif"), "road_mask", "my data/catalog.parquet"),
        (("--roads", "roads.gpkg"), "roads", "catalogs of mine/it's.json"),
    ],
)
def test_catalog_rasters_next_line_runs_as_printed(words, layer, place, rasters, flexroad, tmp_path):
    (tmp_path / place).parent.mkdir(exist_ok=True)
    line = made(flexroad, rasters, place, *words)
    assert line.startswith(f"next: flexroad run --config {PRODUCTION[layer]} ")
    assert ("--allow" in line) == ("mine" in place)
    arguments = shlex.split(line.removeprefix("next: flexroad "))
    assert "1 tile: 1 done" in flexroad(*arguments, "--executor", "serial").expected(0).out
    name = "it's" if "mine" in place else "my data"
    assert (tmp_path / "runs" / name / "metrics.parquet").is_file()


def test_catalog_without_roads_says_what_a_run_lacks(rasters, flexroad, tmp_path):
    line = made(flexroad, rasters, "bare.parquet")
    assert line.startswith("before a run: production: no tile of the catalog has a road mask")
    assert "--roads for vectors" in line


def test_catalog_with_own_layout_next_line_names_it(rasters, flexroad, tmp_path, quick_config):
    layers = {"dsm": "{tile}.tif", "dtm": "ground/{tile}.tif", "road_mask": "masks/{tile}.tif"}
    layout = tmp_path / "my layout.yaml"
    layout.write_text(
        yaml.safe_dump(yaml.safe_load(quick_config.read_text()) | {"dataset": {"layers": layers}})
    )
    for name, folder in (("dtm", "ground"), ("mask", "masks")):
        (rasters / folder).mkdir()
        (rasters / f"{name}.tif").rename(rasters / folder / "dsm.tif")
    said = flexroad("catalog", "dsc3d", rasters, "-o", "c.parquet", "--layout", layout).expected(0)
    arguments = shlex.split(said.out.splitlines()[-1].removeprefix("next: flexroad "))
    assert arguments[:3] == ["run", "--config", str(layout)]
    assert "1 tile: 1 done" in flexroad(*arguments, "--executor", "serial").expected(0).out
