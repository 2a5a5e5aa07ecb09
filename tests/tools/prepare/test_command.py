"""``flexroad prepare`` on the command line: output, exit code and output folder."""

import os
import signal
import subprocess
import time
from dataclasses import replace

import numpy as np
import pytest
from shapely import box

from flexroad.catalog import Catalog
from flexroad.pipeline.run.lock import Owner, run_lock
from tests.command_line import PROCESS, call
from tests.make_clouds import write_cloud
from tests.permissions import permissions_enforced

WEST, SOUTH = 356_000.0, 5_699_000.0


def flexroad(*words, expect=0) -> str:
    result = call(*words).expected(expect)
    return result.out + result.err


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """A street on a slope, with houses on both sides: 120 m x 80 m."""
    rng = np.random.default_rng(5)
    east, north = rng.uniform(0, 1, (2, 60_000)) * [[120], [80]]
    house = (abs(north - 40) > 10) & (east % 30 < 12)
    height = 100 + 0.02 * east + 6 * house
    xyz = np.column_stack([east + WEST, north + SOUTH, height])
    return write_cloud(
        tmp_path_factory.mktemp("cloud") / "street.laz", xyz, np.where(house, 6, 2), "EPSG:25832"
    )


@pytest.fixture(scope="module")
def roads(tmp_path_factory):
    import geopandas

    path = tmp_path_factory.mktemp("roads") / "roads.gpkg"
    street = box(WEST, SOUTH + 35, WEST + 120, SOUTH + 45)
    geopandas.GeoDataFrame({"class": ["road"]}, geometry=[street], crs="EPSG:25832").to_file(path)
    return path


def test_prepare_points_prints_next_command_that_runs(cloud, roads, tmp_path):
    out = tmp_path / "street"
    output = flexroad("prepare", cloud, "-o", out, "--roads", roads, "--date", "2024-05-01", "--workers", 1)
    (next_line,) = (line for line in output.splitlines() if line.startswith("next: "))
    words = next_line.removeprefix("next: flexroad ").replace("RUN", str(tmp_path / "run")).split()
    assert "1 tile: 1 done" in flexroad(*words, "--executor", "serial")
    (tile,) = Catalog.read(out / "catalog.parquet").tiles
    assert (tile.dataset, f"{tile.datetime:%Y-%m-%d}", tile.datetime_assumed) == (
        "street",
        "2024-05-01",
        False,
    )


def test_prepare_points_options_are_applied(cloud, tmp_path):
    import rasterio

    flexroad(
        "prepare", cloud, "-o", tmp_path, "--cell", 2, "--dop-cell", 1, "--ground-class", 2, 6,
        "--bridge-class", 6, "--workers", 1,
    )  # fmt: skip
    with rasterio.open(tmp_path / "dtm.tif") as raster:
        assert raster.res == (2, 2)
        assert "2, 6" in raster.tags()["DTM"]
    assert (tmp_path / "bridges.tif").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere.laz"], "nowhere.laz"),
        (["CLOUD", "--crs", "EPSG:4"], "EPSG:4"),
        (["CLOUD", "--ground", "classes", "--ground-class", "9"], "class 9"),
        (["nowhere.obj"], "nowhere.obj"),
        (["nowhere"], "nowhere does not exist; give point clouds (.las, .laz), a mesh ("),
    ],
)
def test_prepare_invalid_input_is_one_line_and_leaves_no_folder(cloud, tmp_path, words, message):
    words = [cloud if word == "CLOUD" else word for word in words]
    output = flexroad("prepare", *words, "-o", tmp_path / "out", "--workers", 1, expect=2)
    (error,) = (line for line in output.splitlines() if line.startswith("error: "))
    assert message in error
    assert not (tmp_path / "out").exists()


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def refusal(*words) -> str:
    output = flexroad("prepare", *words, "--workers", 1, expect=2)
    (error,) = (line for line in output.splitlines() if line.startswith("error: "))
    assert "reading" not in output
    return error


