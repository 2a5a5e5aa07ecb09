"""Processes killed during a run; the same command then finishes with the same tables."""

import os
import signal
import subprocess
import time

import pandas as pd
import psutil
import pytest

from flexroad.pipeline.config.loading import load_config
from flexroad.tools.synthetic.scenes import write_scenes
from tests.builders import finish_run
from tests.command_line import PROCESS
from tests.dask_processes import until
from tests.whole_run import item_times, rows

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
def command(folder, tmp_path) -> list:
    words = ["--config", folder / "slow.yaml", "--catalog", folder / "survey" / "catalog.parquet"]
    return [*PROCESS, "run", *words, "--out", tmp_path / "run", "--executor", "dask", "--workers", "2"]


def workers(pid: int) -> list[psutil.Process]:
    children = psutil.Process(pid).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def assert_equal(out, undisturbed) -> None:
    pd.testing.assert_frame_equal(rows(out), undisturbed, check_exact=True)


@pytest.mark.parametrize("kill", [os.killpg, os.kill], ids=["with its workers", "alone"])
def test_run_killed_resumes_to_same_tables(command, undisturbed, tmp_path, kill):
    out = tmp_path / "run"
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
def test_run_workers_killed_completes(command, undisturbed, tmp_path, which):
    out = tmp_path / "run"
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until(lambda: item_times(out))
    for worker in workers(process.pid)[which]:
        worker.kill()
    assert process.wait(timeout=120) == 0
    assert_equal(out, undisturbed)


@pytest.mark.parametrize("signal_sent", ["ctrl-c", "kill"])
def test_run_interrupted_ends_soon_and_keeps_done_tiles(command, undisturbed, tmp_path, signal_sent):
    out = tmp_path / "run"
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
