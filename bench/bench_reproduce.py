"""Commands of ``make reproduce``, one by one: CPU time of whole processes, by default over two tiles.

The five scenes that stand in for DSC3D are made in any case: more tiles change only the other commands.

Usage: ``PYTHONPATH=. python bench/bench_reproduce.py [TILES]``
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from bench.bench_start import FLEXROAD, cpu_s

ROOT = Path(__file__).parents[1]


def main(tiles: int) -> None:
    """Print the CPU time of each command."""
    total = 0.0
    with tempfile.TemporaryDirectory() as scratch:
        for command in commands(tiles):
            words = shlex.split(command)
            spent = cpu_s([*FLEXROAD, *(word.replace("runs/", f"{scratch}/") for word in words)])
            total += spent
            print(f"{' '.join(words)[:80]:82}{spent:8.1f}", flush=True)
    print(f"{f'make reproduce TILES={tiles}, CPU s':82}{total:8.1f}")


def commands(tiles: int) -> list[str]:
    """Return the arguments of ``flexroad`` that make would run if nothing had been made yet."""
    make = ["make", "--dry-run", "--always-make", "--old-file", ".venv/.installed", "reproduce"]
    listed = subprocess.run([*make, f"TILES={tiles}"], check=True, capture_output=True, text=True, cwd=ROOT)
    return re.findall(r"flexroad ([^;&\n]+)", listed.stdout)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2)
