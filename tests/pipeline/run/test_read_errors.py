"""A source that cannot be read for one night: the next night gives what a run from scratch gives.

Its size and time stay the same, so no fingerprint shows that it was not read.
"""

import builtins
import errno
import io
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest import mock

import geopandas
import numpy as np
import pandas as pd
import pytest
import rasterio
from rasterio.merge import merge

from flexroad.catalog import Catalog
from flexroad.catalog.guard import open_raster
from flexroad.catalog.sources import rasters
from flexroad.pipeline.cli.dry_run import plan
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.graph import sources
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run.api import rerun_filter
from flexroad.pipeline.run.finished import FinishedTile, RunPlace, snapshots
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import open_database, tile_states
from flexroad.pipeline.store.artefacts import encode
from flexroad.pipeline.store.records import load_checked
from flexroad.tasks.io import vectors
from flexroad.tasks.products import npz
from flexroad.tools.synthetic.scenes import write_scenes
from tests.make_rasters import damage, write
from tests.permissions import permissions_enforced
from tests.whole_run import products, rows

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

SIZE_M = 40
LIGHT = ["fit.spacing_m=8"]
NAMES = ("dsm", "dtm", "road_mask")
NODATA = '<PAMDataset><PAMRasterBand band="1"><NoDataValue>{}</NoDataValue></PAMRasterBand></PAMDataset>'


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """Four tiles, each layer of each tile in a file of its own."""
    folder = tmp_path_factory.mktemp("survey")
    write_scenes(folder, 4, seed=5, size_m=SIZE_M)
    return folder


def catalog_of(survey, name="catalog.json", **patterns):
    patterns = {name: f"{name}/*.tif" for name in NAMES} | patterns
    Catalog(rasters.index(survey, patterns, tile_size_m=SIZE_M).tiles).write(survey / name)
    return survey / name


def night(out, catalog, config="production", settings=LIGHT, checksum=False):
    """Run a catalog as a new process does, with no file open; return summary and failures."""
    for cached in (vectors._layers, vectors._part, sources._sha256):
        cached.cache_clear()
    results = []

    def run():
        opened = Run.create(out, load_config(config, settings), Catalog.read(catalog), checksum=checksum)
        failures = []
        summary = run_tiles(opened, SerialExecutor(), watch=lambda result: failures.extend(result.failures))
        results.append((summary, failures))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return results[0]


def assert_equal(out, scratch):
    assert products(out) == products(scratch)
    pd.testing.assert_frame_equal(rows(out), rows(scratch), check_exact=True)


def one_file(survey, name="dsm"):
    """A file of one tile, which the other three see in their halos and along their borders."""
    return sorted((survey / name).glob("*.tif"))[1]


class denied:
    """A file that may not be read."""

    def __init__(self, path):
        self.path, self.mode = path, path.stat().st_mode

    def __enter__(self):
        self.path.chmod(0)
        # Capabilities belong to a thread, and a new one inherits them.
        self.enforced = permissions_enforced()
        self.enforced.__enter__()

    def __exit__(self, *error):
        self.enforced.__exit__(*error)
        self.path.chmod(self.mode)


class failing:
    """A disk that gives no byte of a file."""

    def __init__(self, path):
        self.path = path
        error = OSError(errno.EIO, os.strerror(errno.EIO), str(path))

        def refusing(plain, read_error):
            def opened(file, *more, **options):
                if not isinstance(file, int) and Path(file) == path:
                    raise read_error
                return plain(file, *more, **options)

            return opened

        of_gdal = rasterio.errors.RasterioIOError("Read failed. See previous exception for details.")
        self.patches = [
            mock.patch.object(rasterio, "open", refusing(rasterio.open, of_gdal)),
            *(mock.patch.object(module, "open", refusing(open, error)) for module in (io, builtins)),
        ]

    def __enter__(self):
        for patch in self.patches:
            patch.start()

    def __exit__(self, *error):
        for patch in self.patches:
            patch.stop()


class absent_while_opened:
    """A mount that blinks: the file is absent for the moment in which it is opened."""

    def __init__(self, path):
        self.path, self.times = path, 0
        plain = open_raster.open_alone

        def opened(file):
            if file != path:
                return plain(file)
            hidden = path.with_suffix(".away")
            path.rename(hidden)
            self.times += 1
            try:
                return plain(file)
            finally:
                hidden.rename(path)

        self.patch = mock.patch.object(open_raster, "open_alone", opened)

    def __enter__(self):
        self.patch.start()

    def __exit__(self, *error):
        self.patch.stop()
        assert self.times