@pytest.mark.parametrize("command", ["odm", "photos"])
def test_prepare_into_folder_with_raster_of_others_changes_nothing(cloud, tmp_path, command):
    (tmp_path / "dtm.tif").write_bytes(b"mine")
    assert f"{tmp_path / 'dtm.tif'} is not of an earlier" in refusal(cloud, "-o", tmp_path)
    assert contents(tmp_path) == {"dtm.tif": b"mine"}


def test_prepare_into_folder_in_use_is_refused(cloud, tmp_path):
    with run_lock(tmp_path):
        error = refusal(cloud, "-o", tmp_path)
        assert f"{tmp_path} is in use by pid {os.getpid()} " in error
        assert f"end it with `kill {os.getpid()}`" in error
        assert contents(tmp_path).keys() == {"lock.json"}


def test_prepare_again_takes_over_the_lock_of_a_killed_process_and_replaces_own_outputs(cloud, tmp_path):
    for took_over in (False, True):
        said = flexroad("prepare", cloud, "-o", tmp_path, "--workers", 1)
        assert ("note: took over the lock of pid" in said) == took_over
        assert not (tmp_path / "lock.json").exists()
        (tmp_path / "lock.json").write_bytes(replace(Owner.me(), pid=2**22 + 1).data)


def test_prepare_into_folder_that_cannot_be_written_names_the_remedy(cloud, tmp_path):
    (tmp_path / "closed").mkdir(mode=0o555)
    with permissions_enforced():
        error = refusal(cloud, "-o", tmp_path / "closed")
    remedy = "Permission denied; correct that or choose another folder with -o"
    assert error == f"error: cannot write to {tmp_path / 'closed'}: {remedy}"
    (tmp_path / "file").write_text("mine")
    error = refusal(cloud, "-o", tmp_path / "file")
    assert error == f"error: {tmp_path / 'file'} is a file; choose a folder with -o"
    error = refusal(cloud, "-o", tmp_path / "file" / "new")
    assert f"cannot write to {tmp_path / 'file' / 'new'}: Not a directory; correct that" in error


def test_prepare_misspelt_option_suggests_the_right_one(cloud, tmp_path):
    assert "--cell" in flexroad("prepare", cloud, "-o", tmp_path, "--cel", 2, expect=2)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.laz", ["--density", 9], "--density has no effect on point clouds (a.laz); leave it out"),
        ("a.laz", ["--control", "c.csv"], "--control has no effect on point clouds (a.laz); leave it out"),
        ("a.glb", ["--ground-class", 2], "--ground-class has no effect on a mesh (a.glb); leave it out"),
        ("a.jpg", ["--no-dop"], "--no-dop has no effect on photographs (a.jpg); leave it out"),
        ("a.jpg", ["--crs", "EPSG:25832"], "--crs has no effect on photographs (a.jpg); leave it out"),
    ],
)
def test_prepare_option_of_another_kind_is_refused(name, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    assert refusal(name, "-o", "out", *options) == f"error: {message}"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_prepare_interrupted_leaves_no_folder(cloud, tmp_path, number):
    out = tmp_path / "out"
    with subprocess.Popen(
        [*PROCESS, "prepare", str(cloud), "-o", str(out), "--cell", "0.05", "--dop-cell", "0.05"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        while not any(out.glob("*/*")):
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(number)
        output = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "nothing was written" in output[1]
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "is_bridge"),
    [
        ((), False),
        (("--bridge-class", "26"), True),
        (("--bridge-class", "17"), False),
    ],
)
def test_prepare_points_bridge_class_selects_bridges(tmp_path, words, is_bridge):
    east, north = np.meshgrid(np.arange(0, 40, 0.5), np.arange(0, 40, 0.5))
    kind = np.where(abs(north - 20) < 4, 26, 2)
    # A place in the Netherlands: elsewhere a metre of their CRS is no metre.
    xyz = np.stack([east + 155_000, north + 463_000, np.where(kind == 26, 6.0, 0.0)], -1).reshape(-1, 3)
    path = write_cloud(tmp_path / "ahn.las", xyz, kind.ravel(), "EPSG:28992")
    said = flexroad("prepare", path, "-o", tmp_path / "out", "--workers", 1, *words)
    assert (tmp_path / "out" / "bridges.tif").is_file() == is_bridge
    assert ("--bridge-class 26 takes them" in said) == (not is_bridge)
