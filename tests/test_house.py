"""Project rules that linters do not check: file names, file lengths, imports of the command line."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path for package in ("catalog", "tasks", "pipeline") for path in (ROOT / package).rglob("*.py")
)


def test_file_names_are_specific():
    unspecific = {"utils", "util", "common", "helpers", "misc"}
    assert not [path for path in FILES if path.stem in unspecific]


def test_files_have_at_most_600_lines():
    assert not [path for path in FILES if len(path.read_text().splitlines()) > 600]


def test_pipeline_has_at_most_16_packages():
    packages = [
        path for path in (ROOT / "pipeline").iterdir() if path.stem.strip("_") not in ("init", "pycache")
    ]
    assert len(packages) <= 16


@pytest.mark.parametrize("module", ["flexroad.pipeline.cli.main"])
def test_command_line_starts_without_heavy_libraries(module):
    heavy = "numba torch pyvista trimesh distributed pandas rasterio scipy matplotlib".split()
    code = f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"


SCRIPTS = sorted((ROOT / "tests" / "bench").glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_names_that_scripts_import_exist(script):
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(("flexroad", "tests")):
            module = importlib.import_module(node.module)
            for name in node.names:
                if not hasattr(module, name.name):
                    importlib.import_module(f"{node.module}.{name.name}")
