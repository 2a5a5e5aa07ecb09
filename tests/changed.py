"""What changed since the soak tests passed: ``python tests/changed.py AREA`` ends with 0 if the area did.

Soak tests are marked ``soak`` with the name of an area. ``pytest --soak changed`` leaves out an area that has
not changed since the commit in ``tests/soak/passed``.
"""

import subprocess
import sys
from collections.abc import Collection
from pathlib import Path

ROOT = Path(__file__).parent.parent
PASSED = ROOT / "tests" / "soak" / "passed"

EVERYWHERE = {
    ".ci",
    "Makefile",
    "configs",
    "constraints.txt",
    "flexroad",
    "pyproject.toml",
    "pipeline/__init__.py",
}
"""Files and folders on which all areas depend, besides the helpers of the tests."""
RUNS = {
    "catalog",
    *(f"tasks/{name}" for name in ("compiled.py", "io", "load.py", "memory.py")),
    *(
        f"pipeline/{name}"
        for name in ("cli", "config", "errors.py", "execute", "graph", "run", "store", "worker")
    ),
}
"""What reads and writes the files of a run; the stages are pure functions."""
AREAS = {
    "runs": RUNS,
    "exports": RUNS | {"tools/export", "tasks/products"},
    "pages": {
        "viewer",
        "tasks/products",
        "tools/export",
        "tools/report",
        "tools/view",
        "pipeline/run",
        "pipeline/store",
    },
    "photos": {"catalog", "tasks/io", "tools/prepare"},
    "levels": {f"tasks/{name}" for name in ("filter", "fit", "levels", "roads", "segment", "spline")},
    "readers": RUNS | {"pipeline/check", "tools/check", "tools/prepare", "tools/results", "tasks/segment"},
}


def changed_files(root: Path = ROOT, record: Path = PASSED) -> list[str] | None:
    """Return the files that differ from the recorded commit; None if a clone does not have it."""
    command = ["git", "diff", "--name-only", "--no-renames", record.read_text().strip(), "--"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    return None if done.returncode else done.stdout.splitlines()


def is_due(area: str, changed: Collection[str] | None, test: str = "") -> bool:
    """Whether a file of the area, the file of the test or a helper of tests changed."""
    if changed is None:
        return True
    below = AREAS[area] | EVERYWHERE | {test}
    return any(
        is_helper(file) or any(Path(file).is_relative_to(part) for part in below if part) for file in changed
    )


def is_helper(file: str) -> bool:
    """Whether tests may use this file."""
    path = Path(file)
    return (
        path.is_relative_to("tests")
        and not path.name.startswith("test_")
        and path != PASSED.relative_to(ROOT)
    )


def record() -> str:
    """Record the commit in the work tree; return what was done in one line."""
    if subprocess.check_output(["git", "status", "--porcelain"], cwd=ROOT):
        return "soak tests passed, but not on a commit: there are changes"
    commit = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=ROOT, text=True)
    PASSED.write_text(commit)
    return f"soak tests passed on {commit.strip()}: commit {PASSED.relative_to(ROOT)}"


if __name__ == "__main__":
    sys.exit(not is_due(sys.argv[1], changed_files()))
