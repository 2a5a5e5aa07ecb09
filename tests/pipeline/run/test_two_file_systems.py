"""Workers in a mount namespace of their own: there the run or the survey is another folder than here."""

import json
import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from tests.builders import LIGHT
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


@pytest.fixture
def folders(made_survey, tmp_path):
    return {"dsm": made_survey / "dsm", "survey": made_survey, "run": tmp_path / "run"}


@pytest.fixture
def scratch(tmp_path):
    (tmp_path / "scratch").mkdir()
    return tmp_path / "scratch"


def require(mount: str, scratch: Path) -> None:
    command = [*elsewhere(mount, scratch.parent / "run", scratch), "true"]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"mounts in a namespace are not allowed here: {error}")


@pytest.fixture
def run(flexroad, processes, made_survey, tmp_path, monkeypatch):
    """The command that runs the survey on the workers."""
    monkeypatch.setattr("flexroad.pipeline.execute.clusters.WORKER_LOST_TIMEOUT_S", 1)
    config = tmp_path / "light.yaml"
    config.write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    (tmp_path / "run").mkdir()
    words = ["--config", config, "--catalog", made_survey / "catalog.parquet", "--out", tmp_path / "run"]
    processes.scheduler()
    return lambda: flexroad("run", *words, "--executor", processes.address)


@pytest.fixture(scope="module")
def undisturbed(made_survey, tmp_path_factory):
    catalog = Catalog.read(made_survey / "catalog.parquet")
    run = Run.create(tmp_path_factory.mktemp("undisturbed") / "run", compose(LIGHT, "light"), catalog)
    run_tiles(run, SerialExecutor())
    return run.path


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
    name, mount, fault, run, processes, folders, undisturbed, scratch
):
    require(mount, scratch)
    processes.worker(before=elsewhere(mount, folders[name], scratch))
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
    assert_whole(folders["run"], undisturbed)


@pytest.mark.parametrize("name", ["survey", "run"])
def test_run_with_only_such_workers_ends_with_one_error(name, run, processes, folders, undisturbed, scratch):
    require(EMPTY, scratch)
    worker = processes.worker(before=elsewhere(EMPTY, folders[name], scratch))
    wait_for(processes.address, 1)
    said = run().expected(2)
    (error,) = said.errors
    assert error.startswith("error: no worker was left for 1 s; worker tcp://127.0.0.1:")
    assert error.endswith("; mount it there under the same path")
    summary = json.loads((folders["run"] / "summary.json").read_text())
    assert (summary["done"], summary["failed"], summary["pending"]) == (0, 0, 4)
    worker.terminate()
    worker.wait(20)
    processes.worker()
    run().expected(0)
    assert_whole(folders["run"], undisturbed)
