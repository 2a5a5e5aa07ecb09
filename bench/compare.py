"""CPU time per stage of this checkout against another one, measured in turn: A B A B.

Each checkout runs `measure_stages.py` with its own interpreter, ``.venv/bin/python``, in one process per
configuration. Both process the same tiles, one after the other, so that a slower machine affects both. The
lowest time of all rounds is used for each stage of each tile; the table has means over tiles. A tile is alone
in its store: it computes its four corners and four edges itself. Heights and rows of both are compared.

Usage: ``python bench/compare.py OTHER_CHECKOUT [--rounds 5] [--tiles 4] [--configs production paper]``
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

from flexroad.pipeline import ONE_THREAD
from flexroad.tools.synthetic.scenes import write_scenes

HERE = Path(__file__).parents[1]
SCRIPT = Path(__file__).with_name("measure_stages.py")
CONFIGS = ("production", "paper")
SEED = 11
ROW = ("l2_road_m", "l2_terrain_m", "mad_road_deg", "mad_terrain_deg", "triangles", "error_estimate_m")
"""Columns of a row that are compared."""
ALLOWED_M = 1e-3
"""Largest change of a height (m) that a faster stage may cause."""


def main() -> None:
    options = arguments()
    with tempfile.TemporaryDirectory(prefix="compare-") as scratch:
        folder = Path(scratch)
        catalog = write_scenes(folder / "survey", options.tiles, seed=SEED)
        checkouts = {"other": options.other.resolve(), "this": HERE}
        for config in options.configs:
            rounds = measured(checkouts, catalog, config, options.rounds, folder)
            print_table(config, rounds)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("other", type=Path, help="folder of the other checkout, with its .venv")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds of each checkout")
    parser.add_argument("--tiles", type=int, default=4, help="tiles of 250 m, urban to rural")
    parser.add_argument("--configs", nargs="+", default=CONFIGS, help="configurations to measure")
    return parser.parse_args()


def measured(
    checkouts: dict[str, Path], catalog: Path, config: str, rounds: int, folder: Path
) -> dict[str, list[Any]]:
    """Return the rounds of each checkout: lists of tiles as `measure_stages.measure` returns them."""
    results: dict[str, list[Any]] = {name: [] for name in checkouts}
    with contextlib.ExitStack() as stack:
        processes = {
            name: stack.enter_context(started(root, catalog, config, folder / f"{config}-{name}"))
            for name, root in checkouts.items()
        }
        # The first round compiles code, or loads compiled code; it is not counted.
        for number in range(rounds + 1):
            for name, process in processes.items():
                tiles = one_round(process)
                if number:
                    results[name].append(tiles)
        for name in checkouts:
            for tile in results[name][-1]:
                tile["heights"] = heights(tile["height"])
    return results


@contextlib.contextmanager
def started(root: Path, catalog: Path, config: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start the measuring process of a checkout in an empty folder, and end it with the block."""
    python = root / ".venv" / "bin" / "python"
    folder.mkdir()
    # PYTHONPATH is removed: it might name this checkout, but the other checkout must be imported.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | ONE_THREAD
    words = [str(python if python.exists() else sys.executable), str(SCRIPT), str(catalog), config]
    with subprocess.Popen(
        [*words, str(folder / "runs")],
        cwd=folder,
        env=environment,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def one_round(process: subprocess.Popen[str]) -> list[dict[str, Any]]:
    assert process.stdin
    assert process.stdout
    print("go", file=process.stdin, flush=True)
    line = process.stdout.readline()
    if not line:
        raise SystemExit("a measuring process ended early; its error is above")
    tiles: list[dict[str, Any]] = json.loads(line)["tiles"]
    return tiles


def heights(path: str) -> Any:
    """Return the heights of an exported raster (m), None if the tile has none."""
    if not path:
        return None
    with rasterio.open(path) as raster:
        return raster.read(1, masked=True).filled(np.nan)


def lowest(rounds: list[Any]) -> dict[str, float]:
    """Return the CPU time of each stage and of the tile: lowest of all rounds, mean over tiles (ms)."""
    stages = dict.fromkeys(stage for tiles in rounds for tile in tiles for stage in tile["seconds"])
    times = {
        stage: [min(tiles[i]["seconds"].get(stage, 0.0) for tiles in rounds) for i in range(len(rounds[0]))]
        for stage in stages
    }
    times["tile"] = [min(tiles[i]["total"] for tiles in rounds) for i in range(len(rounds[0]))]
    return {stage: 1000 * statistics.mean(seconds) for stage, seconds in times.items()}


def print_table(config: str, rounds: dict[str, list[Any]]) -> None:
    other, this = lowest(rounds["other"]), lowest(rounds["this"])
    number, tiles = len(rounds["this"]), len(rounds["this"][0])
    print(f"\n{config}: CPU ms, lowest of {number} rounds in turn, mean of {tiles} tiles, one thread")
    print(f"  {'stage':12}{'other':>10}{'this':>10}{'this/other':>12}")
    for stage in dict.fromkeys((*other, *this)):
        # The sum of the lowest times of the stages may be a little lower than the lowest of the tile.
        before, after = other.get(stage, 0.0), this.get(stage, 0.0)
        ratio = f"{after / before:12.3f}" if before else f"{'new':>12}"
        print(f"  {stage:12}{before:10.2f}{after:10.2f}{ratio}")
    peaks = {name: max(tile["peak_mb"] for tiles in part for tile in tiles) for name, part in rounds.items()}
    print(
        f"  {'peak MB':12}{peaks['other']:10.0f}{peaks['this']:10.0f}{peaks['this'] / peaks['other']:12.3f}"
    )
    print_results(rounds["other"][-1], rounds["this"][-1])


def print_results(other: list[Any], this: list[Any]) -> None:
    """Print how the results of the last rounds differ."""
    for name in ROW:
        before, after = (
            statistics.mean(tile["row"].get(name, np.nan) for tile in part) for part in (other, this)
        )
        print(f"  {name:18}{before:12.5f} -> {after:.5f}")
    size = [sum(sum(tile["products"].values()) for tile in part) / len(part) / 1e3 for part in (other, this)]
    print(f"  {'products, KB':18}{size[0]:12.0f} -> {size[1]:.0f}")
    pairs = [(a["heights"], b["heights"]) for a, b in zip(other, this, strict=True)]
    largest = [float(np.nanmax(np.abs(a - b))) for a, b in pairs if a is not None and b is not None]
    voids = sum(int((np.isnan(a) != np.isnan(b)).sum()) for a, b in pairs if a is not None and b is not None)
    verdict = "within 1 mm" if max(largest, default=0) <= ALLOWED_M and not voids else "MORE THAN 1 mm"
    print(
        f"  heights differ by at most {1000 * max(largest, default=0):.4f} mm in any cell: {verdict}"
        + (f"; {voids} cells have a height in one alone" if voids else "")
    )


if __name__ == "__main__":
    main()
