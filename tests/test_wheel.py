"""Contents of the wheel."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from flexroad.pipeline.execute.workers import checksum_of_code

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parent.parent


def test_wheel_contains_one_import_package(tmp_path):
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", tmp_path, ROOT]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    top = {name.split("/")[0] for name in names}
    assert top == {"flexroad", f"{wheel.name.removesuffix('-py3-none-any.whl')}.dist-info"}
    for file in (
        "catalog/grid.py",
        "tasks/load.py",
        "pipeline/graph/graph.py",
        "configs/paper.yaml",
        "viewer/dist/LICENSES.txt",
        "viewer/dist/index.html",
        "viewer/dist/viewer.css",
        "viewer/dist/viewer.js",
        "py.typed",
    ):
        assert f"flexroad/{file}" in names
    zipfile.ZipFile(wheel).extractall(tmp_path)
    # Clients and workers may be installed in either way.
    assert checksum_of_code(tmp_path / "flexroad") == checksum_of_code()
