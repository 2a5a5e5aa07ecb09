"""Start of clusters: interrupts, modules of the current folder, and the memory that a process may use."""

import contextlib
import os
import signal
import subprocess
import sys

import psutil
import pytest

from flexroad.pipeline.execute import start
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
    start.load_jobqueue()
    assert signal.getsignal(signal.SIGINT) is before


MIB = 2**20


@pytest.fixture
def available(tmp_path, monkeypatch):
    monkeypatch.setattr(start, "MEMORY_LIMIT", 900 * MIB)

    def call(name: str, **limits: str) -> int:
        """Return the memory of a process in the control group ``name``; ``limits`` by file, / as __."""
        for file, text in limits.items():
            path = tmp_path / file.replace("__", "/").replace("memory_", "memory.")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        (tmp_path / "own").write_text(name)
        return start.available_bytes(tmp_path, tmp_path / "own")

    return call


def test_available_memory_is_least_limit_of_the_group_and_those_around(available):
    unit = "0::/system.slice/roads.service\n"
    assert available(unit) == 900 * MIB
    assert available(unit, system__slice__memory_max="max\n") == 900 * MIB
    files = {"system.slice__roads.service__memory_max": f"{300 * MIB}\n"}
    assert available(unit, **files) == 300 * MIB
    assert available(unit, **{"system.slice__memory_high": f"{200 * MIB}\n"}) == 200 * MIB
    assert available("0::/\n") == 900 * MIB


def test_available_memory_of_first_version_of_control_groups(available):
    own = "5:cpu:/x\n4:memory:/slurm/job_7\n0::/\n"
    assert available(own, **{"memory__slurm__job_7__memory_limit_in_bytes": f"{400 * MIB}\n"}) == 400 * MIB


def test_available_memory_without_readable_files_is_that_of_dask(available):
    assert available("nothing") == 900 * MIB
    assert available("0::/../../x\n", **{"x__memory_max": "many\n"}) == 900 * MIB
