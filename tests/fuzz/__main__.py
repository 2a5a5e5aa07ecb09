"""Fuzz all targets for some time each: ``python -m tests.fuzz --seconds 60``."""

import argparse
import concurrent.futures
import functools
import importlib
import os
import pkgutil
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.fuzz import targets
from tests.fuzz.damage import beside, damage, damage_text
from tests.fuzz.reader import Reader, Result
from tests.fuzz.watch import Outside, outside

NAMES = tuple(sorted(module.name for module in pkgutil.iter_modules(targets.__path__)))
KEPT = 20
"""Most files with a fault that are kept for one target."""


@dataclass(frozen=True)
class Outcome:
    """What came of the files of one target."""

    target: str
    counts: Counter[str]
    faults: tuple[str, ...]


def fuzz(target: str, seconds: float, seed: int, keep: Path) -> Outcome:
    """Damage and read files for some time."""
    module = importlib.import_module(f"tests.fuzz.targets.{target}")
    rng = np.random.default_rng([seed, *target.encode()])
    counts: Counter[str] = Counter()
    faults: list[str] = []
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name, outside(Path(name, "outside")) as watched:
        folder = Path(name, "made")
        folder.mkdir()
        seeds = module.make(folder)
        copy = getattr(module, "copy", beside)
        change = getattr(module, "change", lambda path, data, rng: b"")
        with Reader(module.__name__, "read") as reader:
            # The valid files first: they start the process, and must not give a fault.
            for path in seeds:
                first = reader.read(copy(path, Path(name, "valid")))
                shutil.rmtree(Path(name, "valid"))
                assert not first.fault, first
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                path = copy(seeds[rng.integers(len(seeds))], Path(name, f"copy-{counts.total()}"))
                path.write_bytes(
                    change(path, path.read_bytes(), rng) or _damaged(path.read_bytes(), rng, watched)
                )
                result = reader.read(path)
                fault = result.fault or watched.touched()
                counts["fault" if fault else "read" if result.was_read else "refused"] += 1
                if fault:
                    faults.append(_kept(fault, result, keep / target, len(faults)))
                shutil.rmtree(path.parents[len(path.relative_to(name).parts) - 2])
    return Outcome(target, counts, tuple(faults))


def _damaged(data: bytes, rng: np.random.Generator, watched: Outside) -> bytes:
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return damage(data, rng)
    return damage(data, rng) if rng.random() < 0.2 else damage_text(text, rng, watched.names)


def _kept(fault: str, result: Result, folder: Path, number: int) -> str:
    if number < KEPT:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(result.path, folder / f"{number}-{result.path.name}")
    return f"{folder / f'{number}-{result.path.name}'}: {fault}"


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[[], *NAMES], help="default: all")
    parser.add_argument("--seconds", type=float, default=60, help="for each target")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--jobs", type=int, default=2, help="targets at the same time")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="folder for files with a fault")
    options = parser.parse_args(arguments)
    run = functools.partial(fuzz, seconds=options.seconds, seed=options.seed, keep=options.keep)
    sys.stdout.write(
        f"seed {options.seed}\n{'target':<10}{'files':>8}{'read':>8}{'refused':>9}{'faults':>8}\n"
    )
    faults: list[str] = []
    with concurrent.futures.ProcessPoolExecutor(options.jobs) as pool:
        for done in pool.map(run, options.targets or NAMES):
            counts = done.counts
            columns = counts.total(), counts["read"], counts["refused"], counts["fault"]
            sys.stdout.write("{:<10}{:>8}{:>8}{:>9}{:>8}\n".format(done.target, *columns))
            sys.stdout.flush()
            faults += done.faults
    sys.stdout.writelines(f"{fault}\n" for fault in faults)
    return int(bool(faults))


if __name__ == "__main__":
    os.environ.setdefault("GDAL_HTTP_MAX_RETRY", "0")
    sys.exit(main(sys.argv[1:]))
