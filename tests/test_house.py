"""Rules of the house that the linters do not hold: names, lengths, and a light start of the command line."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FILES = sorted(
    path for package in ("catalog", "tasks", "pipeline") for path in (ROOT / package).rglob("*.py")
)


def test_no_file_is_a_drawer_for_everything():
    drawers = {"utils", "util", "common", "helpers", "misc"}
    assert not [path for path in FILES if path.stem in drawers]


def test_no_file_is_longer_than_400_lines():
    assert not [path for path in FILES if len(path.read_text().splitlines()) > 400]


def test_pipeline_has_at_most_16_rooms():
    rooms = [
        path for path in (ROOT / "pipeline").iterdir() if path.stem.strip("_") not in ("init", "pycache")
    ]
    assert len(rooms) <= 16


@pytest.mark.parametrize("module", ["flexroad.pipeline.cli.main"])
def test_command_line_starts_without_heavy_libraries(module):
    heavy = "numba torch pyvista trimesh distributed pandas rasterio scipy matplotlib".split()
    code = f"import sys, {module}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"
