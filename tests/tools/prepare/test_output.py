"""Existing files in an output folder are not replaced, and errors of the disk name the right remedy."""

import errno
import os
import shutil
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import RasterioIOError

from flexroad.catalog import Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.tools.prepare import output
from flexroad.tools.prepare.output import NAMES, check_replaced, disk_errors, write_error
from flexroad.tools.prepare.raster_writer import RasterWriter

FULL, OTHER = "free disk space and repeat", "correct that or choose another folder with -o"
Usage = namedtuple("Usage", "free")


def prepared(out: Path) -> Path:
    grid = Grid("EPSG:25832", 400_000, 5_700_000, 1.0, 20, 20)
    with RasterWriter(out, grid, None, {"SOURCE": "made"}) as writer:
        writer.write("dsm", grid, np.full(grid.shape, 100.0))
        writer.write("road_mask", grid, np.ones(grid.shape, bool))
        writer.publish()
    return out


def raster(path: Path) -> None:
    transform = rasterio.transform.from_origin(400_000, 5_700_000, 1, 1)
    shape = {"width": 2, "height": 2, "count": 1, "dtype": "uint8"}
    with rasterio.open(path, "w", driver="GTiff", transform=transform, **shape) as file:
        file.write(np.ones((1, 2, 2), np.uint8))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("write", [raster, lambda path: path.write_text("mine"), Path.touch])
def test_file_of_others_is_refused_and_stays(tmp_path, name, write):
    write(tmp_path / name)
    before = (tmp_path / name).read_bytes()
    with pytest.raises(ConfigError) as refusal:
        check_replaced(tmp_path)
    assert str(refusal.value) == (
        f"{tmp_path / name} is not of an earlier `flexroad prepare` and would be replaced; "
        "choose another folder with -o, or move that file away"
    )
    assert (tmp_path / name).read_bytes() == before


def test_outputs_of_earlier_command_are_replaced_but_not_under_another_name(tmp_path):
    prepared(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    check_replaced(tmp_path)
    check_replaced(tmp_path / "new")
    (tmp_path / "catalog.parquet").unlink()
    check_replaced(tmp_path)
    shutil.copy(tmp_path / "dsm.tif", tmp_path / "dtm.tif")
    with pytest.raises(ConfigError, match=r"dtm\.tif is not of an earlier"):
        check_replaced(tmp_path)


def test_pipe_and_file_as_folder_are_refused(tmp_path):
    os.mkfifo(tmp_path / "dop.tif")
    with pytest.raises(ConfigError, match=r"dop\.tif: is a device, pipe or socket and is not replaced; "):
        check_replaced(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"notes\.txt is a file; choose a folder with -o"):
        check_replaced(tmp_path / "notes.txt")


@pytest.mark.parametrize(
    ("number", "remedy"),
    [(errno.ENOSPC, FULL), (errno.EDQUOT, FULL), (errno.EACCES, OTHER), (errno.EROFS, OTHER)],
)
def test_disk_error_names_reason_and_remedy(tmp_path, number, remedy):
    reason = os.strerror(number)
    with pytest.raises(ConfigError) as raised, disk_errors(tmp_path):
        raise OSError(number, reason)
    assert str(raised.value) == f"cannot write to {tmp_path}: {reason}; {remedy}"


@pytest.mark.parametrize(("free", "remedy"), [(4096, FULL), (10**9, OTHER)])
def test_error_without_number_is_of_a_full_disk_if_there_is_no_space(tmp_path, monkeypatch, free, remedy):
    monkeypatch.setattr(output.shutil, "disk_usage", lambda folder: Usage(free))
    error = write_error(tmp_path / "new" / "dsm.tif", RasterioIOError("Write error at scanline 0"))
    assert (
        str(error) == f"cannot write to {tmp_path / 'new' / 'dsm.tif'}: Write error at scanline 0; {remedy}"
    )
