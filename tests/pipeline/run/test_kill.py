"""Processes killed during a run; the same command then finishes with the same tables."""

import os
import signal
import subprocess
import sys
import time

import pandas as pd
import psutil
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.tables import read_metrics
from tests.dask_processes import until

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

CONFIG = """
extends: defaults
fit: {control_points: [20, 20], iterations: 3000}
variants: {plane: {fit: plane, sample: corners}, flexroad: {}}
"""
"""Slow enough for the processes to be killed before the end."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from flexroad.tools.synthetic.scenes import write_scenes

    path = tmp_path_factory.mktemp("kill")
    (path / "slow.yaml").write_text(CONFIG)
    write_scenes(path / "survey", 9, seed=5, size_m=80)
    return path


@pytest.fixture(scope="module")
def undisturbed(folder) -> pd.DataFrame:
    catalog = Catalog.read(folder / "survey" / "catalog.parquet")
    run = Run.create(folder / "undisturbed", load_config(folder / "slow.yaml"), catalog)
    run_tiles(run, SerialExecutor())
    return read_metrics(run.path).drop(columns="seconds")


def command(folder, out) -> list[str]:
    words = ["--config", folder / "slow.yaml", "--catalog", folder / "survey" / "catalog.parquet"]
    call = "from flexroad.pipeline.cli.main import main; main()"
    return [
        sys.executable,
        "-c",
        call,
        "run",
        *map(str, words),
        "--out",
        str(out),
        "--executor",
        "dask",
        "--workers",
        "2",
    ]


def markers(out) -> list:
    return list(out.glob("tiles/*/item.json"))


def workers(pid: int) -> list[psutil.Process]:
    children = psutil.Process(pid).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


@pytest.mark.parametrize("kill", [os.killpg, os.kill], ids=["with its workers", "alone"])
def test_run_killed_resumes_to_same_tables(folder, undisturbed, tmp_path, kill):
    out = tmp_path / "run"
    process = subprocess.Popen(command(folder, out), start_new_session=True, stderr=subprocess.DEVNULL)
    until(lambda: len(markers(out)) >= 2)
    left = workers(process.pid)
    kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in markers(out)}
    assert 2 <= len(kept) < 9
    subprocess.run(command(folder, out), check=True, capture_output=True)
    assert all(path.stat().st_mtime_ns == before for path, before in kept.items())
    until(lambda: not any(worker.is_running() for worker in left))
    table = read_metrics(out).drop(columns="seconds")
    pd.testing.assert_frame_equal(table, undisturbed, check_exact=True)


@pytest.mark.parametrize("which", [slice(1), slice(None)], ids=["one", "all"])
def test_run_workers_killed_completes(folder, undisturbed, tmp_path, which):
    out = tmp_path / "run"
    process = subprocess.Popen(command(folder, out), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until(lambda: len(markers(out)) >= 1)
    for worker in workers(process.pid)[which]:
        worker.kill()
    assert process.wait(timeout=120) == 0
    table = read_metrics(out).drop(columns="seconds")
    pd.testing.assert_frame_equal(table, undisturbed, check_exact=True)


@pytest.mark.parametrize("signal_sent", ["ctrl-c", "kill"])
def test_run_interrupted_ends_soon_and_keeps_done_tiles(folder, undisturbed, tmp_path, signal_sent):
    out = tmp_path / "run"
    process = subprocess.Popen(
        command(folder, out), start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    until(lambda: len(markers(out)) >= 1)
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
    rows = read_metrics(out)
    assert 1 <= rows.tile_id.nunique() < 9
    subprocess.run(command(folder, out), check=True, capture_output=True)
    table = read_metrics(out).drop(columns="seconds")
    pd.testing.assert_frame_equal(table, undisturbed, check_exact=True)
