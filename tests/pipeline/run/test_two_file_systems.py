"""Workers in a mount namespace of their own: there the run or the survey is another folder than here."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.dask_processes import wait_for
from tests.whole_run import assert_whole

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

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
def run(flexroad, processes, made_survey, light_config, places, monkeypatch):
    """The command that runs the survey on the workers."""
    monkeypatch.setattr("flexroad.pipeline.execute.clusters.WORKER_LOST_TIMEOUT_S", 1)
    words = ["--config", light_config, "--catalog", made_survey / "catalog.parquet", "--out", places["run"]]
    processes.scheduler()
    return lambda: flexroad("run", *words, "--scheduler", processes.address)


@pytest.mark.parametrize(
    ("name", "mount", "fault"),
    [
        ("dsm", EMPTY, "dsm/.*.tif does not exist there"),
        ("run", EMPTY, "/run is not the same folder there as here"),
        ("run", PRIVATE, "what it writes to .*/run does not arrive here"),
    ],
    ids=["survey", "run", "writes"],
)
def test_worker_with_another_file_system_is_left_out(name, mount, fault, run, processes, places, light_run):
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
    assert_whole(places["run"], light_run.path)


@pytest.mark.parametrize("name", ["survey", "run"])
def test_run_with_only_such_workers_ends_with_one_error(name, run, processes, places, light_run):
    require(EMPTY, places["scratch"])
    worker = processes.worker(before=elsewhere(EMPTY, places[name], places["scratch"]))
    wait_for(processes.address, 1)
    said = run().expected(2)
    (error,) = said.errors
    assert error.startswith("error: no worker was left for 1 s; worker tcp://127.0.0.1:")
    assert error.endswith("; mount it there under the same path")
    summary = json.loads((places["run"] / "summary.json").read_text())
    assert (summary["done"], summary["failed"], summary["pending"]) == (0, 0, 4)
    worker.terminate()
    worker.wait(20)
    processes.worker()
    run().expected(0)
    assert_whole(places["run"], light_run.path)
