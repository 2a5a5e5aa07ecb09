"""Catalog check: what would fail is named before the run and then does fail; a shifted photo."""

import os
from dataclasses import replace

import numpy as np
import pytest
import rasterio
from affine import Affine

from flexroad.catalog import LAYERS, Catalog
from flexroad.catalog.guard import open_raster
from flexroad.catalog.guard.open_raster import open_alone
from flexroad.catalog.sources import rasters
from flexroad.catalog.tile import faulty
from flexroad.pipeline.check.failures import expected_failures
from flexroad.pipeline.config.loading import load_config
from flexroad.tasks.errors import TaskError
from flexroad.tasks.load import Options, load
from flexroad.tools.check.catalog import check
from flexroad.tools.synthetic.scenes import write_scenes
from tests.make_rasters import write
from tests.permissions import permissions_enforced

RESTORE = "restore it or build the catalog again"
FEW = "a DSM height in less than 25% of the cells (load.min_valid)"


def without_road_mask(tile):
    return replace(tile, layers=tuple(layer for layer in tile.layers if layer.name != "road_mask"))


def own_file(tile, layer):
    (path,) = tile.paths(tile.layer(layer).reaching(tile.grid.bounds))
    return path


def change(tile, layer, change_raster):
    with rasterio.open(own_file(tile, layer), "r+") as raster:
        change_raster(raster)


def empty(raster):
    heights = raster.read(1)
    heights[: int(0.8 * len(heights))] = np.nan
    raster.write(heights, 1)


def elsewhere(raster):
    raster.crs = "EPSG:25833"


def test_expected_failures_name_count_and_examples_of_each_reason(survey):
    one, two, three, four = Catalog.read(survey).tiles
    change(two, "dsm", empty)
    change(three, "dtm", elsewhere)
    missing = own_file(four, "dtm")
    missing.unlink()
    tiles = (without_road_mask(one), two, three, four, faulty("fifth", "its entry is damaged", ""))
    said = [finding.text for finding in expected_failures(tiles, load_config("production"), LAYERS)]
    assert said == [
        "fifth: its entry is damaged",
        f"1 of 4 tiles would fail: no road_mask, which segment: mask needs: {one.id}",
        f"missing: {missing} (1 tile); {RESTORE}",
        f"1 of 4 tiles would fail: {FEW}: {two.id}",
        "1 of 4 tiles would fail: dtm is in EPSG:25833, not EPSG:25832; reproject it, or make the catalog "
        f"with --reproject: {three.id}",
    ]
    for tile in (two, three, four):
        with pytest.raises(TaskError):
            load(tile, Options())


def test_expected_failures_tell_files_without_permission_from_missing_ones(survey):
    tiles = Catalog.read(survey).tiles
    closed, gone = own_file(tiles[0], "dsm"), own_file(tiles[1], "dsm")
    closed.chmod(0)
    gone.unlink()
    folder = own_file(tiles[0], "dtm").parent
    folder.chmod(0)
    with permissions_enforced():
        said = [
            finding.text for finding in expected_failures(tiles, load_config("production"), ("dsm", "dtm"))
        ]
    folder.chmod(0o755)
    assert f"cannot be read: Permission denied: {closed} (1 tile)" in said
    assert f"missing: {gone} (1 tile); {RESTORE}" in said
    for tile in tiles:
        assert f"cannot be read: Permission denied: {folder / f'{tile.id}.tif'} (1 tile)" in said
    assert sum(text.startswith("missing") for text in said) == 1


def test_expected_failures_follow_min_valid_of_the_configuration(survey, tmp_path):
    tiles = Catalog.read(survey).tiles
    change(tiles[1], "dsm", empty)
    (tmp_path / "low.yaml").write_text("extends: production\nload: {min_valid: 0.1}\n")
    assert not list(expected_failures(tiles, load_config(tmp_path / "low.yaml"), LAYERS))
    load(tiles[1], Options(min_valid=0.1))


def test_dry_run_and_check_say_what_would_fail(survey, flexroad, tmp_path):
    change(Catalog.read(survey).tiles[1], "dsm", empty)
    said = flexroad("run", "--catalog", survey, "--out", tmp_path / "run", "--dry-run").expected(1)
    line = f"warning: 1 of 4 tiles would fail: {FEW}: {Catalog.read(survey).tiles[1].id}"
    assert said.out.splitlines()[-2:] == [line, "expected exit code: 1 (1 tile would fail)"]
    assert line in flexroad("catalog", "check", survey).expected(1).out.splitlines()


