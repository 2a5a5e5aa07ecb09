"""``prepare`` of points beside the decoding of its file: with classes, with the slope filter, by workers.

CPU seconds of complete commands: the lowest of some rounds, with their worker processes. A synthetic
scan always; with FLEXROAD_REAL_DATA also the north of Autzen, whose ground the slope filter then classifies.

Usage: ``python bench/bench_points.py [--rounds 3] [--million 5] [--workers 1 2]``
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import laspy
import numpy as np

from flexroad.pipeline import ONE_THREAD
from flexroad.tools.prepare.points.ground_filter import Options, ground
from tests.make_clouds import write_cloud

HERE = Path(__file__).parents[1]
AUTZEN, FOOT = "autzen/autzen_north.laz", 0.3048
PER_M2 = 8
METHODS = ("classes", "filter")
COMMAND = "import sys; from flexroad.pipeline.cli.main import main; sys.argv[0] = 'flexroad'; main()"
DECODE = "import sys, laspy; [None for _ in laspy.open(sys.argv[1]).chunk_iterator(1_000_000)]"
GROUND, PLANTS, HOUSE = 2, 5, 6


@dataclass(frozen=True)
class Cost:
    """What one command took."""

    cpu_s: float
    wall_s: float
    peak_mb: float
    """Of the command's own process."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--million", type=float, default=5, help="points of the synthetic scan")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="points-") as scratch:
        folder = Path(scratch)
        # Written in the first round, as the installation of a package does.
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "bytecode")
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        # In a process of its own: Linux counts the memory of this process for the commands that it starts.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            files = pool.submit(clouds, folder, round(options.million * 1e6)).result()
        for file in files:
            decoding = min(run([DECODE, str(file)]).cpu_s for _ in range(options.rounds + 1))
            print(f"{file.name}: decoding {decoding:.2f} CPU s")
            for method in METHODS:
                for workers in options.workers:
                    # The first round compiles code, or loads compiled code; it is not counted.
                    rounds = range(options.rounds + 1)
                    costs = [prepare(file, folder / "out", method, workers) for _ in rounds][1:]
                    show(f"  {method:8} {workers} workers", costs, decoding)


def clouds(folder: Path, n: int) -> list[Path]:
    """Return the files that are measured, all with classes."""
    files = [synthetic(folder / "synthetic.laz", n)]
    if data := os.environ.get("FLEXROAD_REAL_DATA"):
        las = laspy.read(Path(data) / AUTZEN)
        is_ground = ground(*(np.asarray(axis) * FOOT for axis in (las.x, las.y, las.z)), Options())
        las.classification = np.where(is_ground, GROUND, PLANTS).astype(np.uint8)
        las.write(folder / "autzen.laz")
        files.append(folder / "autzen.laz")
    return files


def synthetic(file: Path, n: int) -> Path:
    """Write a hilly square with houses, plants and colours."""
    rng = np.random.default_rng(3)
    side = (n / PER_M2) ** 0.5
    x, y = rng.uniform(0, side, (2, n))
    z = 80 + 8 * np.sin(x / 90) * np.cos(y / 70) + rng.normal(0, 0.03, n)
    house, plants = (x % 40 < 14) & (y % 50 < 12), rng.random(n) < 0.2
    z[plants] += rng.uniform(0.5, 12, plants.sum())
    z[house] += 9
    kind = np.select([house, plants], [HOUSE, PLANTS], GROUND).astype(np.uint8)
    order = np.argsort(x // 5, kind="stable")
    xyz = np.stack([x + 356_000, y + 5_699_000, z], axis=1)[order]
    return write_cloud(file, xyz, kind[order], "EPSG:25832", rng.integers(256, 2**16, (n, 3)))


def show(title: str, costs: list[Cost], decoding_s: float) -> None:
    cpu_s, wall_s = (min(getattr(cost, field) for cost in costs) for field in ("cpu_s", "wall_s"))
    peak_mb = max(cost.peak_mb for cost in costs)
    times = f"{cpu_s:7.2f} CPU s{cpu_s / decoding_s:6.1f} x decoding{wall_s:7.2f} s{peak_mb:6.0f} MB"
    print(f"{title}{times}", flush=True)


def prepare(file: Path, out: Path, method: str, workers: int = 1) -> Cost:
    """Run the command from one file into a new folder."""
    shutil.rmtree(out, ignore_errors=True)
    words = f"prepare {file} -o {out} --ground {method} --workers {workers} --date 2020-01-01"
    return run([COMMAND, *words.split()])


def run(words: list[str]) -> Cost:
    """Run Python code with arguments; the CPU time includes that of its child processes."""
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", *words],
        cwd=HERE,
        env=os.environ | ONE_THREAD | {"PYTHONPATH": str(HERE)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    if process.returncode or status:
        raise SystemExit(f"{' '.join(words[1:])} failed")
    return Cost(used.ru_utime + used.ru_stime, time.perf_counter() - start, used.ru_maxrss / 1024)


if __name__ == "__main__":
    main()
