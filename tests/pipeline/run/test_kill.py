"""Processes that are killed, cannot start or have other files: the run then ends as an undisturbed one."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import psutil
import pytest

from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.run.events import EventLog
from flexroad.tools.synthetic.scenes import write_scenes
from tests.builders import finish_run
from tests.command_line import PROCESS, error_lines
from tests.dask_processes import until, wait_for
from tests.whole_run import assert_whole, item_times, rows

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

CONFIG = """
extends: defaults
fit: {control_points: [20, 20], iterations: 3000}
variants: {plane: {fit: plane, sample: corners}, flexroad: {}}
"""
"""Slow enough for the processes to be killed before the end."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("kill")
    (path / "slow.yaml").write_text(CONFIG)
    write_scenes(path / "survey", 9, seed=5, size_m=80)
    return path


@pytest.fixture(scope="module")
def undisturbed(folder) -> pd.DataFrame:
    config = load_config(folder / "slow.yaml")
    return rows(finish_run(folder / "undisturbed", folder / "survey", config, tiles=9).path)


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "run"


@pytest.fixture
def command(folder, out) -> list:
    words = ["--config", folder / "slow.yaml", "--catalog", folder / "survey" / "catalog.parquet"]
    return [*PROCESS, "run", *words, "--out", out, "--executor", "dask", "--workers", "2"]


def workers(pid: int) -> list[psutil.Process]:
    children = psutil.Process(pid).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def assert_equal(out, undisturbed) -> None:
    pd.testing.assert_frame_equal(rows(out), undisturbed, check_exact=True)


@pytest.mark.parametrize("kill", [os.killpg, os.kill], ids=["with its workers", "alone"])
def test_run_killed_resumes_to_same_tables(command, undisturbed, out, kill):
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    until(lambda: len(item_times(out)) >= 2)
    left = workers(process.pid)
    kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = item_times(out)
    assert 2 <= len(kept) < 9
    subprocess.run(command, check=True, capture_output=True)
    assert kept.items() <= item_times(out).items()
    until(lambda: not any(worker.is_running() for worker in left))
    assert_equal(out, undisturbed)


@pytest.mark.parametrize("which", [slice(1), slice(None)], ids=["one", "all"])
def test_run_workers_killed_completes(command, undisturbed, out, which):
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until(lambda: item_times(out))
    for worker in workers(process.pid)[which]:
        worker.kill()
    assert process.wait(timeout=120) == 0
    assert_equal(out, undisturbed)


@pytest.mark.parametrize("signal_sent", ["ctrl-c", "kill"])
def test_run_interrupted_ends_soon_and_keeps_done_tiles(command, undisturbed, out, signal_sent):
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True)
    until(lambda: item_times(out))
    if signal_sent == "ctrl-c":
        # A terminal sends SIGINT to the workers, too; a user may press Ctrl-C several times.
        for _ in range(3):
            os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.3)
    else:
        process.terminate()
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "interrupted" in said
    assert "Traceback" not in said
    assert 1 <= rows(out).tile_id.nunique() < 9
    subprocess.run(command, check=True, capture_output=True)
    assert_equal(out, undisturbed)


# --- a scheduler that is killed, workers that cannot start, two runs at a time -------------------------


@pytest.fixture
def words(light_config, made_survey, out) -> list:
    return ["run", "--config", light_config, "--catalog", made_survey / "catalog.parquet", "--out", out]


def test_run_scheduler_killed_keeps_done_tiles(processes, words, flexroad, monkeypatch, light_run, out):
    """The run ends with one error line; the next one, without a cluster, computes the other tiles."""
    scheduler = processes.scheduler()
    processes.worker()
    wait_for(processes.address, 1)
    log_tile = EventLog.tile

    def kill(self, result) -> None:
        log_tile(self, result)
        scheduler.kill()

    monkeypatch.setattr(EventLog, "tile", kill)
    said = flexroad(*words, "--executor", processes.address).expected(1)
    name = f"the Dask scheduler at {processes.address}"
    assert said.errors == [f"error: {name} is gone; the same command goes on from here"]
    told = json.loads((out / "summary.json").read_text())
    assert told["exit_code"] == 1
    assert 1 <= told["done"] < 4
    assert rows(out).tile_id.nunique() == told["done"]
    before = item_times(out)
    processes.end()
    flexroad(*words, "--executor", "serial").expected(0)
    assert_whole(out, light_run.path)
    assert before.items() <= item_times(out).items()


