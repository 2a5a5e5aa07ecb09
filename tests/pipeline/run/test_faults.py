"""Faults before and during a run: afterwards the same command gives the results of an undisturbed run.

Faults of a single module are tested in that module's tests; `tests/faults.md` lists all of them.
"""

import contextlib
import json
import os
import random
import shutil
import subprocess
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rasterio

from flexroad.catalog import Catalog
from flexroad.catalog.storage import paths
from flexroad.pipeline.config.loading import compose, load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.lock import Owner, run_lock
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.store.tables import read_metrics
from tests.builders import LIGHT
from tests.command_line import PROCESS
from tests.permissions import permissions_enforced
from tests.whole_run import assert_whole, item_times, rows, times

SERIAL = ("--executor", "serial")
DAY_S = 86400


@pytest.fixture
def undisturbed(light_run) -> Path:
    return light_run.path


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "run"


@pytest.fixture
def finished(undisturbed, out) -> Path:
    """A copy of the finished run, for tests to damage."""
    return shutil.copytree(undisturbed, out)


@pytest.fixture
def night(flexroad, light_config, made_survey, out):
    """The run command that is repeated every night."""

    def call(*more, catalog=made_survey / "catalog.parquet"):
        words = ("--config", light_config, "--catalog", catalog, "--out", out)
        return flexroad("run", *words, *SERIAL, *more)

    return call


def stages(out: Path, since: int = 0) -> Counter[str]:
    """Number of computed nodes by stage in the log, from event number ``since`` on."""
    counts = Counter[str]()
    for line in (out / "log.jsonl").read_text().splitlines()[since:]:
        event = json.loads(line)
        if event["event"] == "stage":
            counts[event["stage"]] += event["computed"]
    return +counts


def events(out: Path) -> int:
    return len((out / "log.jsonl").read_text().splitlines())


def dsm_of(catalog: Path, number: int) -> Path:
    tile = Catalog.read(catalog).tiles[number]
    return tile.paths(tile.layer("dsm"))[0]


# --- damaged files of a finished run ------------------------------------------------------------------


NOTHING: dict[str, int] = {}


class Damage(NamedTuple):
    act: Callable[[Path], object]
    status: str = "4 done"
    """What `status` says before the next run."""
    cached: int = 4
    """Tiles that the next run does not process."""
    computed: dict[str, int] | None = NOTHING
    """The nodes that it computes; None if they are not compared."""
    options: tuple[str, ...] = ()


def written(pattern: str, content: str) -> Callable[[Path], object]:
    return lambda out: [path.write_text(content) for path in list(out.glob(pattern))]


def removed(pattern: str, most: int = 9) -> Callable[[Path], object]:
    return lambda out: [path.unlink() for path in sorted(out.glob(pattern))[:most]]


def rotated(*patterns: str) -> Callable[[Path], object]:
    """Give each file the content of the next one, as after fsck or a wrong restore."""

    def act(out: Path) -> None:
        for pattern in patterns:
            files = sorted(out.glob(pattern))
            assert len(files) > 2
            contents = [path.read_bytes() for path in files]
            for path, content in zip(files, [*contents[1:], contents[0]], strict=True):
                path.write_bytes(content)

    return act


def without_tiles(act: Callable[[Path], object]) -> Callable[[Path], object]:
    """A damage of the store of a run whose tiles and database are lost, too."""

    def both(out: Path) -> None:
        act(out)
        shutil.rmtree(out / "tiles")
        (out / "database.txt").unlink()

    return both


def cut_off(pattern: str) -> Callable[[Path], object]:
    return lambda out: [path.write_bytes(path.read_bytes()[:-40]) for path in list(out.glob(pattern))]


