"""A source changes with each file that it consists of, and is never written."""

import os
import shutil
from datetime import UTC, datetime
from pathlib import Path

import geopandas
import numpy as np
import pytest
from shapely import LineString

from flexroad.catalog.guard import source_files
from flexroad.catalog.guard.open_vector import vector_name
from flexroad.catalog.guard.source_files import files_of, source_stat
from flexroad.catalog.storage.paths import stat
from flexroad.catalog.tile import Layer, Tile
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.worker.evaluator import SourceChanged, check_unchanged
from flexroad.tasks.io.vectors import Query, read_near
from tests.make_rasters import write
from tests.make_roads import GRID, on_grid
from tests.make_wal import add_to_wal, in_wal_mode

LINES = [LineString(on_grid((0, y), (90, y))) for y in (20, 60)]


def roads(path, shapes=LINES):
    # GDAL's index would be changed by a trigger with functions that only GDAL has.
    more = {"layer_options": {"SPATIAL_INDEX": "NO"}} if path.suffix == ".gpkg" else {}
    table = geopandas.GeoDataFrame({"width": [8.0] * len(shapes)}, geometry=shapes, crs=GRID.crs)
    table.to_file(path, **more)
    return path


def read(path):
    return read_near(Query(path, None, None, ("width",), None, GRID.crs), GRID.bounds)


def fingerprint(layer, path, checksum=False):
    config = load_config("production_vector" if layer == "roads" else "production")
    flat = write(path.with_name("other.tif"), np.ones((100, 100)), GRID.west, GRID.north)
    os.utime(flat, ns=(0, 0))
    names = {"dsm": "other.tif", "dtm": "other.tif", "road_mask": "other.tif", layer: path.name}
    layers = tuple(Layer(name, (file,)) for name, file in names.items())
    tile = Tile("a", GRID, layers, str(path.parent), datetime(2025, 3, 1, tzinfo=UTC))
    return Pattern.of(config).graph(tile, checksum)


@pytest.mark.parametrize("name", ["a.tif", "a.gpkg", "a.geojson", "a.vrt", "a.xyz.gz", "a", "a.b.tif"])
def test_state_of_one_file_is_its_size_and_time(name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"x")
    for other in ("b.tfw", "a2.tfw", "a.txt", "a.gpkg-shm", "ab.prj"):
        (tmp_path / other).write_bytes(b"x")
    assert source_stat(path) == stat(path)
    assert source_stat(tmp_path / "gone.tif") is None
    # An empty one is left by a reader.
    (tmp_path / "a.gpkg-wal").touch()
    assert source_stat(path) == stat(path)


@pytest.mark.parametrize("settled_ns", [0, source_files.SETTLED_NS])
@pytest.mark.parametrize(
    ("name", "part"),
    [
        *[("a.tif", f"a{end}") for end in (".tfw", ".TFW", ".tifw", ".wld", ".prj", ".tif.msk")],
        *[("a.b.tif", end) for end in ("a.b.tfw", "a.b.tif.ovr")],
        ("a.tif", "a.tif.aux.xml"),
        ("a.jp2", "a.j2w"),
        ("a.asc", "a.prj"),
        *[("a.shp", f"a{end}") for end in (".dbf", ".DBF", ".shx", ".prj", ".cpg")],
        ("a.gpkg", "a.gpkg-wal"),
        ("a.gpkg", "a.gpkg-journal"),
    ],
)
def test_state_changes_with_each_part(name, part, settled_ns, tmp_path, monkeypatch):
    monkeypatch.setattr(source_files, "SETTLED_NS", settled_ns)
    path, beside = tmp_path / name, tmp_path / part
    path.write_bytes(b"x")
    os.utime(tmp_path, ns=(0, 1))
    states = [source_stat(path)]
    beside.write_bytes(b"1")
    states.append(source_stat(path))
    os.utime(beside, (1, 1))
    states.append(source_stat(path))
    beside.write_bytes(b"12")
    states.append(source_stat(path))
    assert len(set(states)) == 4
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        assert source_stat(Path(name)) == states[-1]
    beside.unlink()
    assert source_stat(path) == states[0]
    assert list(files_of(path)) == [path]


@pytest.mark.parametrize("checksum", [False, True])
def test_fingerprint_changes_with_each_part_of_a_source(checksum, tmp_path):
    path = roads(tmp_path / "a.shp")
    before = fingerprint("roads", path, checksum)
    assert fingerprint("roads", path, checksum).fingerprint == before.fingerprint
    check_unchanged(before, [path])
    dbf = tmp_path / "a.dbf"
    os.utime(dbf, (1, 1))
    assert (fingerprint("roads", path, checksum).fingerprint == before.fingerprint) == checksum
    dbf.write_bytes(dbf.read_bytes().replace(b"8.0", b"9.0"))
    assert fingerprint("roads", path, checksum).fingerprint != before.fingerprint
    with pytest.raises(SourceChanged) as raised:
        check_unchanged(before, [path])
    assert raised.value.file == str(path)
    path = write(tmp_path / "dsm.tif", np.ones((100, 100), np.float32), GRID.west, GRID.north)
    before = fingerprint("dsm", path, checksum)
    (tmp_path / "dsm.tfw").write_text("1\n0\n0\n-1\n0\n0\n")
    assert fingerprint("dsm", path, checksum).fingerprint != before.fingerprint


@pytest.mark.parametrize("writable", [True, False])
def test_edit_in_a_wal_is_read_and_nothing_is_written(writable, tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    path = in_wal_mode(roads(folder / "a.gpkg", LINES[:1]))
    assert len(read(path)) == 1
    before = fingerprint("roads", path)
    add_to_wal(path, LINES[1], "a")
    assert fingerprint("roads", path).fingerprint != before.fingerprint

    def files():
        return {file.name: (file.read_bytes(), file.stat().st_mtime_ns) for file in folder.iterdir()}

    state, seen = files(), folder.stat().st_mtime_ns
    if not writable:
        folder.chmod(0o500)
    assert len(read(path)) == 2
    assert len(read(path)) == 2
    assert (files(), folder.stat().st_mtime_ns) == (state, seen)
    folder.chmod(0o700)


def test_file_in_wal_mode_without_edits_is_not_opened_in_its_folder(tmp_path):
    """SQLite makes a -wal file beside it while it reads."""
    path = in_wal_mode(roads(tmp_path / "a.gpkg"))
    seen = tmp_path.stat().st_mtime_ns
    assert len(read(path)) == 2
    assert tmp_path.stat().st_mtime_ns == seen
    assert vector_name(path) != str(path)
    assert vector_name(roads(tmp_path / "b.gpkg")) == str(tmp_path / "b.gpkg")


def test_interrupted_change_is_rolled_back_in_a_copy_alone(tmp_path):
    path = roads(tmp_path / "a.gpkg")
    whole = path.read_bytes()
    shutil.copy(path, tmp_path / "a.gpkg-journal")
    read(path)
    assert path.read_bytes() == whole
    assert (tmp_path / "a.gpkg-journal").read_bytes() == whole
