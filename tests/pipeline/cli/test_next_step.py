"""The line ``next: ...`` after a catalog was written is a command that runs as it is printed."""

import shlex

import numpy as np
import pytest
from rasterio.warp import transform
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
    assert f" run --config {PRODUCTION[layer]} " in line
    assert line.startswith("next: flexroad --allow ") == ("mine" in place)
    arguments = shlex.split(line.removeprefix("next: flexroad "))
    assert "1 tile: 1 done" in flexroad(*arguments, "--executor", "serial").expected(0).out
    name = "it's" if "mine" in place else "my data"
    assert (tmp_path / "runs" / name / "metrics.parquet").is_file()


def test_catalog_of_files_outside_next_line_allows_them_for_all_commands(rasters, flexroad, tmp_path):
    """The photo, which a run does not read, lies in a third folder."""
    places = {name: tmp_path / name for name in ("heights", "ground", "photos")}
    write(places["heights"] / "dsm.tif", np.full((60, 60), 100, np.float32), WEST, NORTH)
    write(places["ground"] / "dtm.tif", np.full((60, 60), 100, np.float32), WEST, NORTH)
    write(places["photos"] / "dop.tif", np.full((60, 60), 100, np.uint8), WEST, NORTH)
    command = ("catalog", "rasters", rasters, "--dsm", places["heights"] / "*.tif", "--road-mask", "mask.tif")
    command += ("--dtm", "../ground/dtm.tif", "--dop", places["photos"] / "dop.tif", "--tile-size", 60)
    command += ("-o", rasters / "c.parquet")
    said = flexroad(*command).expected(0)
    arguments = shlex.split(said.out.splitlines()[-1].removeprefix("next: flexroad "))
    allow, run = arguments[: arguments.index("run")], arguments[arguments.index("run") :]
    assert allow == [word for name in sorted(places) for word in ("--allow", str(places[name]))]
    without = [word for name in ("ground", "photos") for word in ("--allow", str(places[name]))]
    assert f"names {places['heights']}" in flexroad(*without, *run).expected(2).err
    assert "1 tile: 1 done" in flexroad(*arguments, "--executor", "serial").expected(0).out
    assert "1 tile of" in flexroad(*allow, "catalog", "check", rasters / "c.parquet").out
    training = ("train", rasters / "c.parquet", "--labels", "mask", "-o", "model")
    assert "--allow" in flexroad(*without, *training).expected(2).err
    assert "--allow" not in flexroad(*allow, *training).err


def test_catalog_of_feet_and_another_zone_runs_with_reproject(rasters, flexroad, tmp_path):
    """A folder of one country: heights in feet of the survey, a mask in degrees, heights of ground in UTM."""
    feet = np.full((100, 100), 300, np.float32)
    write(rasters / "us" / "dsm.tif", feet, 985_000, 200_000, cell=3, crs="EPSG:2263", unit="foot_us")
    west, north = transform("EPSG:2263", "EPSG:32618", [985_000], [200_000])
    place = {"west": west[0] - 30, "north": north[0] + 30, "crs": "EPSG:32618", "unit": "m"}
    write(rasters / "us" / "dtm.tif", np.full((160, 160), 91.44, np.float32), **place)
    west, north = transform("EPSG:2263", "EPSG:4269", [985_000], [200_000])
    road = (abs(np.arange(100) - 50) < 10).astype(np.uint8)[:, None].repeat(100, 1)
    write(rasters / "us" / "mask.tif", road, west[0], north[0], cell=1e-5, crs="EPSG:4269")
    command = ["catalog", "rasters", rasters / "us", "--dsm", "dsm.tif", "--dtm", "dtm.tif"]
    command += ["--road-mask", "mask.tif", "--tile-size", 40, "-o", rasters / "us.json", "--reproject"]
    assert "--reproject --to-crs EPSG:32618" in flexroad(*command).expected(2).err
    said = flexroad(*command, "--to-crs", "EPSG:32118").expected(0)
    assert "note: dsm is in EPSG:2263, not EPSG:32118" in said.err
    arguments = shlex.split(said.out.splitlines()[-1].removeprefix("next: flexroad "))
    flexroad("catalog", "check", rasters / "us.json").expected(0)
    said = flexroad(*arguments, "--executor", "serial").expected(0)
    assert " 0 failed" in said.out


def test_catalog_without_roads_says_what_a_run_lacks(rasters, flexroad, tmp_path):
    line = made(flexroad, rasters, "bare.parquet")
    assert line.startswith("before a run: production: no tile of the catalog has a road mask")
    assert "--roads for vectors" in line


def test_next_line_after_scenes_with_decks_uses_their_levels(flexroad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = flexroad("catalog", "synthetic", "--decks", "--tiles", 1, "--tile-size", 60, "-o", "decks")
    line = made.expected(0).out.splitlines()[-1]
    assert line.startswith(
        "next: flexroad run --config production_vector --set segment.levels=true --catalog "
    )
    arguments = shlex.split(line.removeprefix("next: flexroad "))
    assert "1 tile: 1 done" in flexroad(*arguments, "--executor", "serial").expected(0).out
    assert list((tmp_path / "runs" / "decks" / "tiles").glob("*/*_height_level0.tif"))
