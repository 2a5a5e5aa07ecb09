"""Files that stay open are read as if they were opened each time."""

import os
import shutil
from pathlib import Path

import numpy as np
import psutil
import pytest
import rasterio
from rasterio.errors import RasterioError

from flexroad.catalog.guard import open_raster
from flexroad.catalog.guard.open_raster import kept_raster
from flexroad.catalog.guard.source_files import InputRejected
from tests.make_rasters import damage, write

ONES = np.ones((3, 4), np.float32)


@pytest.fixture
def kept(monkeypatch):
    """An empty set of open files."""
    idle = open_raster._Idle()
    monkeypatch.setattr(open_raster, "_idle", idle)
    return idle


def value_of(path):
    with kept_raster(path) as raster:
        return raster.read(1)[0, 0]


def test_file_that_is_read_twice_is_opened_once(kept, tmp_path, monkeypatch):
    path = write(tmp_path / "a.tif", ONES)
    opened, open_alone = [], open_raster.open_alone
    monkeypatch.setattr(open_raster, "open_alone", lambda path: opened.append(path) or open_alone(path))
    assert [value_of(path), value_of(path)] == [1, 1]
    assert opened == [path]


@pytest.mark.parametrize("replaced", [True, False], ids=["replaced", "rewritten"])
def test_changed_file_is_read_again(kept, tmp_path, replaced):
    path = write(tmp_path / "a.tif", ONES)
    assert value_of(path) == 1
    other = write(tmp_path / "b.tif", 2 * ONES)
    if replaced:
        # Of the same size and time.
        os.utime(other, ns=(0, path.stat().st_mtime_ns))
        other.replace(path)
    else:
        shutil.copyfile(other, path)
    assert value_of(path) == 2


def test_removed_file_is_missing(kept, tmp_path):
    path = write(tmp_path / "a.tif", ONES)
    assert value_of(path) == 1
    path.unlink()
    with pytest.raises(FileNotFoundError), kept_raster(path):
        pass


def test_side_car_file_that_comes_later_is_read_and_checked(kept, tmp_path):
    path = write(tmp_path / "a.tif", ONES)
    with kept_raster(path) as raster:
        assert raster.read_masks(1).all()
    mask = write(tmp_path / "mask.tif", np.zeros((3, 4), np.uint8), photometric="minisblack")
    with rasterio.open(mask, "r+") as raster:
        raster.update_tags(INTERNAL_MASK_FLAGS_1=2)
    mask.rename(tmp_path / "a.tif.msk")
    with kept_raster(path) as raster:
        assert not raster.read_masks(1).any()
    assert path not in kept.files
    (tmp_path / "a.tif.msk").write_text("<VRTDataset/>")
    with pytest.raises(InputRejected, match="a.tif.msk"), kept_raster(path):
        pass


def test_damaged_file_is_not_kept(kept, tmp_path):
    path = write(tmp_path / "a.tif", ONES, compress="deflate")
    damage(path, 0, 0)
    with pytest.raises(RasterioError), kept_raster(path) as raster:
        raster.read(1)
    assert path not in kept.files
    assert raster.closed


def test_number_of_open_files_is_bounded(kept, tmp_path):
    paths = [write(tmp_path / f"{i}.tif", i * ONES) for i in range(open_raster.MOST_KEPT + 3)]
    assert [value_of(path) for path in paths] == list(range(len(paths)))
    assert list(kept.files) == paths[3:]
    # Of the files written here: what earlier tests left open may be closed at any time.
    opened = [Path(file.path) for file in psutil.Process().open_files()]
    assert sorted(set(opened) & set(paths)) == sorted(paths[3:])
    assert sum(path in paths for path in opened) == open_raster.MOST_KEPT


def test_file_that_is_in_use_is_opened_a_second_time(kept, tmp_path):
    path = write(tmp_path / "a.tif", ONES)
    with kept_raster(path) as first, kept_raster(path) as second:
        assert first is not second
        assert first.read(1)[0, 0] == second.read(1)[0, 0] == 1
    assert second.closed
    assert list(kept.files) == [path]
    assert value_of(path) == 1


def test_forked_process_opens_its_own_file(kept, tmp_path):
    path = write(tmp_path / "a.tif", ONES)
    assert value_of(path) == 1
    (_, dataset) = kept.files[path]
    if child := os.fork():
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    else:
        with kept_raster(path) as own:
            os._exit(int(own is dataset))
    assert value_of(path) == 1
