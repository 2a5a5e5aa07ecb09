"""Measure the tables and the plot of docs/results/speed.md and write them into the page: ``make speed``.

All times are CPU time, so other programs on the machine change them little. The page says how each figure is
made; the text around the tables is not changed.

Usage: ``python bench/speed_page.py [--rounds 5] [--tiles 4] [--simulated 10000]``
"""

from __future__ import annotations

import argparse
import re
import statistics
import tempfile
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from bench import bench_points, bench_simulated, bench_tile, measure_stages
from bench.timing import Peak, cpu_s, one_cpu_s, one_thread, peak
from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks import load
from flexroad.tasks.options import stage_function
from flexroad.tools.synthetic.scenes import write_scenes

PAGE = Path(__file__).parents[1] / "docs" / "results" / "speed.md"
PLOT = PAGE.parents[1] / "images" / "speed.webp"
STATE = 550_000
"""Tiles of 250 m of one German state (34,100 km2)."""
CORES = 16
TILE_M = 250
SCANS = (1_000_000, 4_000_000)
"""Points of the two scans whose difference is the time of a point."""
SPACINGS_M = (12.5, 8.0, 5.0, 3.6, 2.5)
"""Distances of control points in the plot."""
NUMBERS = (1, 2, 4, 8)
"""Numbers of tiles in the plot."""


