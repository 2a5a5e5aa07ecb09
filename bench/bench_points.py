"""``prepare`` of points beside the decoding of its file: with classes, with the slope filter, by workers.

CPU seconds of complete commands, with their worker processes: the lowest of some rounds. The input is a
synthetic scan. With FLEXROAD_REAL_DATA it is also the north of Autzen, whose ground the slope filter then
classifies. With another checkout both run in turn, A B A B, and their rasters are compared.

Usage: ``python bench/bench_points.py [--rounds 3] [--million 5] [--workers 1 2] [--other CHECKOUT]``
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
import rasterio

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
    """The cost of one command."""

    cpu_s: float
    wall_s: float
    peak_mb: float
    """Cost of the command's own process."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--million", type=float, default=5, help="points of the synthetic scan")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--other", type=Path, help="folder of another checkout")
    options = parser.parse_args()
    checkouts = {"this": HERE} | ({"other": options.other.resolve()} if options.other else {})
    with tempfile.TemporaryDirectory(prefix="points-") as scratch:
        folder = Path(scratch)
        # Written in the first round, as the installation of a package does.
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "bytecode")
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        # A process of its own makes the scan: Linux adds the memory of this process to the commands it
        # starts.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            files = pool.submit(clouds, folder, round(options.million * 1e6)).result()
        for file in files:
            decoding = min(run([DECODE, str(file)], HERE).cpu_s for _ in range(options.rounds + 1))
            print(f"{file.name}: decoding {decoding:.2f} CPU s")
            for method in METHODS:
                for workers in options.workers:
                    compare(checkouts, file, method, workers, options.rounds, folder, decoding)


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


def compare(
    checkouts: dict[str, Path],
    file: Path,
    method: str,
    workers: int,
    rounds: int,
    folder: Path,
    decoding_s: float,
) -> None:
    costs: dict[str, list[Cost]] = {name: [] for name in checkouts}
    # The first round compiles code, or loads compiled code; it is not counted.
    for number in range(rounds + 1):
        for name, root in checkouts.items():
            cost = prepare(file, folder / f"out-{name}", method, workers, root)
            if number:
                costs[name].append(cost)
    for name, measured in costs.items():
        cpu_s, wall_s, peak_mb = (
            pick(getattr(cost, field) for cost in measured)
            for pick, field in ((min, "cpu_s"), (min, "wall_s"), (max, "peak_mb"))
        )
        print(
            f"  {method:8} {workers} workers {name:6}{cpu_s:7.2f} CPU s{cpu_s / decoding_s:6.1f} x decoding"
            f"{wall_s:7.2f} s{peak_mb:6.0f} MB",
            flush=True,
        )
    if len(checkouts) > 1:
        print(f"  rasters: {difference(*(folder / f'out-{name}' for name in checkouts))}", flush=True)


def prepare(file: Path, out: Path, method: str, workers: int = 1, root: Path = HERE) -> Cost:
    """Run the command from one file into a new folder."""
    shutil.rmtree(out, ignore_errors=True)
    words = f"prepare {file} -o {out} --ground {method} --workers {workers} --date 2020-01-01"
    return run([COMMAND, *words.split()], root)


def run(words: list[str], root: Path) -> Cost:
    """Run Python code with arguments in a checkout; the CPU time includes that of its child processes."""
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": str(root)}
    start = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-c", *words],
        cwd=root,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    if process.returncode or status:
        raise SystemExit(f"{' '.join(words[1:])} failed")
    return Cost(used.ru_utime + used.ru_stime, time.perf_counter() - start, used.ru_maxrss / 1024)


def difference(one: Path, other: Path) -> str:
    """Return how the rasters of two folders differ."""
    names = [{path.name for path in folder.glob("*.tif")} for folder in (one, other)]
    if names[0] != names[1]:
        return f"other files: {sorted(names[0] ^ names[1])}"
    for name in sorted(names[0]):
        with rasterio.open(one / name) as a, rasterio.open(other / name) as b:
            if not np.array_equal(a.read().view(np.uint8), b.read().view(np.uint8)):
                return f"{name} differs"
    return "equal bit by bit"


if __name__ == "__main__":
    main()
