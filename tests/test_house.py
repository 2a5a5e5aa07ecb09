"""Project rules that linters do not check: file names, file lengths, imports of the command line."""

import ast
import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flexroad.tools.synthetic.scenes import write_scenes

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path for package in ("catalog", "tasks", "pipeline", "tools") for path in (ROOT / package).rglob("*.py")
)


def test_file_names_are_specific():
    unspecific = {"utils", "util", "common", "helpers", "misc"}
    assert not [path for path in FILES if path.stem in unspecific]


def test_files_have_at_most_600_lines():
    assert not [path for path in FILES if len(path.read_text().splitlines()) > 600]


@pytest.mark.slow
def test_core_without_tools_works(tmp_path):
    """A copy without `tools` makes a catalog, runs it, and shows, repeats and cleans the run."""
    core = tmp_path / "core"
    for name in ("flexroad", "catalog", "tasks", "pipeline", "configs"):
        ignored = shutil.ignore_patterns("tools", "__pycache__") if name == "flexroad" else None
        shutil.copytree(ROOT / name, core / name, symlinks=True, ignore=ignored)
    write_scenes(tmp_path / "survey", 1, 0, 40)
    layers = "--dsm dsm/*.tif --dtm dtm/*.tif --road-mask road_mask/*.tif"
    for line in (
        f"catalog rasters survey {layers} --tile-size 40 -o own.parquet",
        "run --catalog own.parquet --out r --executor serial",
        "run --catalog own.parquet --out r --dry-run",
        "rerun r",
        "status r",
        "clean r --dry-run",
        "config show production",
        "--help",
    ):
        done = subprocess.run(
            [sys.executable, "-P", "-m", "flexroad", *line.split()],
            env={**os.environ, "PYTHONPATH": str(core)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"


SCRIPTS = sorted((ROOT / "bench").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_names_that_scripts_import_exist(script):
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(("flexroad", "tests")):
            module = importlib.import_module(node.module)
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")