@pytest.fixture(scope="module")
def scratch(survey, tmp_path_factory):
    out = tmp_path_factory.mktemp("scratch") / "run"
    summary, _ = night(out, catalog_of(survey))
    assert summary.exit_code == 0
    return out


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("fault", [denied, failing, absent_while_opened])
def test_raster_unreadable_for_one_night_leaves_no_trace(name, fault, survey, scratch, tmp_path):
    path, catalog = one_file(survey, name), catalog_of(survey)
    with fault(path):
        summary, failures = night(tmp_path / "run", catalog)
    assert summary.exit_code == 1
    assert summary.failed > 0
    assert {failure.file for failure in failures} == {str(path)}
    summary, _ = night(tmp_path / "run", catalog)
    assert summary.exit_code == 0
    assert_equal(tmp_path / "run", scratch)
    assert all("\n" not in failure.message for failure in failures)
    assert all("run again" in failure.message for failure in failures)


def test_raster_read_at_the_second_attempt_is_used(survey, scratch, tmp_path, monkeypatch):
    path, attempts = one_file(survey), []
    plain = open_raster.open_alone

    def opened(file):
        if file == path:
            attempts.append(file)
            if len(attempts) % 2:
                raise rasterio.errors.RasterioIOError("Read failed. See previous exception for details.")
        return plain(file)

    monkeypatch.setattr(open_raster, "open_alone", opened)
    summary, _ = night(tmp_path / "run", catalog_of(survey))
    assert attempts
    assert summary.exit_code == 0
    assert_equal(tmp_path / "run", scratch)


def test_side_car_unreadable_for_one_night_leaves_no_trace(survey, tmp_path):
    """GDAL takes a raster without a side-car file that it may not open: here, without its nodata value."""
    path = one_file(survey, "dtm")
    side = path.with_name(f"{path.name}.aux.xml")
    side.write_text(NODATA.format(-9999))
    try:
        catalog = catalog_of(survey)
        assert night(tmp_path / "scratch", catalog)[0].exit_code == 0
        with denied(side):
            summary, failures = night(tmp_path / "run", catalog)
        assert summary.failed > 0
        assert all(f"Permission denied ({side})" in failure.message for failure in failures)
        assert night(tmp_path / "run", catalog)[0].exit_code == 0
        assert_equal(tmp_path / "run", tmp_path / "scratch")
    finally:
        side.unlink()


def test_roads_unreadable_for_one_night_leave_no_trace(survey, tmp_path):
    path, catalog = survey / "roads.gpkg", catalog_of(survey, "roads.json", roads="roads.gpkg")
    assert night(tmp_path / "scratch", catalog, "production_vector")[0].exit_code == 0
    with denied(path):
        summary, failures = night(tmp_path / "run", catalog, "production_vector")
    assert summary.failed == 4
    assert {failure.file for failure in failures} == {str(path)}
    assert night(tmp_path / "run", catalog, "production_vector")[0].exit_code == 0
    assert_equal(tmp_path / "run", tmp_path / "scratch")


@pytest.mark.parametrize("part", [".shp", ".shx", ".dbf"])
def test_part_of_shapefile_zeroed_for_one_night_leaves_no_trace(survey, tmp_path, part):
    """GDAL would read the roads without geometries, or without the attributes that give their widths."""
    path = survey / "roads.shp"
    geopandas.read_file(survey / "roads.gpkg").to_file(path)
    catalog = catalog_of(survey, "roads.json", roads="roads.shp")
    assert night(tmp_path / "scratch", catalog, "production_vector")[0].exit_code == 0
    with zeroed(path.with_suffix(part)):
        assert night(tmp_path / "run", catalog, "production_vector")[0].failed == 4
    assert night(tmp_path / "run", catalog, "production_vector")[0].exit_code == 0
    assert_equal(tmp_path / "run", tmp_path / "scratch")


def test_missing_file_fails_only_its_tile_and_is_used_when_restored(survey, scratch, tmp_path):
    path, catalog = one_file(survey), catalog_of(survey)
    hidden = path.with_suffix(".away")
    path.rename(hidden)
    try:
        summary, failures = night(tmp_path / "run", catalog)
    finally:
        hidden.rename(path)
    assert (summary.done, summary.failed) == (3, 1)
    assert "is missing; restore it" in failures[0].message
    assert night(tmp_path / "run", catalog)[0].exit_code == 0
    assert_equal(tmp_path / "run", scratch)


def test_damaged_file_fails_only_its_tile(survey, tmp_path):
    path, catalog = one_file(survey), catalog_of(survey)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    try:
        summary, failures = night(tmp_path / "run", catalog)
    finally:
        path.write_bytes(data)
    assert (summary.done, summary.failed) == (3, 1)
    assert failures[0].file == str(path)
    assert "fetch it again" in failures[0].message


