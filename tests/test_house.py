"""Rules of the house: imports run pipeline -> tasks -> catalog, siblings keep apart, heavy things wait."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ORDER = {"catalog": 0, "tasks": 1, "pipeline": 2}
FILES = sorted(path for package in ORDER for path in (ROOT / package).rglob("*.py"))
KEPT_APART = ("catalog/sources", "tasks/segment", "tasks/fit", "tasks/export")
PROGRAMS = (Path("pipeline/report/mesh_view.py"),)
"""Files that are run in a process of their own and imported by nothing."""


def imports(path: Path) -> list[tuple[str, int]]:
    """Module names imported in a file, with the column: 0 is at the top level."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.col_offset) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found += [(f"{node.module}.{alias.name}", node.col_offset) for alias in node.names]
            found.append((node.module, node.col_offset))
    return found


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports(path):
    here = path.relative_to(ROOT)
    for name, column in imports(path):
        name = name.removeprefix("flexroad.")
        head = name.split(".")[0]
        if head in ORDER:
            assert ORDER[head] <= ORDER[here.parts[0]], f"{here} imports {name}"
        if here.parent.as_posix() in KEPT_APART:
            folder = ".".join(here.parent.parts)
            sibling = name.startswith(f"{folder}.") and not name.startswith(f"{folder}._")
            assert not sibling, f"{here} imports its sibling {name}"
        if head in ("dask", "distributed"):
            assert here.parent.as_posix() == "pipeline/execute", f"{here} knows Dask"
        if head in ("torch", "pyvista", "transformers", "trimesh") and column == 0 and here not in PROGRAMS:
            pytest.fail(f"{here} imports {name} at once")


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_drawer_for_everything(path):
    assert path.stem not in ("utils", "util", "common", "helpers", "misc")


def test_the_command_line_starts_light():
    heavy = "numba torch pyvista trimesh distributed pandas rasterio scipy matplotlib".split()
    code = f"import sys, flexroad.pipeline.cli; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"