@dataclass(frozen=True)
class Curves:
    """The values of the plot."""

    fit_ms: list[tuple[int, float]]
    """Control points of a tile and CPU time of its fit (ms)."""
    run_ms: list[tuple[int, float]]
    """Tiles of a run and its CPU time (ms)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--simulated", type=int, default=10_000)
    options = parser.parse_args()
    one_thread()
    top = peak()
    rows = bench_tile.table(top, options.rounds, options.tiles)
    bench_tile.show(rows, top)
    with tempfile.TemporaryDirectory(prefix="speed-") as scratch:
        draw(curves(Path(scratch)))
        (Path(scratch) / "simulated").mkdir()
        sent = bench_simulated.simulated(Path(scratch) / "simulated", options.simulated)
        scan = {method: points_ms(Path(scratch), method) for method in bench_points.METHODS}
    parts = {"stages": stages(rows, top, options), "state": state(rows, sent, scan)}
    text = PAGE.read_text()
    for name, part in parts.items():
        text = replaced(text, name, part)
    PAGE.write_text(text)
    print(f"wrote {PAGE} and {PLOT}")


def replaced(text: str, name: str, part: str) -> str:
    """Return the text with a new part between ``<!-- name -->`` and ``<!-- end -->``."""
    pattern = re.compile(rf"(<!-- {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not pattern.search(text):
        raise SystemExit(f"{PAGE} has no place <!-- {name} --> ... <!-- end -->")
    return pattern.sub(lambda match: f"{match[1]}{part}{match[2]}", text)


def stages(rows: list[bench_tile.Row], top: Peak, options: argparse.Namespace) -> str:
    """Return the table of stages as Markdown."""
    lines = [
        f"{date.today()}, {top}; lowest of {options.rounds} rounds, mean of {options.tiles} tiles.\n",
        "| settings | stage | CPU ms | floor ms | bound by | ratio |",
        "|---|---|---:|---:|---|---:|",
    ]
    lines += [
        f"| {row.config} | {row.stage} | {row.ms:.1f} | {row.floor_ms:.2f} | {row.bound} | {row.ratio:.0f} |"
        for row in rows
    ]
    return "\n".join([*lines, ""])


def state(rows: list[bench_tile.Row], sent: dict[str, Any], scan: dict[str, float]) -> str:
    """Return the estimate for a state as Markdown: sums of measured parts.

    - `scan`: CPU time of `points_ms` by ground method.
    """
    tile_ms = next(row.ms for row in rows if (row.config, row.stage) == ("production", "tile of a mosaic"))
    worker_ms, client_ms = (1000 * sent["per_tile"][name] for name in ("worker_s", "client_s"))
    parts = {
        "tile of a mosaic, load to exported files": tile_ms,
        "worker, per task": worker_ms,
        "client and scheduler, per tile": client_ms,
    }
    total_ms = sum(parts.values())
    points = {f"points to rasters, ground by {method}": ms for method, ms in scan.items()}
    lines = ["| part | CPU ms a tile | core hours for the state |", "|---|---:|---:|"]
    lines += [f"| {name} | {ms:.1f} | {hours(ms):.1f} |" for name, ms in parts.items()]
    lines += [
        f"| **one core, from rasters to meshes** | {total_ms:.1f} | **{hours(total_ms):.0f} h** |",
        f"| **a node of {CORES} cores**: one core, divided | | **{hours(total_ms) / CORES:.1f} h** |",
    ]
    lines += [f"| {name} | {ms:.1f} | {hours(ms):.1f} |" for name, ms in points.items()]
    lines += [
        f"| **one core, from points ({method}) to meshes** | {total_ms + ms:.1f} "
        f"| **{hours(total_ms + ms):.0f} h** |"
        for method, ms in scan.items()
    ]
    return "\n".join([*lines, ""])


def points_ms(folder: Path, method: str) -> float:
    """Return the CPU time from points to rasters of one tile's ground (ms), without the start of the command.

    It is the difference of two synthetic scans of different size: a state is made in a few large commands.
    """
    costs = []
    for n in SCANS:
        file = bench_points.synthetic(folder / "scan.laz", n)
        costs.append(min(bench_points.prepare(file, folder / "out", method).cpu_s for _ in range(2)))
    return 1000 * (costs[1] - costs[0]) / (SCANS[1] - SCANS[0]) * bench_points.PER_M2 * TILE_M**2


def hours(ms: float) -> float:
    """Return the hours for all tiles of the state at some time per tile."""
    return ms * STATE / 3_600_000


def curves(folder: Path) -> Curves:
    """Measure the fit of one tile by control points, and runs by tiles; all in this process."""
    config = load_config("production")
    catalog = Catalog.read(write_scenes(folder / "survey", max(NUMBERS), seed=bench_tile.SEED))
    chain = config.chains["flexroad"]
    data = load.load(catalog.tiles[0], chain["load"])
    road = stage_function("segment", chain["segment"])(data, chain["segment"])
    clusters = stage_function("ecsrc", chain["ecsrc"])(data, road, chain["ecsrc"])
    fit = stage_function("fit", chain["fit"])
    fits = []
    for spacing_m in SPACINGS_M:
        options = chain["fit"].model_copy(update={"spacing_m": spacing_m})
        points = fit(data, clusters, options).A.size
        fits.append((points, 1000 * cpu_s(lambda options=options: fit(data, clusters, options), 3)))
    alone = measure_stages.one_variant("production")
    return Curves(fits, [(n, 1000 * run_s(folder, alone, catalog, n)) for n in NUMBERS])


def run_s(folder: Path, config: Any, catalog: Catalog, tiles: int) -> float:
    """Return the CPU time of a complete run of some tiles, without the start of Python (s): lowest of two."""
    part = Catalog(catalog.tiles[:tiles])

    def one(name: str) -> float:
        run = Run.create(folder / name, config, part)
        return one_cpu_s(lambda: run_tiles(run, SerialExecutor()))

    return min(one(f"run-{tiles}-{number}") for number in range(2))


def draw(measured: Curves) -> None:
    """Draw cost against control points and against tiles."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.7), layout="constrained")
    for axes, points in ((left, measured.fit_ms), (right, measured.run_ms)):
        x, y = zip(*points, strict=True)
        axes.plot(x, y, "o-", color="#22577a", markersize=4)
        axes.set(ylim=(0, None), xlim=(0, None), ylabel="CPU ms, one thread")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
    left.set(xlabel="control points of a tile", title="Fit of one tile of 250 m")
    each = statistics.mean(ms / n for n, ms in measured.run_ms[-2:])
    right.set(xlabel="tiles", title=f"Whole run, about {each:.0f} ms a tile")
    PLOT.parent.mkdir(exist_ok=True)
    figure.savefig(PLOT, dpi=110, pil_kwargs={"quality": 80})


if __name__ == "__main__":
    main()
