"""Functions that numba compiles at their first call."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flexroad.tasks.compiled import compiled


@compiled()
def _reciprocal(value):
    return 1.0 / value


@compiled(error_model="numpy")
def _reciprocals(values):
    total = 0.0
    for value in values:
        total += _reciprocal(value)
    return total


def test_call_of_compiled_function_by_another_equals_python():
    values = np.array([1.0, 3.0, 7.0])
    assert _reciprocals(values) == sum(1.0 / value for value in values)


def test_function_called_by_a_compiled_one_can_be_called_from_python():
    assert _reciprocals(np.array([2.0])) == _reciprocal(2.0) == 0.5


def test_error_model_is_that_of_the_function_itself():
    with pytest.raises(ZeroDivisionError):
        _reciprocals(np.zeros(1))


def test_import_read_only_installation_without_home(tmp_path):
    """Numba raises on import if it has no writable cache folder; FlexRoad sets one."""
    root = Path(__file__).parents[2]
    for name in ("catalog", "tasks", "pipeline", "flexroad"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(root / name, tmp_path / name, symlinks=True, ignore=ignored)
    for folder in (tmp_path / "tasks", tmp_path / "tasks" / "fit"):
        # A file in place of the folder: root cannot write there, either.
        (folder / "__pycache__").touch()
    code = "import os, flexroad.pipeline, flexroad.tasks.fit.nurbs; print(os.environ['NUMBA_CACHE_DIR'])"
    elsewhere = ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
    environment = {name: value for name, value in os.environ.items() if name not in elsewhere}
    environment |= {"HOME": "/dev/null"}
    call = [sys.executable, "-c", code]
    done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not Path(done.stdout.strip()).exists()
