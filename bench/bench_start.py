"""Start of commands: CPU time of whole processes, relative to ``python -c "import numpy"``.

Targets: ``flexroad --help`` at most 3, ``flexroad config show`` at most 8, a run with nothing to do over ten
tiles at most 15, a rerun of one tile at most 25, all with the default number of workers.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from flexroad.catalog import Catalog
from flexroad.pipeline import ONE_THREAD

ROUNDS = 7
FLEXROAD = [sys.executable, "-c", "from flexroad.pipeline.cli.main import main; main()"]
ENVIRONMENT = {
    name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"
} | ONE_THREAD
"""An installed package has its bytecode on the disk."""


def cpu_s(command: list[str]) -> float:
    """Return the CPU time of a process and its children (s)."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True, env=ENVIRONMENT)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Print the CPU time of short commands."""
    with tempfile.TemporaryDirectory() as scratch:
        survey, run = Path(scratch, "survey"), Path(scratch, "run")
        synthetic = ["catalog", "synthetic", "-o", str(survey), "--tiles", "10", "--tile-size", "60"]
        subprocess.run([*FLEXROAD, *synthetic], check=True, capture_output=True)
        catalog = ["--catalog", str(survey / "catalog.parquet"), "--out", str(run)]
        tile = Catalog.read(survey / "catalog.parquet").tiles[0].id
        commands = {
            "python -c 'import numpy'": ([sys.executable, "-c", "import numpy"], 1),
            "flexroad --help": ([*FLEXROAD, "--help"], 3),
            "flexroad config show production": ([*FLEXROAD, "config", "show", "production"], 8),
            "nothing to do, ten tiles": ([*FLEXROAD, "run", "--config", "production", *catalog], 15),
            "rerun of one of ten tiles": (
                [*FLEXROAD, "rerun", str(run), "--from", "load", "--tile", tile],
                25,
            ),
        }
        for command, _ in commands.values():
            # First call not timed: it reads files into the cache and finishes the run.
            subprocess.run(command, check=True, capture_output=True)
        # Commands alternate, so that a slower machine affects all of them alike.
        rounds = [{name: cpu_s(command) for name, (command, _) in commands.items()} for _ in range(ROUNDS)]
    best = {name: min(times[name] for times in rounds) for name in commands}
    base = best["python -c 'import numpy'"]
    print(f"{'command':32}{'CPU s':>8}{'ratio':>8}{'target':>8}")
    for name, (_, target) in commands.items():
        print(f"{name:32}{best[name]:8.2f}{best[name] / base:8.1f}{target:8}")


if __name__ == "__main__":
    main()
