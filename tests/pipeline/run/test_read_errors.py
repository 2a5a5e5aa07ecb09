"""A source that cannot be read for one night: the next night gives what a run from scratch gives.

Its size and time stay the same, so no fingerprint shows that it was not read.
"""

import builtins
import contextlib
import errno
import io
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from unittest import mock

import geopandas
import numpy as np
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
from tests.whole_run import assert_equal, products

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

SIZE_M = 40
COARSE = ["fit.spacing_m=8"]
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


def night(out, catalog, config="production", settings=COARSE):
    """Run a catalog as a new process does, with no file open; return summary and failures."""
    for cached in (vectors._layers, vectors._part, sources._sha256):
        cached.cache_clear()

    def run():
        opened = Run.create(out, load_config(config, settings), Catalog.read(catalog))
        failures = []
        summary = run_tiles(opened, SerialExecutor(), watch=lambda result: failures.extend(result.failures))
        return summary, failures

    # Files are kept open for each thread.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(run).result()


def one_file(survey, name="dsm"):
    """A file of one tile, which the other three see in their halos and along their borders."""
    return sorted((survey / name).glob("*.tif"))[1]


@pytest.fixture(scope="module")
def scratch(survey, tmp_path_factory):
    out = tmp_path_factory.mktemp("scratch") / "run"
    assert night(out, catalog_of(survey))[0].exit_code == 0
    return out


# --- faults of a file ---------------------------------------------------------------------------------


@contextlib.contextmanager
def denied(path):
    """A file that may not be read."""
    mode = path.stat().st_mode
    path.chmod(0)
    # Capabilities belong to a thread, and a new one inherits them.
    with permissions_enforced():
        yield
    path.chmod(mode)


@contextlib.contextmanager
def failing(path):
    """A disk that gives no byte of a file."""

    def refusing(plain, read_error):
        def opened(file, *more, **options):
            if not isinstance(file, int) and Path(file) == path:
                raise read_error
            return plain(file, *more, **options)

        return opened

    error = OSError(errno.EIO, os.strerror(errno.EIO), str(path))
    of_gdal = rasterio.errors.RasterioIOError("Read failed. See previous exception for details.")
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(rasterio, "open", refusing(rasterio.open, of_gdal)))
        for module in (io, builtins):
            stack.enter_context(mock.patch.object(module, "open", refusing(open, error)))
        yield


@contextlib.contextmanager
def missing(path):
    hidden = path.rename(path.with_suffix(".away"))
    try:
        yield
    finally:
        hidden.rename(path)


@contextlib.contextmanager
def absent_while_opened(path):
    """A mount that blinks: the file is absent for the moment in which it is opened."""
    plain, times = open_raster.open_alone, []

    def opened(file):
        with missing(path) if file == path else contextlib.nullcontext():
            times.append(file == path)
            return plain(file)

    with mock.patch.object(open_raster, "open_alone", opened):
        yield
    assert any(times)


@contextlib.contextmanager
def changed(path, content):
    """A file with other bytes of the same time, for a while."""
    data, stat = path.read_bytes(), path.stat()
    for bytes_ in (content, data):
        path.write_bytes(bytes_)
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        if bytes_ is content:
            yield


def zeroed(path):
    """A file whose bytes are zeros behind the first ones, with the same size and time.

    So are pages of a network cache, a restored backup, or an ``rsync --inplace -t`` that was interrupted.
    """
    data = path.read_bytes()
    return changed(path, data[:8] + bytes(len(data) - 8))


