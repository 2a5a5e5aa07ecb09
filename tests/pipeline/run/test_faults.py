"""Faults during a run: afterwards the same command gives the results of an undisturbed run.

Faults of a single module are tested in that module's tests; `tests/faults.md` lists all of them.
"""

import contextlib
import errno
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
import yaml

from flexroad.catalog import Catalog, Layer
from flexroad.catalog.storage import paths
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.events import EventLog
from flexroad.pipeline.run.lock import Owner, run_lock
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.builders import LIGHT
from tests.dask_processes import wait_for
from tests.permissions import permissions_enforced
from tests.whole_run import assert_whole, rows, times

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

DAY_S = 86400


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("config") / "light.yaml"
    path.write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def undisturbed(made_survey, config, tmp_path_factory) -> Path:
    """A finished run without faults; tests must not change it."""
    catalog = Catalog.read(made_survey / "catalog.parquet")
    run = Run.create(tmp_path_factory.mktemp("undisturbed") / "run", load_config(config), catalog)
    run_tiles(run, SerialExecutor())
    return run.path


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "run"


@pytest.fixture
def finished(undisturbed, out) -> Path:
    """A copy of the finished run, for tests to damage."""
    return shutil.copytree(undisturbed, out)


@pytest.fixture
def night(flexroad, config, made_survey, out):
    """The run command that is repeated every night."""

    def call(*more, catalog=made_survey / "catalog.parquet", allow=()):
        words = ["--config", config, "--catalog", catalog, "--out", out, "--executor", "serial"]
        return flexroad(*allow, "run", *words, *more)

    return call


def computed(out: Path, since: int = 0) -> Counter[str]:
    """Number of computed nodes by stage in the log, from event number ``since`` on."""
    events = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()][since:]
    counts = Counter[str]()
    for event in events:
        if event["event"] == "stage":
            counts[event["stage"]] += event["computed"]
    return +counts


def events(out: Path) -> int:
    return len((out / "log.jsonl").read_text().splitlines())


@pytest.fixture
def before_tile(monkeypatch) -> Callable[[int, Callable[[], object]], None]:
    """Call a function during the run, before the n-th computed tile."""

    def arrange(n: int, action: Callable[[], object]) -> None:
        def map_(self, function, jobs, lost, probe=None):
            for i, job in enumerate(jobs):
                if i == n:
                    action()
                yield function(job)

        monkeypatch.setattr(SerialExecutor, "map", map_)

    return arrange


# --- processes ----------------------------------------------------------------------------------------


def test_run_scheduler_killed_keeps_done_tiles(
    processes, config, made_survey, flexroad, night, monkeypatch, undisturbed, out
):
    """The run ends with one error line; the next one, without a cluster, computes the other tiles."""
    scheduler = processes.scheduler()
    processes.worker()
    wait_for(processes.address, 1)
    log_tile = EventLog.tile

    def kill(self, result) -> None:
        log_tile(self, result)
        scheduler.kill()

    monkeypatch.setattr(EventLog, "tile", kill)
    words = ["--config", config, "--catalog", made_survey / "catalog.parquet", "--out", out]
    said = flexroad("run", *words, "--executor", processes.address)
    assert said.code == 1
    name = f"the Dask scheduler at {processes.address}"
    assert said.errors == [f"error: {name} is gone; the same command goes on from here"]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["exit_code"] == 1
    assert 1 <= summary["done"] < 4
    assert rows(out).tile_id.nunique() == summary["done"]
    before = {path: path.stat().st_mtime_ns for path in out.glob("tiles/*/item.json")}
    processes.end()
    assert night().code == 0
    assert_whole(out, undisturbed)
    assert all(path.stat().st_mtime_ns == written for path, written in before.items())