def zero(path: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def log_is_folder(out: Path) -> None:
    (out / "log.jsonl").unlink()
    (out / "log.jsonl").mkdir()


ONE, ALL = {"export": 1}, {"export": 4}
PENDING, NO_RUN = "4 pending", "is no run: run.json is missing or damaged"
VERIFY = ("--verify",)
MARKERS = "tiles/*/item.json"
PRODUCTS = ("tiles/*/*height.tif", "tiles/*/*.glb", "tiles/*/*surface.npz")
DAMAGES = {
    "tile folder deleted": Damage(lambda out: shutil.rmtree(min(out.glob("tiles/*"))), "3 done", 3, ONE),
    "mesh deleted": Damage(removed("tiles/*/*.glb", 1), "3 done", 3, ONE),
    "mesh of zeros": Damage(lambda out: zero(min(out.glob("tiles/*/*.glb"))), "4 done", 3, ONE, VERIFY),
    "meshes empty": Damage(written("tiles/*/*.glb", ""), PENDING, 0, ALL),
    "products of other tiles": Damage(rotated(*PRODUCTS), PENDING, 0, ALL),
    "markers of other tiles": Damage(rotated(MARKERS), PENDING, 0, ALL),
    "markers of other tiles, verified": Damage(rotated(MARKERS), PENDING, 0, ALL, VERIFY),
    "markers without content": Damage(written(MARKERS, "{}"), PENDING, 0, ALL),
    "store deleted": Damage(lambda out: shutil.rmtree(out / "store")),
    "metrics cut off": Damage(
        without_tiles(cut_off("store/evaluate/*/*.npz")),
        PENDING,
        0,
        ALL | {"load": 4, "fit": 4, "sample": 4, "evaluate": 8},
    ),
    **{
        f"{stage} of other tiles": Damage(without_tiles(rotated(f"store/{stage}/*/*.npz")), PENDING, 0, None)
        for stage in ("segment", "ecsrc", "fit", "sample", "evaluate", "assess", "*")
    },
    "database lost": Damage(removed("database.txt")),
    "database cut off": Damage(lambda out: os.truncate(out / "database.txt", 5000)),
    "log a folder": Damage(log_is_folder, computed=None),
    "log no JSON": Damage(written("log.jsonl", 'null\n{"event": 3}\n{"ev'), computed=None),
    "metrics empty": Damage(written("metrics.parquet", "")),
    "record without content": Damage(written("run.json", "{}"), NO_RUN),
    "configuration wrong": Damage(written("config.yaml", "fit: {degre: 3}"), "fit.degre: unknown key"),
    "configuration lost": Damage(removed("config.yaml"), "is no configuration: it is missing"),
    "configuration empty": Damage(written("config.yaml", ""), "config.yaml is empty"),
    "catalog empty": Damage(written("catalog.parquet", ""), "is not a FlexRoad catalog"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_run_is_reported_and_repaired(name, finished, undisturbed, night, flexroad):
    damage, since = DAMAGES[name], events(finished)
    damage.act(finished)
    said = flexroad("status", finished)
    assert damage.status in said.out + said.err
    assert said.code == (0 if damage.status.startswith(("3", "4")) else 2)
    again = night(*damage.options).expected(0)
    assert f"4 done ({damage.cached} cached)" in again.out
    if damage.computed is not None:
        assert stages(finished, since) == damage.computed
    assert_whole(finished, undisturbed)
    flexroad("report", finished).expected(0)


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


# A power failure can leave empty files.
RANDOM = {
    "gone": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "flipped": _flip,
}


@pytest.mark.slow
@pytest.mark.soak("runs")
@pytest.mark.parametrize("seed", range(4))
def test_run_any_files_damaged_recomputes_only_those(seed, finished, undisturbed, night):
    """A third of all files are damaged in random ways; undamaged files are not written again."""
    random_ = random.Random(seed)
    damaged = set()
    for path in sorted(path for path in finished.rglob("*") if path.is_file()):
        name = path.relative_to(finished).as_posix()
        # Only files with checksums can reveal a flipped bit; markers and small files of the run have none.
        has_checksum = name.startswith(("store/", "tiles/")) and path.suffix != ".json"
        damage = random_.choice([kind for kind in RANDOM if has_checksum or kind != "flipped"])
        if random_.random() < 1 / 3:
            RANDOM[damage](path)
            damaged.add(name)
    before = times(finished)
    night("--verify").expected(0)
    assert_whole(finished, undisturbed)
    damaged_tiles = {name.split("/")[1] for name in damaged if name.startswith("tiles/")}
    after = times(finished)
    for name, time_ns in before.items():
        kept = name.split("/")[1] not in damaged_tiles if name.startswith("tiles/") else name not in damaged
        assert not kept or after[name] == time_ns, f"{name} was written again"


def test_run_record_lost_keeps_mesh_origin(night, made_survey, light_config, out, tmp_path):
    """Although a new run over the larger catalog would have another origin."""
    tiles = Catalog.read(made_survey / "catalog.parquet").tiles
    east = tuple(tile for tile in tiles if tile.grid.west > tiles[0].grid.west)
    run = Run.create(out, load_config(light_config), Catalog(east))
    run_tiles(run, SerialExecutor())
    (out / "run.json").unlink()
    night().expected(0)
    opened = Run.open(out)
    assert opened.origin == run.origin
    assert opened.origin != Run.create(tmp_path / "new", run.config, Catalog(tiles)).origin


def test_rerun_moved_run_is_cached(finished, undisturbed, flexroad, tmp_path):
    elsewhere = finished.rename(tmp_path / "elsewhere")
    assert "nothing had changed" in flexroad("rerun", elsewhere, *SERIAL).out
    assert_whole(elsewhere, undisturbed)
    assert Run.open(elsewhere).store == elsewhere / "store"


@pytest.mark.parametrize("lost", ["sources", "store", "names of artefacts"])
def test_readers_of_a_damaged_run_say_the_same(lost, own_run, flexroad, tmp_path):
    out, tile = own_run.path, own_run.catalog.tiles[0]
    points = tmp_path / "points.csv"
    points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
    questions = [("query", out, "--points", points), ("status", out)]
    if lost == "sources":
        questions.append(("report", out))
    before = [flexroad(*words) for words in questions]
    if lost == "sources":
        shutil.rmtree(tmp_path / "survey")
    elif lost == "store":
        shutil.rmtree(out / "store")
    else:
        rotated("store/*/*/*.npz")(out)
    assert [flexroad(*words) for words in questions] == before
    if lost == "sources":
        flexroad("report", out, "--format", "html").expected(0)
        (error,) = flexroad(*questions[0], "--variant", "rgt").expected(2).errors
        assert f"tile {tile.id}: load: TaskError: dsm dsm/{tile.id}.tif is missing" in error
        return
    assert (out / "store").exists() == (lost != "store")
    flexroad("export", out, "--format", "landxml", "--output", tmp_path / "export").expected(0)
    flexroad("rerun", out, "--from", "fit", *SERIAL).expected(0)
    assert flexroad(*questions[0]) == before[0]


# --- tiles whose results are lost during the run ------------------------------------------------------


@pytest.fixture
def run(made_survey, out) -> Run:
    return Run.create(out, compose(LIGHT, "light"), Catalog.read(made_survey / "catalog.parquet"))


class Disturbed(SerialExecutor):
    """Calls a function with the job of the n-th tile, before or after it is processed."""

    def __init__(self, n, act, after=False, change=lambda job: job):
        self.n, self.act, self.after, self.change = n, act, after, change

    def map(self, function, jobs, lost, probe=None):
        for number, job in enumerate(jobs):
            if number == self.n and not self.after:
                self.act(job)
            result = function(self.change(job))
            if number == self.n and self.after:
                self.act(job)
            yield result


GONE = "its results are missing: "


def assert_missing(run, counts, number, reason) -> None:
    """The tile is failed everywhere."""
    tile = run.catalog.tiles[number]
    assert (counts.done, counts.failed, counts.pending, counts.exit_code) == (3, 1, 0, 1)
    (failure,) = counts.failures
    assert (failure.tile_id, failure.kind) == (tile.id, "ResultsMissing")
    assert failure.file == str(run.folder(tile.id).path / "item.json")
    assert failure.message.startswith(GONE + reason)
    assert failure.message.endswith("; run the same command again")
    links = json.loads((run.path / "collection.json").read_text())["links"]
    others = [other.id for other in run.catalog.tiles if other != tile]
    assert [link["title"] for link in links if link["rel"] == "item"] == others
    table = read_metrics(run.path)
    assert set(table[table.status == "failed"].tile_id) == {tile.id}
    assert table[table.tile_id == tile.id].l2_road_m.isna().all()
    assert table[table.tile_id == tile.id].error.str.contains(GONE).all()
    again = summary(run)
    assert (again.done, again.failed) == (3, 1)


@pytest.mark.parametrize(
    ("number", "cached", "reason"),
    [(2, False, "the folder was deleted, or "), (0, False, "its folder was"), (0, True, "its folder was")],
    ids=["before it counts", "after it counted", "after it counted as cached"],
)
def test_tile_whose_folder_is_deleted_is_failed(number, cached, reason, run, undisturbed):
    tile = run.catalog.tiles[number]
    if cached:
        run_tiles(run, SerialExecutor(), only=lambda other: other == tile)
    disturbed = Disturbed(2, lambda job: shutil.rmtree(run.folder(tile.id).path), after=True)
    assert_missing(run, run_tiles(run, disturbed), number, reason)
    assert run_tiles(run, SerialExecutor()).cached == 3
    assert_whole(run.path, undisturbed)


@pytest.mark.parametrize("earlier", [False, True], ids=["never done", "done before"])
def test_tile_that_a_worker_writes_elsewhere_is_failed(earlier, run, tmp_path):
    """As with another disk mounted there. The marker of an earlier result is not that of this one."""
    if earlier:
        other = compose({**LIGHT, "ecsrc": "off"}, "other")
        run_tiles(Run.create(run.path, other, run.catalog), SerialExecutor())
        run = Run.create(run.path, run.config, run.catalog)
    elsewhere, one = str(tmp_path / "elsewhere"), run.catalog.tiles[1].id
    change = lambda job: replace(job, run=elsewhere) if job.graph.tile.id == one else job  # noqa: E731
    counts = run_tiles(run, Disturbed(-1, None, change=change))
    assert (counts.done, counts.failed, counts.exit_code) == (3, 1, 1)
    reason = f"the folder was deleted, or {os.uname().nodename} writes to another"
    assert counts.failures[0].tile_id == one
    assert counts.failures[0].message.startswith(GONE + reason)


def test_marker_with_another_time_counts(run, undisturbed):
    """As of a share that rounds times."""
    touch = lambda job: os.utime(job.folder.path / "item.json", (1, 1))  # noqa: E731
    assert run_tiles(run, Disturbed(1, touch, after=True)).done == 4
    assert_whole(run.path, undisturbed)


def test_storage_that_does_not_answer_fails_the_tile_with_its_reason(run, monkeypatch):
    def refuse(*_):
        raise OSError(5, "Input/output error", "item.json")

    fail = lambda job: monkeypatch.setattr("flexroad.pipeline.run.status.marker_stat", refuse)  # noqa: E731
    counts = run_tiles(run, Disturbed(0, fail, after=True))
    assert counts.failed == 4
    assert "missing (Input/output error): " in counts.failures[0].message
    monkeypatch.undo()
    assert run_tiles(run, SerialExecutor()).cached == 4


@pytest.mark.parametrize("change", ["replaced", "truncated"])
def test_source_changed_during_processing_fails_its_tile(change, survey, out, undisturbed):
    run = Run.create(out, compose(LIGHT, "light"), Catalog.read(survey))
    tile, path = run.catalog.tiles[2], dsm_of(survey, 2)
    whole, results = path.read_bytes(), []

    def change_source(job):
        if change == "truncated":
            path.write_bytes(whole[:700])
            return
        with rasterio.open(path, "r+") as raster:
            raster.write(raster.read(1) + 0.5, 1)

    run_tiles(run, Disturbed(2, change_source), watch=results.append)
    assert [result.status for result in results] == ["done", "done", "failed", "done"]
    (failure,) = results[2].failures
    assert (failure.stage, failure.kind, failure.file) == ("load", "SourceChanged", str(path))
    assert "run the same command again" in failure.message
    assert not failure.trace
    assert not {file.stem for file in run.store.rglob("*.npz")} & set(run.graph(tile).nodes)
    if change == "replaced":
        counts = run_tiles(run, SerialExecutor())
        assert (counts.done, counts.cached, counts.changed) == (4, 3, 1)
        assert not rows(out).equals(rows(undisturbed))
    path.write_bytes(whole)
    counts = run_tiles(run, SerialExecutor())
    assert (counts.done, counts.cached, counts.changed) == (4, 3, 1)
    assert_whole(out, undisturbed)


@pytest.mark.slow
@pytest.mark.soak("runs")
def test_run_survey_not_mounted_changes_nothing(survey, night, undisturbed, out):
    """The run exits at once instead of failing tile by tile; the next run has nothing to do."""
    night(catalog=survey).expected(0)
    home, away = survey.parent / "dsm", survey.parent / "elsewhere"
    home.rename(away)
    said = night(catalog=survey).expected(2)
    assert json.loads((out / "summary.json").read_text())["exit_code"] == 2
    assert "each of the 4 tiles lacks a file" in said.err
    away.rename(home)
    since = events(out)
    night(catalog=survey).expected(0)
    assert stages(out, since) == {}
    assert_whole(out, undisturbed)


# --- disks --------------------------------------------------------------------------------------------


def test_full_disk_of_the_store_fails_tiles_alone(run, undisturbed, monkeypatch):
    put = ArtefactStore.put

    def full(self, node, value, *rest):
        if node.stage == "fit" and len(list(self.root.rglob("*.npz"))) > 9:
            raise OSError(28, "No space left on device", str(self.root))
        return put(self, node, value, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(ArtefactStore, "put", full)
        counts = run_tiles(run, SerialExecutor())
    assert 0 < counts.failed < 4
    assert "No space left on device" in counts.failures[0].line
    run_tiles(run, SerialExecutor())
    assert_whole(run.path, undisturbed)


def test_run_store_read_only_exits_before_any_tile(night, out, undisturbed, tmp_path):
    store = tmp_path / "store"
    store.mkdir(mode=0o555)
    with permissions_enforced():
        (line,) = night("--store", store).expected(2).errors
    assert f"cannot write the run to {out}" in line
    assert f"Permission denied: '{store}" in line
    assert "choose another --out or --store" in line
    assert not out.exists()
    store.chmod(0o755)
    night("--store", store).expected(0)
    assert_whole(out, undisturbed)


@pytest.mark.parametrize("part", ["store", ".", "tiles"])
def test_run_folder_read_only_midway_keeps_done_tiles(part, run, night, undisturbed, out):
    folders: list[Path] = []

    def make_read_only(job) -> None:
        folders.extend([out / part, *(path for path in (out / part).rglob("*") if path.is_dir())])
        for folder in folders:
            folder.chmod(0o555)

    with permissions_enforced(), contextlib.suppress(OSError), run_lock(out):
        assert run_tiles(run, Disturbed(2, make_read_only)).failed == 2
    for folder in folders:
        folder.chmod(0o755)
    if (out / "lock.json").exists():
        # The lock could not be removed; in operation its process would have ended by the next night.
        (out / "lock.json").write_bytes(replace(Owner.me(), pid=2**22 + 1).data)
    before = item_times(out)
    assert len(before) == 2
    night().expected(0)
    assert_whole(out, undisturbed)
    assert before.items() <= item_times(out).items()


def test_read_only_disk_allows_only_reading(own_run, flexroad, light_config, tmp_path):
    disk, tile = tmp_path / "disk", own_run.catalog.tiles[0]
    disk.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", disk], capture_output=True)
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.decode().strip()}")
    try:
        shutil.copytree(own_run.path, disk / "run", ignore=shutil.ignore_patterns("store"))
        subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        catalog = tmp_path / "survey" / "catalog.parquet"
        for out in (disk / "run", disk / "other"):
            words = ("--config", light_config, "--catalog", catalog, "--out", out)
            (line,) = flexroad("run", *words, *SERIAL).expected(2).errors
            assert f"cannot write the run to {out}" in line
            assert "Read-only file system" in line
        points = tmp_path / "points.csv"
        points.write_text(f"easting,northing\n{tile.grid.west + 9},{tile.grid.south + 9}\n")
        assert tile.id in flexroad("query", disk / "run", "--points", points).out
        assert "4 done" in flexroad("status", disk / "run").out
        for words in (("report", disk / "run"), ("catalog", "synthetic", "-o", disk / "scenes")):
            (line,) = flexroad(*words).expected(2).errors
            assert "Read-only file system" in line
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.slow
@pytest.mark.soak("runs")
@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_run_output_not_writable_completes(stream, survey, light_config, night, out, undisturbed):
    """The disk of cron's log is full, and one tile fails, which is printed at once."""
    file = dsm_of(survey, 0)
    whole = shutil.copy2(file, file.with_suffix(".whole"))
    file.write_bytes(b"")
    words = ["run", "--config", light_config, "--catalog", survey, "--out", out, *SERIAL]
    with Path("/dev/full").open("w") as full:
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, stream: full}
        done = subprocess.run([*PROCESS, *words], **streams)
    assert done.returncode == 1
    assert json.loads((out / "summary.json").read_text())["done"] == 3
    assert b"3 done" in (done.stdout or b"3 done")
    assert b"Traceback" not in (done.stderr or b"")
    whole.rename(file)
    night(catalog=survey).expected(0)
    assert_whole(out, undisturbed)


# --- clocks -------------------------------------------------------------------------------------------


def test_run_clock_set_back_midway_is_cached_next_time(night, run, monkeypatch, undisturbed, out):
    """Files written later have earlier times; the next run still has nothing to do."""
    write, now = paths.write, time.time

    def write_with_old_time(location, data, flushed=False) -> None:
        write(location, data, flushed)
        os.utime(location, (now() - 5 * DAY_S,) * 2)

    def set_back(job) -> None:
        monkeypatch.setattr(time, "time", lambda: now() - 5 * DAY_S)
        frozen = "2001-01-01T00:00:00.000+00:00"
        for module in ("worker.evaluator", "worker.tile", "run.events", "run.runner"):
            monkeypatch.setattr(f"flexroad.pipeline.{module}.utc_now", lambda: frozen)
        monkeypatch.setattr(paths, "write", write_with_old_time)

    assert run_tiles(run, Disturbed(2, set_back)).exit_code == 0
    assert sum(path.stat().st_mtime < now() - DAY_S for path in out.glob("tiles/*/item.json")) == 2
    told = json.loads((out / "summary.json").read_text())
    assert told["end"] < told["start"]
    assert_whole(out, undisturbed)
    assert "4 done (4 cached)" in night().out


def test_run_clock_set_back_between_runs_detects_change(survey, night, undisturbed, out):
    """Sources and results have times in the future; a source that changes now is older than both."""
    for folder in (survey.parent, out):
        night(catalog=survey).expected(0)
        for path in folder.rglob("*"):
            os.utime(path, (time.time() + 10 * DAY_S,) * 2)
    assert "4 done (4 cached)" in night(catalog=survey).out
    file = dsm_of(survey, 1)
    whole = file.read_bytes()
    with rasterio.open(file, "r+") as raster:
        raster.write(raster.read(1) + np.float32(0.5), 1)
    said = night(catalog=survey)
    assert "4 done (3 cached), 0 failed, 0 pending; 0 new, 1 changed" in said.out
    assert not rows(out).equals(rows(undisturbed))
    file.write_bytes(whole)
    assert "4 done (3 cached)" in night(catalog=survey).out
    assert_whole(out, undisturbed)


# --- a second run -------------------------------------------------------------------------------------


def test_run_in_locked_folder_exits_and_changes_nothing(finished, night, flexroad, undisturbed):
    me = Owner.me()
    with run_lock(finished):
        before = paths.listing(finished)
        for said in (
            night("--verify"),
            flexroad("rerun", finished, "--from", "load"),
            flexroad("clean", finished),
        ):
            (line,) = said.expected(2).errors
            assert f"{finished} is in use by pid {me.pid} on {me.host} since" in line
        assert paths.listing(finished) == before
    assert "4 cached" in night().out
    assert_whole(finished, undisturbed)
