"""Limits of the system for a process, and errors of the system, as one line each."""

import errno
import os
import resource
import shutil
import subprocess
import sys

import pytest

from flexroad.pipeline.cli import limits
from tests.command_line import call
from tests.permissions import permissions_enforced


def limited(kind: int, soft: int, hard: int, *words) -> tuple[int, str]:
    """Run a command with a limit in a new process; return its exit code and what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "flexroad", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(kind, (soft, hard)),
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("files", [30, 64])
def test_run_with_few_open_files_ends_with_a_line_that_names_the_limit(files, tmp_path):
    said = limited(
        resource.RLIMIT_NOFILE, files, files, "run", "--catalog", "a.json", "--out", tmp_path / "run"
    )
    need = f"{limits.OPEN_FILES}; raise the limit with `ulimit -n 1024`"
    assert said == (2, f"error: this process may open only {files} files, and needs {need}\n")
    assert not (tmp_path / "run").exists()


def test_soft_limit_of_open_files_is_raised(made_survey, tmp_path):
    catalog = made_survey / "catalog.parquet"
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert hard > limits.OPEN_FILES
    words = ("run", "--catalog", catalog, "--out", tmp_path / "run", "--dry-run")
    code, said = limited(resource.RLIMIT_NOFILE, 30, hard, *words)
    assert code == 0, said


def test_command_with_little_address_space_ends_with_a_line_that_names_the_limit(made_survey, tmp_path):
    space, catalog = 2**30, made_survey / "catalog.parquet"
    words = ("run", "--catalog", catalog, "--out", tmp_path / "run", "--executor", "serial")
    code, said = limited(resource.RLIMIT_AS, space, space, *words)
    (line,) = said.splitlines()
    assert code == 2
    assert line.startswith("error: the address space of this process is limited to 1,048,576 KiB, and needs ")
    assert "`ulimit -v unlimited`" in line
    # A command that computes nothing is not refused: it ends when the libraries find no memory.
    code, said = limited(resource.RLIMIT_AS, space // 4, space // 4, "catalog", "show", catalog)
    assert code == 2
    assert said.splitlines()[-1].startswith(
        "error: the address space of this process is limited to 262,144 KiB"
    )
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(errno.EMFILE, "Too many open files"), "raise the limit with `ulimit -n 1024`"),
        (PermissionError(errno.EACCES, "Permission denied", "/a"), "give this user access"),
        (OSError(errno.ENOSPC, "No space left on device"), "free disk space"),
        (OSError(errno.EIO, "Input/output error"), "check the path and the disk"),
    ],
)
def test_error_of_the_system_has_its_remedy(error, expected):
    assert expected in limits.remedy(error)


@pytest.mark.parametrize("module", ["flexroad", "flexroad.pipeline.cli.main"])
def test_package_and_module_run_as_the_command_does(module):
    done = subprocess.run([sys.executable, "-m", module, "run"], capture_output=True, text=True, check=False)
    said = call("run").expected(2)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1] == said.err.splitlines()[-1]
    assert "--catalog" in done.stderr


def test_library_that_cannot_be_loaded_is_no_fault_of_the_catalog(made_survey, tmp_path):
    """As an old NumPy beside, which pyarrow refuses."""
    (tmp_path / "pyarrow").mkdir()
    (tmp_path / "pyarrow" / "__init__.py").write_text('raise ImportError("pyarrow requires NumPy 99")\n')
    done = subprocess.run(
        [sys.executable, "-m", "flexroad", "catalog", "show", made_survey / "catalog.parquet"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    reason = "a library cannot be loaded: pyarrow requires NumPy 99; install flexroad and its libraries again"
    assert (done.returncode, done.stderr) == (2, f"error: {reason}\n")


def test_run_of_a_survey_without_permission_says_so(made_survey, tmp_path):
    survey = shutil.copytree(made_survey, tmp_path / "survey")
    words = ("run", "--catalog", survey / "catalog.parquet", "--config", "paper", "--out", tmp_path / "run")
    (survey / "dsm").chmod(0)
    with permissions_enforced():
        said = call(*words, "--executor", "serial")
    (survey / "dsm").chmod(0o755)
    (line,) = said.expected(2).errors
    assert line.endswith("it cannot be read: Permission denied; make it readable")
    assert f"{survey / 'dsm'}/" in line