def test_damaged_pixels_fail_only_their_tile(survey, tmp_path):
    path, catalog = one_file(survey), catalog_of(survey)
    data = path.read_bytes()
    with rasterio.open(path) as raster:
        values, profile = raster.read(), raster.profile | {"compress": "deflate", "tiled": False}
    with rasterio.open(path, "w", **profile) as raster:
        raster.write(values)
    damaged = bytearray(path.read_bytes())
    middle = len(damaged) // 2
    damaged[middle : middle + 100] = np.random.default_rng(0).bytes(100)
    path.write_bytes(damaged)
    try:
        summary, failures = night(tmp_path / "run", catalog)
    finally:
        path.write_bytes(data)
    assert [failure.tile_id for failure in failures] == [path.stem]
    assert (summary.done, summary.failed) == (3, 1)
    assert failures[0].file == str(path)


def test_damaged_block_of_a_sheet_fails_only_the_tile_it_lies_on(survey, scratch, tmp_path):
    sheet = sheet_of(survey)
    catalog = catalog_of(survey, "sheet.json", dsm="sheet.tif")
    # Of the north-western tile, 8 m from its neighbours.
    damage(sheet, 20, 20)
    summary, failures = night(tmp_path / "run", catalog)
    assert (summary.done, summary.failed) == (3, 1)
    assert [failure.tile_id for failure in failures] == ["500000_5600040"]
    for tile in Catalog.read(catalog).tiles:
        if tile.id == "500000_5600040":
            continue
        name = f"tiles/{tile.id}/{tile.id}_flexroad_surface.npz"
        surface, whole = (npz.decode(out / name) for out in (tmp_path / "run", scratch))
        x, y = np.meshgrid(tile.grid.eastings, tile.grid.northings)
        # The surface sees the hole from afar, but is one.
        assert np.abs(surface.height(x, y) - whole.height(x, y)).max() < 0.05


def test_file_that_cannot_be_hashed_counts_as_missing(survey):
    """Else a result of its bytes would be stored under the fingerprint of a missing file."""
    path = one_file(survey)
    tile = next(tile for tile in Catalog.read(catalog_of(survey)).tiles if tile.id == path.stem)
    pattern = Pattern.of(load_config("production", LIGHT))
    readable = pattern.graph(tile, checksum=True)
    sources._sha256.cache_clear()
    with denied(path):
        unreadable = pattern.graph(tile, checksum=True)
    assert readable.file_stats[str(path)] is not None
    assert unreadable.file_stats[str(path)] is None
    assert str(path) in unreadable.tile.missing
    assert unreadable.fingerprint != readable.fingerprint


class zeroed:
    """A file whose bytes are zeros behind the first ones, with the same size and time.

    So are pages of a network cache, a restored backup, or an ``rsync --inplace -t`` that was interrupted.
    """

    def __init__(self, path, start=8):
        self.path, self.start = path, start

    def __enter__(self):
        self.data, self.stat = self.path.read_bytes(), self.path.stat()
        self._write(self.data[: self.start] + bytes(len(self.data) - self.start))

    def __exit__(self, *error):
        self._write(self.data)

    def _write(self, data):
        self.path.write_bytes(data)
        os.utime(self.path, ns=(self.stat.st_atime_ns, self.stat.st_mtime_ns))


@pytest.mark.parametrize("name", NAMES)
def test_file_zeroed_for_one_night_leaves_no_trace(name, survey, scratch, tmp_path):
    path, catalog = one_file(survey, name), catalog_of(survey)
    with zeroed(path):
        summary, failures = night(tmp_path / "run", catalog)
    assert (summary.done, summary.failed) == (3, 1)
    assert {failure.file for failure in failures} == {str(path)}
    summary, _ = night(tmp_path / "run", catalog)
    assert (summary.exit_code, summary.cached) == (0, 0)
    assert_equal(tmp_path / "run", scratch)
    assert night(tmp_path / "run", catalog)[0].cached == 4


@pytest.mark.parametrize("end", [".aux.xml", ".msk"])
def test_side_car_zeroed_for_one_night_leaves_no_trace(end, survey, tmp_path):
    """GDAL takes a raster without a damaged side-car file, here with ground of 7 m in place of nodata."""
    path, catalog = one_file(survey, "dtm"), catalog_of(survey)
    side, data = path.with_name(path.name + end), path.read_bytes()
    with rasterio.open(path) as raster:
        values, profile = raster.read(), raster.profile | {"nodata": None}
    values[0, :10, :10] = 7
    # rasterio would write into the file that is there.
    path.unlink()
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK="NO"),
        rasterio.open(path, "w", **profile) as raster,
    ):
        raster.write(values)
        if end == ".msk":
            raster.write_mask(values[0] != 7)
        else:
            side.write_text(NODATA.format(7))
    try:
        assert night(tmp_path / "scratch", catalog)[0].exit_code == 0
        with zeroed(side):
            summary, failures = night(tmp_path / "run", catalog)
        assert (summary.done, summary.failed) == (3, 1)
        assert f"has the side-car file {side.name}, which" in failures[0].message
        assert night(tmp_path / "run", catalog)[0].exit_code == 0
        assert_equal(tmp_path / "run", tmp_path / "scratch")
    finally:
        side.unlink()
        path.write_bytes(data)


