"""Catalog check reads tiles as a run does: what fails in the run is told before, in the same words."""

import json
import os

import geopandas as gpd
import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.catalog.sources import rasters
from flexroad.catalog.text import some
from flexroad.pipeline.check import trial
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.check.trial import trials
from flexroad.pipeline.config.loading import load_config
from flexroad.tasks.load import READS
from tests.make_rasters import damage, write

FIT = {"method": "nurbs", "control_points": [8, 8], "iterations": 3}


@pytest.fixture
def config(tmp_path):
    """Write a quick configuration; return its file."""

    def written(**changes):
        path = tmp_path / "x.yaml"
        path.write_text(json.dumps({"extends": "defaults", "fit": FIT} | changes))
        return path

    return written


@pytest.fixture
def told(flexroad, tmp_path):
    """Check a catalog and run it; return the one warning, after comparing it with the failures of the run."""

    def compare(catalog, config, failed):
        check = flexroad("catalog", "check", catalog, "--config", config).expected(1)
        (line,) = (line for line in check.out.splitlines() if line.startswith("warning: "))
        arguments = ["--config", config, "--catalog", catalog, "--out", tmp_path / "run"]
        dry = flexroad("run", *arguments, "--dry-run").expected(1)
        assert line in dry.out.splitlines()
        run = flexroad("run", *arguments, "--executor", "serial").expected(1)
        ids, _, message = line.removeprefix("warning: ").partition(" would fail: ")
        assert ids == some(failed)
        errors = [error for error in run.errors if error.startswith("failed ")]
        assert [error.partition(": ")[0] for error in errors] == [f"failed {tile_id}" for tile_id in failed]
        assert all(f": TaskError: {message}" in error for error in errors)
        return line

    return compare


def ids(catalog):
    return [tile.id for tile in Catalog.read(catalog).tiles]


def test_damaged_block_is_found(survey, config, told):
    tile = Catalog.read(survey).tiles[2]
    (path,) = tile.paths(tile.layer("dtm").reaching(tile.grid.bounds))
    with rasterio.open(path) as raster:
        values = raster.read(1)
    blocks = {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "deflate"}
    write(path, values, tile.grid.west, tile.grid.north, **blocks)
    damage(path, 20, 20)
    line = told(survey, config(), [tile.id])
    assert f"dtm dtm/{tile.id}.tif cannot be read: " in line
    assert line.endswith("; fetch it again")


def without_crs(path):
    roads = gpd.read_file(path)
    path.unlink()
    roads.set_crs(None, allow_override=True).to_file(path)


@pytest.mark.parametrize(
    ("change", "segment", "message"),
    [
        (lambda path: path.write_text("<html>404 Not Found</html>"), {}, "is not a vector file: "),
        (lambda path: os.truncate(path, path.stat().st_size // 2), {}, "cannot be read as "),
        (without_crs, {}, "carries no CRS; give it one, e.g. ogr2ogr -a_srs EPSG:25832 NEW "),
        (lambda path: gpd.read_file(path).to_file(path, layer="second"), {}, "has 2 layers: "),
        (lambda path: None, {"layer": "streets"}, "has no layer 'streets'; it has "),
        (
            lambda path: None,
            {"where": "lanes > 2"},
            "cannot be read as roads: no such column: lanes; check segment.where: its columns are highway",
        ),
    ],
)
def test_roads_that_cannot_be_read_are_named_for_all_tiles(survey, config, told, change, segment, message):
    tile = Catalog.read(survey).tiles[0]
    (path,) = tile.paths(tile.layer("roads"))
    change(path)
    line = told(survey, config(segment={"method": "vector"} | segment), ids(survey))
    assert f" would fail: {path} {message}" in line


def test_more_control_points_than_cells_are_told(survey, config, told):
    line = told(survey, config(fit=FIT | {"control_points": [61, 60]}), ids(survey))
    assert line.endswith(
        "60 x 60 cells are fewer than 61 x 60 control points; lower fit.control_points or raise fit.spacing_m"
    )


def test_truncated_file_is_found_though_few_tiles_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "MOST_TILES", 1)
    blocks = {"tiled": True, "blockxsize": 16, "blockysize": 16}
    for number in range(4):
        for name in ("dsm", "dtm"):
            heights = np.full((60, 60), 100 + number, np.float32)
            write(tmp_path / name / f"{number}.tif", heights, 480_000 + 60 * number, 5_600_040.0, **blocks)
    tiles = rasters.index(tmp_path, {name: f"{name}/*.tif" for name in ("dsm", "dtm")}, tile_size_m=60).tiles
    path = tmp_path / "dtm" / "2.tif"
    path.write_bytes(path.read_bytes()[:-3000])
    said = [found.text for found in expected_failures(tiles, load_config("production"), READS)]
    (fault,) = (text for text in said if "would fail: dtm" in text)
    assert fault.startswith(f"{tiles[2].id} would fail: dtm dtm/2.tif cannot be read: ")


def test_tiles_that_few_files_share_are_read_spread_evenly(survey, monkeypatch):
    monkeypatch.setattr(trial, "MOST_TILES", 2)
    tiles = Catalog.read(survey).tiles
    read, faults = trials(tiles, load_config("production"), {tiles[0].id}, {tiles[3].id}, ())
    assert [tile.tile_id for tile in read] == [tiles[3].id, tiles[1].id]
    assert faults == []