def test_run_workers_cannot_start_exits_with_one_line(config, made_survey, night, undisturbed, out):
    # Without the check at the start, as if the files were too few for the number of workers.
    unchecked = "from flexroad.pipeline.cli import limits; limits.OPEN_FILES = 0; "
    call = [
        sys.executable,
        "-c",
        f"{unchecked}from flexroad.pipeline.cli.main import main; main()",
        "run",
        "--executor",
        "dask",
        "--workers",
        "2",
    ]
    call += ["--config", config, "--catalog", made_survey / "catalog.parquet", "--out", out]
    few = ["sh", "-c", 'ulimit -n 40; exec "$@"', "sh"]
    done = subprocess.run([*few, *call], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    # A slow machine also says what takes more than a second.
    first, last = (
        line for line in done.stderr.splitlines() if not line.startswith(("preparing ", "reading "))
    )
    assert first == "starting: 4 tiles"
    assert last.startswith("error: cannot start 2 worker processes here: ")
    assert night().code == 0
    assert_whole(out, undisturbed)


# --- files of a run -----------------------------------------------------------------------------------


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES = {
    "gone": Path.unlink,
    # A power failure can leave empty files.
    "empty": lambda path: path.write_bytes(b""),
    "cut off": _cut,
    "flipped": _flip,
}


@pytest.mark.parametrize("seed", range(4))
def test_run_any_files_damaged_recomputes_only_those(seed, finished, undisturbed, night):
    """A third of all files are damaged in random ways; undamaged files are not written again."""
    random_ = random.Random(seed)
    damaged = set()
    for path in sorted(path for path in finished.rglob("*") if path.is_file()):
        name = path.relative_to(finished).as_posix()
        # Only files with checksums can reveal a flipped bit; markers and small files of the run have none.
        has_checksum = name.startswith(("store/", "tiles/")) and path.suffix != ".json"
        damage = random_.choice([kind for kind in DAMAGES if has_checksum or kind != "flipped"])
        if random_.random() < 1 / 3:
            DAMAGES[damage](path)
            damaged.add(name)
    before = times(finished)
    said = night("--verify")
    assert said.code == 0, said
    assert_whole(finished, undisturbed)
    damaged_tiles = {name.split("/")[1] for name in damaged if name.startswith("tiles/")}
    after = times(finished)
    for name, written in before.items():
        kept = name.split("/")[1] not in damaged_tiles if name.startswith("tiles/") else name not in damaged
        assert not kept or after[name] == written, f"{name} was written again"


def test_rerun_empty_configuration_raises(finished, undisturbed, night, flexroad):
    (finished / "config.yaml").write_bytes(b"")
    said = flexroad("rerun", finished, "--executor", "serial")
    assert said.code == 2
    assert f"{finished / 'config.yaml'} is empty" in said.errors[0]
    assert "4 cached" in night().out
    assert_whole(finished, undisturbed)


def test_run_record_lost_keeps_mesh_origin(night, made_survey, config, out, tmp_path):
    """Although a new run over the larger catalog would have another origin."""
    tiles = Catalog.read(made_survey / "catalog.parquet").tiles
    east = tuple(tile for tile in tiles if tile.grid.west > tiles[0].grid.west)
    run = Run.create(out, load_config(config), Catalog(east))
    run_tiles(run, SerialExecutor())
    (out / "run.json").unlink()
    assert night().code == 0
    opened = Run.open(out)
    assert opened.origin == run.origin
    assert opened.origin != Run.create(tmp_path / "new", run.config, Catalog(tiles)).origin


def test_run_tile_folder_deleted_repeats_only_export(finished, undisturbed, night):
    shutil.rmtree(min((finished / "tiles").iterdir()))
    since = events(finished)
    assert "4 done (3 cached)" in night().out
    assert computed(finished, since) == {"export": 1}
    assert_whole(finished, undisturbed)


def test_rerun_moved_run_is_cached(finished, undisturbed, night, flexroad, tmp_path):
    elsewhere = finished.rename(tmp_path / "elsewhere")
    assert "nothing had changed" in flexroad("rerun", elsewhere, "--executor", "serial").out
    assert_whole(elsewhere, undisturbed)
    assert Run.open(elsewhere).store == elsewhere / "store"


# --- disks --------------------------------------------------------------------------------------------


@contextlib.contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """Let writes beyond this file size (bytes) fail, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("database_fits", [False, True])
def test_run_disk_full_during_write_leaves_no_half_file(
    database_fits, flexroad, night, undisturbed, config, made_survey, out
):
    database = (undisturbed / "database.txt").stat().st_size
    size = 2 * database if database_fits else database - 4_000
    too_large = {path.parent for path in undisturbed.glob("tiles/*/*") if path.stat().st_size > size}
    assert 0 < len(too_large) < 4
    Run.create(out, load_config(config), Catalog.read(made_survey / "catalog.parquet"))
    with no_file_above(size):
        said = flexroad("rerun", out, "--executor", "serial")
    assert said.code == 1
    message = f"{len(too_large)} failed" if database_fits else "database.txt"
    assert message in said.out + said.err
    failed = [line for line in said.errors if "File too large" in line]
    assert failed
    assert all(str(out) in line for line in failed)
    assert not list(out.rglob("*.tmp"))
    before = times(out)
    assert night().code == 0
    assert_whole(out, undisturbed)
    done = {name.split("/")[1] for name in before if name.endswith("item.json")}
    after = times(out)
    kept = [name for name in before if name.startswith("store/") or name.split("/")[1] in done]
    assert kept
    assert all(after[name] == before[name] for name in kept)


def test_run_store_read_only_exits_before_any_tile(night, out, undisturbed, tmp_path):
    store = tmp_path / "store"
    store.mkdir(mode=0o555)
    with permissions_enforced():
        said = night("--store", store)
    assert said.code == 2
    (line,) = said.errors
    assert f"cannot write the run to {out}" in line
    assert f"Permission denied: '{store}" in line
    assert "choose another --out or --store" in line
    assert not out.exists()
    store.chmod(0o755)
    assert night("--store", store).code == 0
    assert_whole(out, undisturbed)


@pytest.mark.parametrize("part", ["store", ".", "tiles"])
def test_run_folder_read_only_midway_keeps_done_tiles(part, night, before_tile, undisturbed, out):
    folders: list[Path] = []

    def make_read_only() -> None:
        folders.extend([out / part, *(path for path in (out / part).rglob("*") if path.is_dir())])
        for folder in folders:
            folder.chmod(0o555)

    before_tile(2, make_read_only)
    with permissions_enforced():
        said = night()
    for folder in folders:
        folder.chmod(0o755)
    assert said.code == 1
    assert said.errors
    assert all(str(out) in line for line in said.errors)
    if (out / "lock.json").exists():
        # The lock could not be removed; in operation its process would have ended by the next night.
        ended = replace(Owner.me(), pid=2**22 + 1)
        (out / "lock.json").write_bytes(ended.data)
    before = {path: path.stat().st_mtime_ns for path in out.glob("tiles/*/item.json")}
    assert len(before) == 2
    before_tile(9, folders.clear)
    assert night().code == 0
    assert_whole(out, undisturbed)
    assert all(path.stat().st_mtime_ns == written for path, written in before.items())


def test_run_log_not_writable_completes(night, undisturbed, out):
    (out / "log.jsonl").mkdir(parents=True)
    assert night().code == 0
    assert_whole(out, undisturbed)


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_run_output_not_writable_completes(stream, survey, config, night, out, undisturbed):
    """The disk of cron's log is full, and one tile fails, which is printed at once."""
    tile = Catalog.read(survey).tiles[0]
    file, *_ = tile.paths(tile.layer("dsm"))
    whole = file.with_suffix(".whole")
    shutil.copy2(file, whole)
    file.write_bytes(b"")
    call = [
        sys.executable,
        "-c",
        "from flexroad.pipeline.cli.main import main; main()",
        "run",
        "--executor",
        "serial",
    ]
    call += ["--config", config, "--catalog", survey, "--out", out]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(call, **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, stream: full})
    assert done.returncode == 1
    assert json.loads((out / "summary.json").read_text())["done"] == 3
    assert b"3 done" in (done.stdout or b"3 done")
    assert b"Traceback" not in (done.stderr or b"")
    whole.rename(file)
    assert night(catalog=survey).code == 0
    assert_whole(out, undisturbed)