def test_tiles_on_the_same_place_are_named_by_check_and_run(survey, flexroad, tmp_path):
    catalog = Catalog.read(survey)
    assert catalog.same_places() == ""
    twin = replace(catalog.tiles[0], id="twin")
    Catalog((*catalog.tiles, twin)).write(survey)
    note = f"tiles on the same place: {catalog.tiles[0].id} and twin; their results cover each other"
    assert note in flexroad("catalog", "check", survey).out.splitlines()
    words = ("--config", "paper", "--catalog", survey, "--out", tmp_path / "run", "--tile", twin.id)
    said = flexroad("run", *words, catalog.tiles[0].id, "--set", "fit.iterations=2")
    assert f"note: {note}" in said.err.splitlines()


def test_dsm_of_several_tiles_is_opened_once(tmp_path, monkeypatch):
    for name in ("dsm", "dtm", "road_mask"):
        write(tmp_path / f"{name}.tif", np.ones((250, 1000), np.float32), 295500)
    catalog = Catalog(rasters.index(tmp_path, {name: f"{name}.tif" for name in ("dsm", "dtm")}).tiles)
    assert len(catalog.tiles) == 4
    os.utime(tmp_path / "dsm.tif", (1, 1))
    opened = []

    def counted(path):
        opened.append(path.name)
        return open_alone(path)

    monkeypatch.setattr(open_raster, "open_alone", counted)
    assert not [
        f for f in expected_failures(catalog.tiles, load_config("paper"), ("dsm",)) if "height" in f.text
    ]
    assert opened == ["dsm.tif"]


def test_check_names_heights_that_many_cells_share(survey):
    def flood(raster):
        heights = raster.read(1)
        heights[:9] = 0
        raster.write(heights, 1)

    tile = Catalog.read(survey).tiles[0]
    change(tile, "dtm", flood)
    notes = [
        f for f in check(Catalog.read(survey), load_config("production"), survey) if "exact height" in f.text
    ]
    (name,) = tile.layer("dtm").reaching(tile.grid.bounds).files
    share = 9 / tile.grid.height
    assert [note.fault for note in notes] == [False]
    assert notes[0].text.startswith(f"dtm: many cells have the exact height 0: {name} ({share:.1%});")


def test_check_shifted_photo_and_missing_file_are_faults(tmp_path):
    path = write_scenes(tmp_path, 2, seed=3, size_m=120, dop=True)
    assert not any(finding.fault for finding in check(Catalog.read(path), load_config("production"), path))
    for photo in (tmp_path / "dop").glob("*.tif"):
        with rasterio.open(photo, "r+") as raster:
            raster.transform = Affine.translation(2.0, 0.0) @ raster.transform
    (missing := next((tmp_path / "dtm").glob("*.tif"))).unlink()
    faults = [
        finding.text
        for finding in check(Catalog.read(path), load_config("production"), path)
        if finding.fault
    ]
    assert any(f"missing: {missing} (1 tile)" in text for text in faults)
    assert any("dop lies 2.0 m east" in text for text in faults)


def test_unclear_shift_of_the_photo_is_a_warning_without_advice(tmp_path, flexroad):
    """Each tile has the photo of another one: no shift is right, and the best one has a low confidence."""
    path = write_scenes(tmp_path, 9, seed=3, size_m=60, dop=True)
    photos = sorted((tmp_path / "dop").glob("*.tif"))
    pictures = [open_alone(photo).read() for photo in photos]
    for photo, picture in zip(photos, [*pictures[1:], pictures[0]], strict=True):
        with rasterio.open(photo, "r+") as raster:
            raster.write(picture)
    said = flexroad("catalog", "check", path).expected(0)
    (line,) = [line for line in said.out.splitlines() if "dop seems to lie" in line]
    assert line.startswith("warning: dop seems to lie 1.4 m west and 6.0 m south of the heights ")
    assert "confidence 0.10): too unclear to move it; " in line
    assert "gdal_translate" not in said.out
