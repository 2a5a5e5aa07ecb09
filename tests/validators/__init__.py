"""Third-party programs that check exports: installed by ``make validators``, in an environment of their own.

The tests run them as processes. ``FLEXROAD_VALIDATORS`` names their folder; without it, those tests are
skipped. ``requirements.txt`` has the Python packages, ``package.json`` the packages of Node.
"""

import os
import shutil
from pathlib import Path

import pytest

BROWSER = "chromium"


def python() -> Path:
    """Return the interpreter that imports the Python packages."""
    return program("python")


def program(name: str) -> Path:
    """Return a program of the Python packages."""
    return _present(_folder() / "bin" / name)


def package(name: str) -> Path:
    """Return the folder of a package of Node."""
    return _present(_folder() / "node_modules" / name)


def node() -> Path:
    """Return the program that runs packages of Node."""
    return _on_path("node")


def browser() -> Path:
    """Return the program of the browser, which is a package of the system."""
    return _on_path(BROWSER)


def _folder() -> Path:
    folder = os.environ.get("FLEXROAD_VALIDATORS")
    if not folder:
        pytest.skip("FLEXROAD_VALIDATORS is not set: `make validators` installs them")
    return Path(folder).absolute()


def _present(path: Path) -> Path:
    assert path.exists(), f"{path} is missing: run `make validators`"
    return path


def _on_path(name: str) -> Path:
    _folder()
    found = shutil.which(name)
    assert found, f"{name} is not installed"
    return Path(found)
