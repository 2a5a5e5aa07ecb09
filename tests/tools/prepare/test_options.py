"""The area of a `prepare` command, its memory and its disk are checked before rasters are made."""

import shutil
from collections import namedtuple

import numpy as np
import pytest

from flexroad.catalog import CatalogError
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.tasks import TaskError, memory
from flexroad.tools.prepare import blockwise, point_reading
from flexroad.tools.prepare import from_points as points
from flexroad.tools.prepare.from_points import prepare_points
from flexroad.tools.prepare.options import PrepareOptions, check_extent, prepared_grid
from flexroad.tools.prepare.points.to_rasters import Options
from tests.make_clouds import write_cloud

CRS = "EPSG:25832"
SITE = np.array([356_000.0, 5_699_000.0, 50.0])
Usage = namedtuple("Usage", "total used free")


def cloud(path, *outliers, n=2000):
    """Write points on 40 m x 40 m, and more at given distances (m) from them."""
    near = np.random.default_rng(1).uniform(0, 40, (n, 3)) * [1, 1, 0.02]
    far = np.array(outliers, float).reshape(-1, 2) @ np.eye(2, 3)
    return write_cloud(path, SITE + np.vstack([near, far]), 2, CRS, scale=0.001)


def prepare(files, out, **common):
    return prepare_points(files, out, PrepareOptions(**common), Options(), SerialExecutor(), lambda _: None)


def grid(bounds, out, photo=True, per_cell=0, **common):
    return prepared_grid(bounds, CRS, PrepareOptions(**common), "a.laz", out, photo=photo, per_cell=per_cell)


@pytest.mark.parametrize(
    ("clouds", "chunk", "message"),
    [
        (([], [(2e6, 7)]), 5000, "b.las has a point at easting 2356000.00 and northing 5699007.00"),
        (([(9, 2e6)],), 5000, "a.las has a point at easting 356009.00 and northing 7699000.00"),
        # A part of a file, far from the parts before: its farthest point.
        (([(0, 2e6), (5, 2.1e6)],), 1000, "a.las has a point at easting 356005.00 and northing 7799000.00"),
        # Few points behind a gap.
        (
            ([], [(70_000, 60_000), (70_001, 60_000)]),
            5000,
            r"b.las has points at easting 42600[01].00 and northing 5759000.00 \(m\), \d\d km from the",
        ),
    ],
)
def test_distant_points_are_named_with_their_file(tmp_path, monkeypatch, clouds, chunk, message):
    monkeypatch.setattr(point_reading, "CHUNK", chunk)
    files = [cloud(tmp_path / f"{name}.las", *far) for name, far in zip("ab", clouds, strict=False)]
    with pytest.raises(CatalogError, match=message):
        prepare(files, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_area_with_a_gap_and_few_cells_or_of_a_whole_state_is_prepared(tmp_path):
    coarse = {"cell_m": 20.0, "dop_cell_m": 20.0, "tile_size_m": 40}
    assert prepare([cloud(tmp_path / "a.laz", (30_000, 10))], tmp_path / "out", **coarse).tiles == 1
    check_extent("a.laz", np.array([[280_000.0, 540_000], [5_570_000, 5_820_000]]), None)


@pytest.mark.parametrize("bounds", [(0, 0, np.inf, 9), (np.nan, 0, 9, 9), (0, 0, 1e8, 9)])
def test_bounds_that_are_no_area_raise(tmp_path, bounds):
    with pytest.raises(CatalogError, match="a.laz reaches from easting .* at most 500 km; correct"):
        grid(bounds, tmp_path)


@pytest.mark.parametrize(("option", "name"), [("cell_m", "--cell"), ("dop_cell_m", "--dop-cell")])
def test_too_many_cells_raise_with_the_option(tmp_path, option, name):
    with pytest.raises(CatalogError, match=f"1e.12 cells with {name} 0.001, but .* use a larger {name}"):
        grid((0, 0, 1000, 1000), tmp_path, **{option: 0.001})


def test_steps_that_hold_the_area_are_compared_with_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "limit", lambda: 2**30)
    assert grid((0, 0, 3000, 3000), tmp_path).shape == (3000, 3000)
    with pytest.raises(TaskError, match=r"a.laz, 9e.06 cells, would need about 2.5 GiB .* 1.0 GiB .*--cell"):
        grid((0, 0, 3000, 3000), tmp_path, per_cell=300)
    with pytest.raises(TaskError, match=r"a.laz, 9e.07 cells, would need"):
        grid((0, 0, 9000, 10_000), tmp_path, roads=tmp_path / "roads.gpkg")
    with pytest.raises(TaskError, match="would need"):
        grid((0, 0, 20_000, 20_000), tmp_path, tile_size_m=20_000)


def test_rasters_larger_than_the_disk_raise(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, 2**30))
    assert grid((0, 0, 3000, 3000), tmp_path / "new" / "out").shape == (3000, 3000)
    with pytest.raises(
        ConfigError, match=r"a.laz would need about 9.9 GiB .* 1.0 GiB are free; use larger cells"
    ):
        grid((0, 0, 10_000, 10_000), tmp_path / "new" / "out")


def test_points_larger_than_the_disk_raise_before_they_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, 1000))
    monkeypatch.setattr(points, "bucket_points", None)
    with pytest.raises(ConfigError, match="the points of .*a.laz would need about .* prepare fewer files"):
        prepare([cloud(tmp_path / "a.laz")], tmp_path / "out")


def test_block_larger_than_memory_raises(tmp_path, monkeypatch):
    monkeypatch.setattr(blockwise, "_read_points", None)
    monkeypatch.setattr(memory, "limit", lambda: 10**8)
    with pytest.raises(TaskError, match=r"block 356000_5699000, [56].*points and .* thin the points"):
        prepare([cloud(tmp_path / "a.laz", n=600_000)], tmp_path / "out", cell_m=10, dop_cell_m=10)
    assert not (tmp_path / "out").exists()