def halved(path):
    return changed(path, path.read_bytes()[: path.stat().st_size // 2])


def damaged_pixels(path):
    other = path.with_suffix(".other")
    with rasterio.open(path) as raster:
        values, profile = raster.read(), raster.profile | {"compress": "deflate", "tiled": False}
    with rasterio.open(other, "w", **profile) as raster:
        raster.write(values)
    data = bytearray(other.read_bytes())
    other.unlink()
    middle = len(data) // 2
    data[middle : middle + 100] = np.random.default_rng(0).bytes(100)
    return changed(path, data)


FOR_ALL = {denied: "run again", failing: "run again", absent_while_opened: "run again"}
"""Faults with which every tile fails that sees the file, with a part of the message."""
FOR_ONE = {zeroed: "", missing: "is missing; restore it", halved: "fetch it again", damaged_pixels: ""}
"""Faults with which only the tile fails that it lies on."""


@pytest.mark.parametrize(
    ("fault", "name"),
    [(fault, name) for fault in (*FOR_ALL, zeroed) for name in NAMES]
    + [(fault, "dsm") for fault in (missing, halved, damaged_pixels)],
)
def test_raster_unreadable_for_one_night_leaves_no_trace(fault, name, survey, scratch, tmp_path):
    path, catalog = one_file(survey, name), catalog_of(survey)
    with fault(path):
        summary, failures = night(tmp_path / "run", catalog)
    assert summary.exit_code == 1
    assert summary.done + summary.failed == 4
    assert {failure.file for failure in failures} == {str(path)}
    assert not any("\n" in failure.message for failure in failures)
    assert all((FOR_ALL | FOR_ONE)[fault] in failure.message for failure in failures)
    if fault in FOR_ONE:
        assert [failure.tile_id for failure in failures] == [path.stem]
    summary, _ = night(tmp_path / "run", catalog)
    # No result without the file counts.
    assert (summary.exit_code, summary.cached) == (0, 0)
    assert_equal(tmp_path / "run", scratch)
    if fault in FOR_ONE:
        assert night(tmp_path / "run", catalog)[0].cached == 4


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


@pytest.mark.parametrize(
    ("fault", "end", "message"),
    [
        (denied, ".aux.xml", "Permission denied ({side})"),
        (zeroed, ".aux.xml", "has the side-car file {side.name}, which"),
        (zeroed, ".msk", "has the side-car file {side.name}, which"),
    ],
)
def test_side_car_unreadable_for_one_night_leaves_no_trace(fault, end, message, survey, tmp_path):
    """GDAL takes a raster without a side-car file that it cannot read: here ground of 7 m for nodata."""
    path, catalog = one_file(survey, "dtm"), catalog_of(survey)
    side, data = path.with_name(path.name + end), path.read_bytes()
    with rasterio.open(path) as raster:
        values, profile = raster.read(), raster.profile | {"nodata": None}
    values[0, :10, :10] = 7
    # rasterio would write into the file that is there.
    path.unlink()
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK="NO"), rasterio.open(path, "w", **profile) as raster:
        raster.write(values)
        if end == ".msk":
            raster.write_mask(values[0] != 7)
        else:
            side.write_text(NODATA.format(7))
    try:
        assert night(tmp_path / "scratch", catalog)[0].exit_code == 0
        with fault(side):
            summary, failures = night(tmp_path / "run", catalog)
        assert summary.failed > 0
        assert (summary.failed == 1) == (fault is zeroed)
        assert all(message.format(side=side) in failure.message for failure in failures)
        assert night(tmp_path / "run", catalog)[0].exit_code == 0
        assert_equal(tmp_path / "run", tmp_path / "scratch")
    finally:
        side.unlink()
        path.write_bytes(data)


@pytest.mark.parametrize(
    ("name", "fault", "part"),
    [("roads.gpkg", denied, ".gpkg"), *(("roads.shp", zeroed, part) for part in (".shp", ".shx", ".dbf"))],
)
def test_roads_unreadable_for_one_night_leave_no_trace(name, fault, part, survey, tmp_path):
    """GDAL would read a Shapefile without geometries, or without the attributes that give the widths."""
    path = survey / name
    if not path.exists():
        geopandas.read_file(survey / "roads.gpkg").to_file(path)
    catalog = catalog_of(survey, "roads.json", roads=name)
    assert night(tmp_path / "scratch", catalog, "production_vector")[0].exit_code == 0
    with fault(path.with_suffix(part)):
        summary, failures = night(tmp_path / "run", catalog, "production_vector")
    assert summary.failed == 4
    assert {failure.file for failure in failures} == {str(path)}
    assert night(tmp_path / "run", catalog, "production_vector")[0].exit_code == 0
    assert_equal(tmp_path / "run", tmp_path / "scratch")


def test_blocks_damaged_for_some_nights_leave_no_trace(survey, scratch, tmp_path):
    """What was computed without other blocks of the same file is another result, with another name."""
    heights, transform = merge(sorted((survey / "dsm").glob("*.tif")))
    form = {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "deflate"}
    sheet = write(survey / "sheet.tif", heights[0], transform=transform, crs="EPSG:25832", **form)
    catalog, out = catalog_of(survey, "sheet.json", dsm="sheet.tif"), tmp_path / "run"
    assert night(tmp_path / "scratch", catalog)[0].exit_code == 0
    data, stat, loads = sheet.read_bytes(), sheet.stat(), []
    # Cells of the north-western tile, of which the first lies 8 m from its neighbours.
    for cells in ([(20, 20)], [(20, 20)], [(4, 4), (20, 20)], []):
        sheet.write_bytes(data)
        for cell in cells:
            damage(sheet, *cell)
        os.utime(sheet, ns=(stat.st_atime_ns, stat.st_mtime_ns))
        _, failures = night(out, catalog)
        assert {failure.tile_id for failure in failures} == ({"500000_5600040"} if cells else set())
        item = load_checked((out / "tiles" / "500040_5600040" / "item.json").read_bytes())
        loads.append(item["properties"]["flexroad:nodes"]["flexroad"]["load"])
        if not loads[1:]:
            assert_near(Catalog.read(catalog).tiles, out, scratch)
    assert loads[0] == loads[1]
    assert len(set(loads)) == 3
    assert_equal(out, tmp_path / "scratch")


def assert_near(tiles, out, scratch):
    """The surfaces beside the damaged block see the hole from afar, but are still near the whole ones."""
    for tile in tiles:
        if tile.id == "500000_5600040":
            continue
        name = f"tiles/{tile.id}/{tile.id}_flexroad_surface.npz"
        surface, whole = (npz.decode(folder / name) for folder in (out, scratch))
        x, y = np.meshgrid(tile.grid.eastings, tile.grid.northings)
        assert np.abs(surface.height(x, y) - whole.height(x, y)).max() < 0.05


def test_file_that_cannot_be_hashed_counts_as_missing(survey):
    """Else a result of its bytes would be stored under the fingerprint of a missing file."""
    path = one_file(survey)
    tile = next(tile for tile in Catalog.read(catalog_of(survey)).tiles if tile.id == path.stem)
    pattern = Pattern.of(load_config("production", COARSE))
    readable = pattern.graph(tile, checksum=True)
    sources._sha256.cache_clear()
    with denied(path):
        unreadable = pattern.graph(tile, checksum=True)
    assert readable.file_stats[str(path)] is not None
    assert unreadable.file_stats[str(path)] is None
    assert str(path) in unreadable.tile.missing
    assert unreadable.fingerprint != readable.fingerprint


def test_damaged_file_is_named_by_every_command(survey, scratch, tmp_path):
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
    # `rerun --failed` takes the tiles that lack the file, too.
    failed = rerun_filter(run, (), failed=True)
    assert all(map(failed, run.catalog.tiles))
    assert run_tiles(run, SerialExecutor(), failed).exit_code == 0
    assert_equal(tmp_path / "run", scratch)
    assert not any(map(rerun_filter(run, (), failed=True), run.catalog.tiles))


def assert_computed_as_stored(run, empty):
    """Tiles are read from the store, or computed again without the file: to the same surface."""
    stored = RunPlace.of(run)
    for tile, snapshot in snapshots(run, run.catalog.tiles, "flexroad"):
        if snapshot:
            places = stored, replace(stored, store=str(empty))
            one, other = (FinishedTile(tile, "flexroad", snapshot, place) for place in places)
            assert encode(one.surface, {}, (), "") == encode(other.surface, {}, (), "")
            assert one.graph.fingerprint == snapshot.fingerprint


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
    settings = [*COARSE, "export.texture=true"]
    night(tmp_path / "scratch", catalog, settings=settings)
    with zeroed(path):
        summary, _ = night(tmp_path / "run", catalog, settings=settings)
    assert summary.exit_code == 0
    assert products(tmp_path / "run") != products(tmp_path / "scratch")
    night(tmp_path / "run", catalog, settings=settings)
    assert_equal(tmp_path / "run", tmp_path / "scratch")