def test_run_workers_cannot_start_exits_with_one_line(words, flexroad, light_run, out):
    # Without the check at the start, as if the files were too few for the number of workers.
    code = "from flexroad.pipeline.cli import limits, main; limits.OPEN_FILES = 0; main.main()"
    call = [sys.executable, "-c", code, *words, "--executor", "dask", "--workers", "2"]
    few = ["sh", "-c", 'ulimit -n 40; exec "$@"', "sh"]
    done = subprocess.run([*few, *call], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    # A slow machine also says what takes more than a second.
    first, last = (
        line for line in done.stderr.splitlines() if not line.startswith(("preparing ", "reading "))
    )
    assert first == "starting: 4 tiles"
    assert last.startswith("error: cannot start 2 worker processes here: ")
    flexroad(*words, "--executor", "serial").expected(0)
    assert_whole(out, light_run.path)


def test_simultaneous_runs_share_a_store(words, tmp_path):
    # The last of repeated options counts.
    call = [*PROCESS, *words, "--executor", "serial", "--store", tmp_path / "store", "--out"]
    both = [
        subprocess.Popen(
            [*call, tmp_path / name], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        )
        for name in "ab"
    ]
    stderr = [process.communicate()[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], stderr
    # The standard error of a slow run also has progress lines.
    assert [error_lines(text) for text in stderr] == [[], []]
    pd.testing.assert_frame_equal(rows(tmp_path / "a"), rows(tmp_path / "b"), check_exact=True)
    assert not list(tmp_path.rglob("*.tmp"))


# --- workers in a mount namespace of their own, where a folder is another one than here ----------------

EMPTY = 'mount -t tmpfs none "$1"'
# It shows what is below, but what is written there stays there.
PRIVATE = (
    'mount -t tmpfs none "$2" && mkdir "$2/upper" "$2/work" && '
    'mount -t overlay overlay -o "lowerdir=$1,upperdir=$2/upper,workdir=$2/work" "$1"'
)


def elsewhere(mount: str, folder: Path, scratch: Path) -> tuple[str, ...]:
    """Return the start of a command that has another folder in place of ``folder``."""
    return ("unshare", "-m", "sh", "-c", f'{mount} && shift 2 && exec "$@"', "sh", str(folder), str(scratch))


def require(mount: str, scratch: Path) -> None:
    command = [*elsewhere(mount, scratch.parent / "run", scratch), "true"]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"mounts in a namespace are not allowed here: {error}")


@pytest.fixture
def places(made_survey, tmp_path):
    """Folders of the workers that are not the same as here, and one for their contents."""
    for name in ("run", "scratch"):
        (tmp_path / name).mkdir()
    survey = {"dsm": made_survey / "dsm", "survey": made_survey}
    return survey | {"run": tmp_path / "run", "scratch": tmp_path / "scratch"}


@pytest.fixture
def run(flexroad, processes, words, places, monkeypatch):
    """The command that runs the survey on the workers."""
    monkeypatch.setattr("flexroad.pipeline.execute.clusters.WORKER_LOST_TIMEOUT_S", 1)
    processes.scheduler()
    return lambda: flexroad(*words, "--executor", processes.address)


@pytest.mark.parametrize(
    ("name", "mount", "fault"),
    [
        ("dsm", EMPTY, "dsm/.*.tif does not exist there"),
        ("run", EMPTY, "/run is not the same folder there as here"),
        ("run", PRIVATE, "what it writes to .*/run does not arrive here"),
    ],
    ids=["survey", "run", "writes"],
)
def test_worker_with_another_file_system_is_left_out(
    name, mount, fault, run, processes, places, light_run, out
):
    require(mount, places["scratch"])
    processes.worker(before=elsewhere(mount, places[name], places["scratch"]))
    processes.worker()
    wait_for(processes.address, 2)
    said = run().expected(0)
    (line,) = (line for line in said.err.splitlines() if "left out" in line)
    host = os.uname().nodename
    assert re.fullmatch(
        rf"worker tcp://127.0.0.1:\d+ on {host} is left out: .*{fault}; mount it there under the same path",
        line,
    )
    assert "4 tiles: 4 done (0 cached), 0 failed, 0 pending" in said.out
    assert_whole(out, light_run.path)


@pytest.mark.parametrize("name", ["survey", "run"])
def test_run_with_only_such_workers_ends_with_one_error(name, run, processes, places, light_run, out):
    require(EMPTY, places["scratch"])
    worker = processes.worker(before=elsewhere(EMPTY, places[name], places["scratch"]))
    wait_for(processes.address, 1)
    said = run().expected(2)
    (error,) = said.errors
    assert error.startswith("error: no worker was left for 1 s; worker tcp://127.0.0.1:")
    assert error.endswith("; mount it there under the same path")
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["done"], summary["failed"], summary["pending"]) == (0, 0, 4)
    worker.terminate()
    worker.wait(20)
    processes.worker()
    run().expected(0)
    assert_whole(out, light_run.path)
