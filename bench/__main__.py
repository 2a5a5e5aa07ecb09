"""``make bench``: stages and floors, peers, start of commands, ``make reproduce``; then a list of the others.

Usage: ``python -m bench [NAME ... | all]``; NAME is the name of a file without ``bench_``.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

from flexroad.pipeline import ONE_THREAD

FOLDER = Path(__file__).parent
FIRST = ("tile", "peers", "start", "reproduce")
"""Benchmarks that run without a name; the others take minutes, need real data, or answer one question."""


def main(names: list[str]) -> None:
    there = {path.stem.removeprefix("bench_"): path for path in sorted(FOLDER.glob("bench_*.py"))}
    chosen = list(there) if names == ["all"] else names or list(FIRST)
    if unknown := [name for name in chosen if name not in there]:
        raise SystemExit(f"no benchmark {', '.join(unknown)}; there are {', '.join(there)}")
    environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(FOLDER.parent)}
    for name in chosen:
        print(f"\n== {name}", flush=True)
        subprocess.run([sys.executable, str(there[name])], check=True, env=environment)
    if not names:
        print("\nothers, one by one (make bench BENCH=NAME; several minutes with BENCH=all):")
        for name in [name for name in there if name not in FIRST]:
            print(f"  {name:18}{about(there[name])}")
        print("two checkouts against each other: python bench/compare.py OTHER_CHECKOUT")


def about(path: Path) -> str:
    """Return the first line of a file's docstring."""
    return (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]


if __name__ == "__main__":
    main(sys.argv[1:])
