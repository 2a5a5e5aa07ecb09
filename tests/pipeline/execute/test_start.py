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


@pytest.mark.slow
@pytest.mark.parametrize("command", [["run.py"], ["-m", "flexroad"]])
def test_workers_import_no_module_of_the_current_folder(command, made_survey, quick_config, tmp_path):
    """A folder of downloads has files with the names of modules that the start of workers imports."""
    downloads, marks = tmp_path / "downloads", tmp_path / "marks"
    downloads.mkdir()
    for name in ("multiprocessing", "pickle", "distributed", "numpy", "rasterio"):
        line = f"open({str(marks)!r}, 'a').write({name!r}); raise ImportError"
        (downloads / f"{name}.py").write_text(line)
    program = tmp_path / "run.py"
    program.write_text("from flexroad.pipeline.cli.main import main\nif __name__ == '__main__': main()\n")
    words = [str(program) if word == "run.py" else word for word in command]
    words += ["run", "--catalog", str(made_survey / "catalog.parquet"), "--out", str(tmp_path / "run")]
    words += ["--config", str(quick_config), "--executor", "dask", "--workers", "1"]
    ended = subprocess.run([sys.executable, *words], cwd=downloads, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert not marks.exists()


def test_import_of_jobqueue_keeps_the_handler_of_interrupts(monkeypatch):
    """The module dask_jobqueue.runner replaces it."""
    pytest.importorskip("dask_jobqueue")
    for name in [name for name in sys.modules if name.partition(".")[0] == "dask_jobqueue"]:
        monkeypatch.delitem(sys.modules, name)
    before = signal.getsignal(signal.SIGINT)
    load_jobqueue()
    assert signal.getsignal(signal.SIGINT) is before
