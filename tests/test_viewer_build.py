"""The built files of the viewer are those of its sources."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

VIEWER = Path(__file__).parent.parent / "viewer"


@pytest.mark.skipif(shutil.which("npm") is None, reason="npm is not installed")
def test_viewer_built_again_has_the_same_bytes(tmp_path):
    copy = shutil.copytree(VIEWER, tmp_path / "viewer", ignore=shutil.ignore_patterns("node_modules", "dist"))
    install = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline"]
    subprocess.run(install, cwd=copy, check=True, capture_output=True)
    subprocess.run(["node", "build.js", tmp_path / "built"], cwd=copy, check=True, capture_output=True)
    assert files(tmp_path / "built") == files(VIEWER / "dist")


def files(folder):
    """The content of the files of a folder, by their names in it."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_parts_of_the_viewer_pass_their_own_tests():
    done = subprocess.run(
        ["node", "--test", "tests/"], cwd=VIEWER, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_lock_file_names_no_server():
    assert '"resolved"' not in (VIEWER / "package-lock.json").read_text()
