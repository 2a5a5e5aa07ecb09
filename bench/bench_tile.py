"""The stages of a tile, load to exported files, beside their floors: production's and the paper's settings.

CPU ms of one thread: the lowest of some rounds, mean of tiles from urban to rural. The floors are formulas of
`floors.py`, over the highest rate of one core in the same run. A tile alone computes its four corners and
four edges; in a mosaic, where neighbours share them, it pays for one corner and two edges.

Usage: ``python bench/bench_tile.py [--rounds 5] [--tiles 4] [--json FILE]``
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench import floors, measure_stages
from bench.floors import Work
from bench.timing import Peak, one_thread, peak
from flexroad.catalog import Catalog, Tile
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.graph.borders import STAGE as BORDER
from flexroad.pipeline.graph.graph import Node, TileGraph
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator
from flexroad.tasks.load import load_border
from flexroad.tools.synthetic.scenes import write_scenes

CONFIGS = ("production", "paper")
SEED = 11
SHARES = {"corners": 1 / 4, "edges": 2 / 4}
"""Part of a tile's four corners and four edges that it pays for in a mosaic."""


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    config: str
    stage: str
    ms: float
    floor_ms: float
    bound: str

    @property
    def ratio(self) -> float:
        """CPU time over the floor."""
        return self.ms / self.floor_ms


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--tiles", type=int, default=4)
    parser.add_argument("--json", type=Path, help="write the rows to this file, too")
    options = parser.parse_args()
    one_thread()
    top = peak()
    rows = table(top, options.rounds, options.tiles)
    show(rows, top)
    if options.json:
        options.json.write_text(json.dumps({"peak": asdict(top), "rows": [asdict(row) for row in rows]}))


def table(top: Peak, rounds: int, tiles: int) -> list[Row]:
    """Return the rows of both configurations, each with the sums for a tile alone and in a mosaic."""
    measure_stages.by_cpu_time()
    rows = []
    with tempfile.TemporaryDirectory(prefix="bench-") as scratch:
        catalog = Catalog.read(write_scenes(Path(scratch) / "survey", tiles, seed=SEED))
        for name in CONFIGS:
            config = measure_stages.one_variant(name)
            stages = rows_of(name, config, catalog.tiles, rounds, Path(scratch) / name, top)
            rows += [*stages, total(name, "tile alone", stages, top, {})]
            if any(row.stage in SHARES for row in stages):
                rows.append(total(name, "tile of a mosaic", stages, top, SHARES))
    return rows


def rows_of(
    name: str, config: Config, tiles: tuple[Tile, ...], rounds: int, folder: Path, top: Peak
) -> list[Row]:
    lowest: defaultdict[str, list[float]] = defaultdict(list)
    works: defaultdict[str, list[Work]] = defaultdict(list)
    for tile in tiles:
        catalog = Catalog((tile,))
        # The first round of the first tile compiles code, or loads compiled code.
        measured = [
            measure_stages.measure(folder / tile.id / str(number), config, catalog)
            for number in range(rounds + 1)
        ][1:]
        for stage in measured[0]["seconds"]:
            lowest[stage].append(min(one["seconds"][stage] for one in measured))
        for stage, work in works_of(Run.open(folder / tile.id / "0", [tile.root]), measured[0]).items():
            works[stage].append(work)
    return [
        Row(
            name,
            stage,
            1000 * statistics.mean(seconds),
            1000 * statistics.mean(work.seconds(top) for work in works[stage]),
            works[stage][0].bound(top),
        )
        for stage, seconds in lowest.items()
    ]


def works_of(run: Run, measured: dict[str, Any]) -> dict[str, Work]:
    """Return the least work of each stage of a run's tile; computes the tile once more to count."""
    graph = run.graph(run.catalog.tiles[0])
    evaluator = Evaluator(graph, ArtefactStore(run.path / "empty"))
    works: defaultdict[str, Work] = defaultdict(Work)
    fits: dict[str, list[floors.FitSize]] = {}
    for fingerprint, node in graph.nodes.items():
        # Its inputs come before it, so that only its own fits are counted.
        with floors.counted_fits() as fits[fingerprint]:
            evaluator(fingerprint)
        if node.stage == BORDER:
            name = "edges" if node.inputs else "corners"
            works[name] += border_work(graph, node, fits[fingerprint])
    chain = {node.stage: evaluator(node.fingerprint) for node in graph.chain(measure_stages.VARIANT)}
    data, road, clusters, mesh = (chain[stage] for stage in ("load", "segment", "ecsrc", "sample"))
    control = chain["fit"].A.shape
    files = sum(measured["products"].values())
    works["load"] = floors.load(data)
    works["segment"] = floors.segment(road)
    works["ecsrc"] = floors.ecsrc(data, road, clusters)
    works["fit"] = sum(map(floors.fit, fits[graph.variants[measure_stages.VARIANT]["fit"]]), Work())
    works["sample"] = floors.sample(mesh)
    works["evaluate"] = floors.evaluate(mesh, data)
    works["assess"] = floors.assess(data, control)
    works["export"] = floors.export(mesh, data, files, control)
    works["rest"] = floors.rest(measured["stored"])
    return works


def border_work(graph: TileGraph, node: Node, fits: list[floors.FitSize]) -> Work:
    """Return the least work of a corner or edge: its ground loaded, segmented, filtered and fitted."""
    assert node.border
    data = load_border(node.border.ground(graph.around), graph.tile.grid, node.border.stages.load)
    cells = data.dsm.size
    # A mask read and written; DSM, DTM and mask read, labels written.
    masked = Work(0, 2 * cells) + Work(floors.PATCH * cells, (8 + 8 + 1 + 4) * cells)
    return sum(map(floors.fit, fits), floors.load(data) + masked)


def total(name: str, stage: str, rows: list[Row], top: Peak, shares: dict[str, float]) -> Row:
    ms, floor_ms = (
        sum(getattr(row, column) * shares.get(row.stage, 1.0) for row in rows)
        for column in ("ms", "floor_ms")
    )
    return Row(name, stage, ms, floor_ms, "")


def show(rows: list[Row], top: Peak) -> None:
    print(top)
    print(f"{'':10}{'stage':18}{'CPU ms':>9}{'floor ms':>10}  {'bound by':9}{'ratio':>7}")
    for row in rows:
        print(
            f"{row.config:10}{row.stage:18}{row.ms:9.2f}{row.floor_ms:10.3f}  {row.bound:9}{row.ratio:7.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
