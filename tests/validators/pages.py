"""Pages in Chromium, by ``browse.py``."""

import json
import subprocess
from pathlib import Path
from typing import Any

from tests import validators

SCRIPT = Path(__file__).with_name("browse.py")


def visit(
    page: Path, *steps: dict, fragment: str = "", width: int = 1000, height: int = 640, dark: bool = False
) -> dict[str, Any]:
    """Return what steps on a page gave, its requests and errors, and whether it is wider than the window."""
    wanted = {
        "url": page.absolute().as_uri() + fragment,
        "program": str(validators.browser()),
        "width": width,
        "height": height,
        "dark": dark,
        "steps": steps,
    }
    command = [validators.python(), SCRIPT]
    done = subprocess.run(command, input=json.dumps(wanted), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said: dict[str, Any] = json.loads(done.stdout)
    return said


def browse(page: Path, *steps: dict, **options: Any) -> list[Any]:
    """Return what steps on a page gave; fails on a request or an error of the page."""
    answer = visit(page, *steps, **options)
    assert answer["requests"] == []
    assert answer["errors"] == []
    results: list[Any] = answer["results"]
    return results
