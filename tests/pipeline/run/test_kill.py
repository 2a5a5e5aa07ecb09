"""Processes are killed in mid-run; the same command then finishes, to the same tables."""

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

pytestmark = pytest.mark.slow

CONFIG = """
fit: {control_points: [20, 20], iterations: 3000}
variants: {plane: {fit: plane, sample: corners}, flexroad: {}}
"""
"""Slow enough to be caught at it."""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    from flexroad.pipeline.benchmark.scenes import write_scenes

    folder = tmp_path_factory.mktemp("kill")
    (folder / "slow.yaml").write_text(CONFIG)
    write_scenes(folder / "survey", 9, seed=5, size_m=80)
    return folder


@pytest.fixture(scope="module")
def undisturbed(place) -> pd.DataFrame:
    catalog = Catalog.read(place / "survey" / "catalog.parquet")
    run = Run.create(place / "undisturbed", load_config(place / "slow.yaml"), catalog)
    run_tiles(run, SerialExecutor())
    return read_metrics(run.path).drop(columns="seconds")


def command(place, out) -> list[str]:
    words = ["--config", place / "slow.yaml", "--catalog", place / "survey" / "catalog.parquet"]
    call = "from flexroad.pipeline.cli.main import main; main()"
    return [sys.executable, "-c", call, "run", *map(str, words), "--out", str(out), "--workers", "2"]


def markers(out) -> list:
    return list(out.glob("tiles/*/item.json"))


def workers(pid: int) -> list[psutil.Process]:
    children = psutil.Process(pid).children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


@pytest.mark.parametrize("kill", [os.killpg, os.kill], ids=["with its workers", "alone"])
def test_the_whole_run_is_killed(place, undisturbed, tmp_path, kill):
    out = tmp_path / "run"
    process = subprocess.Popen(command(place, out), start_new_session=True, stderr=subprocess.DEVNULL)
    until(lambda: len(markers(out)) >= 2)
    left = workers(process.pid)
    kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = {path: path.stat().st_mtime_ns for path in markers(out)}
    assert 2 <= len(kept) < 9
    subprocess.run(command(place, out), check=True, capture_output=True)
    assert all(path.stat().st_mtime_ns == before for path, before in kept.items())
    until(lambda: not any(worker.is_running() for worker in left))
    table = read_metrics(out).drop(columns="seconds")
    pd.testing.assert_frame_equal(table, undisturbed, check_exact=True)


@pytest.mark.parametrize("which", [slice(1), slice(None)], ids=["one", "all"])
def test_workers_are_killed(place, undisturbed, tmp_path, which):
    out = tmp_path / "run"
    process = subprocess.Popen(command(place, out), stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until(lambda: len(markers(out)) >= 1)
    for worker in workers(process.pid)[which]:
        worker.kill()
    assert process.wait(timeout=120) == 0
    table = read_metrics(out).drop(columns="seconds")
    pd.testing.assert_frame_equal(table, undisturbed, check_exact=True)


@pytest.mark.parametrize("how", ["ctrl-c", "kill"])
def test_an_interrupt_ends_in_seconds_and_keeps_what_is_done(place, undisturbed, tmp_path, how):
    out = tmp_path / "run"
    process = subprocess.Popen(command(place, out), start_new_session=True, stderr=subprocess.PIPE, text=True)
    until(lambda: len(markers(out)) >= 1)
    if how == "ctrl-c":
        # A terminal sends it to all processes of the command, workers too; and somebody is impatient.
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
    subprocess.run(command(place, out), check=True, capture_output=True)
    table = read_metrics(out).drop(columns="seconds")
    pd.testing.assert_frame_equal(table, undisturbed, check_exact=True)