def test_run_lock_on_full_disk_is_released(monkeypatch, tmp_path):
    def full(**_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with run_lock(tmp_path):
        monkeypatch.setattr("tempfile.TemporaryFile", full)
    assert not list(tmp_path.iterdir())


def test_import_read_only_installation_without_home(tmp_path):
    """Numba raises on import if it has no writable cache folder; FlexRoad sets one."""
    root = Path(__file__).parents[3]
    for name in ("catalog", "tasks", "pipeline"):
        shutil.copytree(root / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(
        root / "flexroad", tmp_path / "flexroad", symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
    )
    for folder in (tmp_path / "tasks", tmp_path / "tasks" / "fit"):
        # A file in place of the folder: root cannot write there, either.
        (folder / "__pycache__").touch()
    code = "import os, flexroad.pipeline, flexroad.tasks.fit.nurbs; print(os.environ['NUMBA_CACHE_DIR'])"
    elsewhere = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in elsewhere}
    environment |= {"HOME": "/dev/null"}
    call = [sys.executable, "-c", code]
    done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not Path(done.stdout.strip()).exists()


# --- clocks -------------------------------------------------------------------------------------------


def test_run_clock_set_back_midway_is_cached_next_time(night, before_tile, monkeypatch, undisturbed, out):
    """Files written later have earlier times; the next run still has nothing to do."""
    write, now = paths.write, time.time

    def set_back() -> None:
        monkeypatch.setattr(time, "time", lambda: now() - 5 * DAY_S)
        frozen = "2001-01-01T00:00:00.000+00:00"
        for module in ("worker.evaluator", "worker.tile", "run.events", "run.runner"):
            monkeypatch.setattr(f"flexroad.pipeline.{module}.utc_now", lambda: frozen)
        monkeypatch.setattr(paths, "write", write_with_old_time)

    def write_with_old_time(location, data, flushed=False) -> None:
        write(location, data, flushed)
        os.utime(location, (now() - 5 * DAY_S,) * 2)

    before_tile(2, set_back)
    assert night().code == 0
    assert sum(path.stat().st_mtime < now() - DAY_S for path in out.glob("tiles/*/item.json")) == 2
    summary = json.loads((out / "summary.json").read_text())
    assert summary["end"] < summary["start"]
    assert_whole(out, undisturbed)
    assert "4 done (4 cached)" in night().out


def test_run_clock_set_back_between_runs_detects_change(survey, night, undisturbed, out):
    """Sources and results have times in the future; a source that changes now is older than both."""
    for path in survey.parent.rglob("*"):
        os.utime(path, (time.time() + 10 * DAY_S,) * 2)
    assert night(catalog=survey).code == 0
    for path in out.rglob("*"):
        os.utime(path, (time.time() + 10 * DAY_S,) * 2)
    assert "4 done (4 cached)" in night(catalog=survey).out
    tile = Catalog.read(survey).tiles[1]
    file, *_ = tile.paths(tile.layer("dsm"))
    whole = file.read_bytes()
    with rasterio.open(file, "r+") as raster:
        raster.write(raster.read(1) + np.float32(0.5), 1)
    said = night(catalog=survey)
    assert "4 done (3 cached), 0 failed, 0 pending; 0 new, 1 changed" in said.out
    assert not rows(out).equals(rows(undisturbed))
    file.write_bytes(whole)
    assert "4 done (3 cached)" in night(catalog=survey).out
    assert_whole(out, undisturbed)


# --- others -------------------------------------------------------------------------------------------


def test_run_in_locked_folder_exits_and_changes_nothing(finished, night, flexroad, undisturbed):
    me = Owner.me()
    with run_lock(finished):
        before = paths.listing(finished)
        for said in (
            night("--verify"),
            flexroad("rerun", finished, "--from", "load"),
            flexroad("clean", finished),
        ):
            assert said.code == 2
            (line,) = said.errors
            assert f"{finished} is in use by pid {me.pid} on {me.host} since" in line
        assert paths.listing(finished) == before
    assert "4 cached" in night().out
    assert_whole(finished, undisturbed)


def test_run_catalog_with_files_outside_needs_allow(night, flexroad, made_survey, undisturbed, out, tmp_path):
    original = Catalog.read(made_survey / "catalog.parquet")
    moved = tmp_path / "elsewhere" / "catalog.json"
    moved.parent.mkdir()
    original.write(moved, movable=False)
    said = night(catalog=moved)
    assert said.code == 2
    (line,) = said.errors
    assert f"tile {original.tiles[0].id}: dsm names {made_survey}/dsm/" in line
    assert not out.exists()
    option = line.partition("begin with flexroad ")[2].split()
    assert option == ["--allow", str(made_survey)]
    assert night(allow=option, catalog=moved).code == 0
    pd.testing.assert_frame_equal(rows(out), rows(undisturbed), check_exact=True)
    assert "4 cached" in flexroad("rerun", out, "--executor", "serial").out
    # The run's own catalog was changed.
    tile = original.tiles[0]
    layers = tuple(Layer("dsm", ("/etc/passwd",)) if layer.name == "dsm" else layer for layer in tile.layers)
    Catalog((replace(tile, layers=layers), *original.tiles[1:])).write(out / "catalog.parquet", movable=False)
    said = flexroad("rerun", out, "--executor", "serial")
    assert said.code == 2
    assert "dsm names /etc/passwd" in said.errors[0]


def test_run_catalog_with_url_exits(night, made_survey, out, tmp_path):
    tile, url = Catalog.read(made_survey / "catalog.parquet").tiles[0], "https://example.org/dsm.tif"
    layers = tuple(Layer("dsm", (url,)) if layer.name == "dsm" else layer for layer in tile.layers)
    Catalog((replace(tile, layers=layers),)).write(tmp_path / "catalog.json", movable=False)
    allow = ("--allow", made_survey, "--allow", "https://example.org")
    said = night(catalog=tmp_path / "catalog.json", allow=allow)
    assert said.code == 2
    assert f"dsm names {url}; only files on disk and in s3:// are read: fetch it first" in said.errors[0]
    assert not out.exists()


def test_run_survey_not_mounted_changes_nothing(survey, night, undisturbed, out):
    """The run exits at once instead of failing tile by tile; the next run has nothing to do."""
    assert night(catalog=survey).code == 0
    for name in ("dsm", "dtm"):
        (survey.parent / name).rename(survey.parent / f"{name} elsewhere")
    said = night(catalog=survey)
    assert said.code == json.loads((out / "summary.json").read_text())["exit_code"] == 2
    assert "each of the 4 tiles lacks a file" in said.err
    for name in ("dsm", "dtm"):
        (survey.parent / f"{name} elsewhere").rename(survey.parent / name)
    since = events(out)
    assert night(catalog=survey).code == 0
    assert computed(out, since) == {}
    assert_whole(out, undisturbed)
