"""Start of clusters: interrupts."""

import contextlib
import os
import signal
import subprocess
import sys

import psutil
import pytest

from flexroad.pipeline.execute.start import load_jobqueue
from tests import command_line
from tests.dask_processes import until


@pytest.mark.slow
def test_run_interrupted_while_workers_start_says_so_in_one_line(made_survey, quick_config, tmp_path):
    words = ["run", "--catalog", made_survey / "catalog.parquet", "--out", tmp_path / "run"]
    words += ["--config", quick_config, "--executor", "dask"]
    with (tmp_path / "output").open("w") as output:
        command = [*command_line.PROCESS, *map(str, words)]
        process = subprocess.Popen(command, stdout=output, stderr=output, start_new_session=True)
    try:
        children = psutil.Process(process.pid).children
        until(lambda: any("spawn_main" in " ".join(child.cmdline()) for child in children()))
        # As the terminal does: to all processes.
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(60) == 130
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    lines = (tmp_path / "output").read_text().splitlines()
    assert lines[-1] == "interrupted; the same command goes on from here"
    assert all(
        line.startswith(("starting: ", "preparing ", "reading ", "0/4 tiles")) for line in lines[:-1]
    ), lines


def test_import_of_jobqueue_keeps_the_handler_of_interrupts(monkeypatch):
    """The module dask_jobqueue.runner replaces it."""
    pytest.importorskip("dask_jobqueue")
    for name in [name for name in sys.modules if name.partition(".")[0] == "dask_jobqueue"]:
        monkeypatch.delitem(sys.modules, name)
    before = signal.getsignal(signal.SIGINT)
    load_jobqueue()
    assert signal.getsignal(signal.SIGINT) is before
