"""Cost of one surface over all tiles: load to fit, against independent fits of overlapping tiles.

An independent fit covers the tile and 50 m around it, as much ground as neighbours need to meet within
millimetres. With one surface the tile is fitted alone, and its corners and edges are small fits of their own:
one corner and two edges per tile if tiles share a store, else four of each.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexroad.catalog import Catalog, Tile
from flexroad.catalog.borders import border_of
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.borders import ENDS, BorderStages, BorderTask
from flexroad.pipeline.graph.stages import stage_function
from flexroad.tasks.spline.frame import Frame

TILES = 9
WITH_STORE, WITHOUT = 1.1, 1.8
"""Limits of the cost, as multiples of independent fits."""
HALO_M = 50

Times = defaultdict[str, list[float]]


@contextmanager
def measured(times: Times, name: str) -> Iterator[None]:
    start = time.process_time()
    yield
    times[name].append(time.process_time() - start)


def stages_before_fit(tile: Tile, chain: dict[str, Any]) -> tuple[Any, Any]:
    data = stage_function("load", chain["load"])(tile, chain["load"])
    road = stage_function("segment", chain["segment"])(data, chain["segment"])
    return data, stage_function("ecsrc", chain["ecsrc"])(data, road, chain["ecsrc"])


def process(tile: Tile, chain: dict[str, Any], times: Times) -> None:
    """Process a tile in both ways."""
    fit = stage_function("fit", chain["fit"])
    with measured(times, "before the fit, with halo"):
        data, clusters = stages_before_fit(tile, chain)
    with measured(times, "fit of tile and halo"):
        fit(replace(data, core=data.grid), clusters, chain["fit"])
    stages, parts = BorderStages.of(chain), list[Any]()
    for number, border in enumerate(border_of(tile.grid, stages.reach_m)):
        ends = [parts[end] for end in ENDS[number - 4]] if number >= 4 else []
        with measured(times, "corner" if number < 4 else "edge"):
            parts.append(BorderTask(border, stages)(tile, ends))
    with measured(times, "fit of tile in its frame"):
        fit(data, clusters, chain["fit"], frame=Frame(*parts))


def main() -> None:
    chain = load_config("production").chains["flexroad"]
    assert chain["load"].halo_m == HALO_M
    with tempfile.TemporaryDirectory() as scratch:
        tiles = Catalog.read(write_scenes(Path(scratch), TILES, seed=11)).tiles
        process(tiles[0], chain, defaultdict(list))
        times: Times = defaultdict(list)
        for tile in tiles:
            process(tile, chain, times)
    mean = {name: statistics.mean(seconds) for name, seconds in times.items()}
    print(f"{TILES} synthetic tiles of 250 m, CPU time per part, one thread")
    for name, seconds in mean.items():
        print(f"  {name:28}{1000 * seconds:8.1f} ms")
    before, alone = mean["before the fit, with halo"], mean["fit of tile in its frame"]
    independent = before + mean["fit of tile and halo"]
    too_slow = False
    for name, corners, edges, limit in (("a store", 1, 2, WITH_STORE), ("none", 4, 4, WITHOUT)):
        ratio = (before + alone + corners * mean["corner"] + edges * mean["edge"]) / independent
        too_slow |= ratio > limit
        print(f"  one surface with {name}: {ratio:.2f} times independent fits; the limit is {limit}")
    if too_slow:
        raise SystemExit("one surface costs more than its limit")


if __name__ == "__main__":
    main()