def sheet_of(survey):
    """Write the DSM of all tiles as one sheet of blocks; return its path."""
    heights, transform = merge(sorted((survey / "dsm").glob("*.tif")))
    form = {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "deflate"}
    return write(survey / "sheet.tif", heights[0], transform=transform, crs="EPSG:25832", **form)


def test_blocks_damaged_for_some_nights_leave_no_trace(survey, tmp_path):
    """What was computed without other blocks of the same file is another result, with another name."""
    sheet, out = sheet_of(survey), tmp_path / "run"
    catalog = catalog_of(survey, "sheet.json", dsm="sheet.tif")
    assert night(tmp_path / "scratch", catalog)[0].exit_code == 0
    data, stat, loads = sheet.read_bytes(), sheet.stat(), []
    for cells in ([(20, 20)], [(20, 20)], [(4, 4), (20, 20)], []):
        sheet.write_bytes(data)
        for cell in cells:
            damage(sheet, *cell)
        os.utime(sheet, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        assert night(out, catalog)[0].failed == len(cells[:1])
        item = load_checked((out / "tiles" / "500040_5600040" / "item.json").read_bytes())
        loads.append(item["properties"]["flexroad:nodes"]["flexroad"]["load"])
    assert loads[0] == loads[1]
    assert len(set(loads)) == 3
    assert_equal(out, tmp_path / "scratch")


def test_damaged_file_is_named_by_every_command(survey, tmp_path):
    path, catalog = one_file(survey), catalog_of(survey)
    name = f"dsm dsm/{path.name}"
    with zeroed(path):
        night(tmp_path / "run", catalog)
        again, _ = night(tmp_path / "run", catalog)
        assert (again.done, again.cached, again.failed) == (3, 0, 1)
        run = Run.open(tmp_path / "run")
        with open_database(run) as database:
            states = list(tile_states(run, database))
        assert [state for _, state in states] == ["failed" if s.failed else "done" for s, _ in states]
        assert [status.last_record.left_out for status, _ in states if status.done] == [(name,)] * 3
        plan(run, run.catalog.tiles, (lines := []).append)
        assert sum(f"file left out: {name} could not be used" in line for line in lines) == 3
        # A thread keeps sources open, as they were.
        with ThreadPoolExecutor(1) as thread:
            thread.submit(assert_computed_as_stored, run, tmp_path / "empty").result()


def assert_computed_as_stored(run, empty):
    """Tiles are read from the store, or computed again without the file: to the same surface."""
    stored = RunPlace.of(run)
    for tile, snapshot in snapshots(run, run.catalog.tiles, "flexroad"):
        if snapshot:
            places = stored, replace(stored, store=str(empty))
            one, other = (FinishedTile(tile, "flexroad", snapshot, place) for place in places)
            assert encode(one.surface, {}, (), "") == encode(other.surface, {}, (), "")
            assert one.graph.fingerprint == snapshot.fingerprint


def test_rerun_of_failed_tiles_takes_those_without_the_file(survey, scratch, tmp_path):
    path, catalog = one_file(survey), catalog_of(survey)
    with zeroed(path):
        night(tmp_path / "run", catalog)
    run = Run.open(tmp_path / "run")
    failed = rerun_filter(run, (), failed=True)
    assert all(map(failed, run.catalog.tiles))
    assert run_tiles(run, SerialExecutor(), failed).exit_code == 0
    assert_equal(tmp_path / "run", scratch)
    assert not any(map(rerun_filter(run, (), failed=True), run.catalog.tiles))


def test_photo_zeroed_for_one_night_leaves_no_trace(tmp_path):
    """A second file covers the tile, so that the first one is left out without an error."""
    survey = tmp_path / "survey"
    write_scenes(survey, 2, seed=5, size_m=SIZE_M, dop=True)
    path = one_file(survey, "dop")
    with rasterio.open(path) as raster:
        colour, profile = raster.read(), raster.profile
    with rasterio.open(path.with_name(f"z{path.name}"), "w", **profile) as raster:
        raster.write(255 - colour)
    catalog = catalog_of(survey, dop="dop/*.tif")
    settings = [*LIGHT, "export.texture=true"]
    night(tmp_path / "scratch", catalog, settings=settings)
    with zeroed(path):
        summary, _ = night(tmp_path / "run", catalog, settings=settings)
    assert summary.exit_code == 0
    assert products(tmp_path / "run") != products(tmp_path / "scratch")
    night(tmp_path / "run", catalog, settings=settings)
    assert_equal(tmp_path / "run", tmp_path / "scratch")
