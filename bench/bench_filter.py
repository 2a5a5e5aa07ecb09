"""The table of docs/filter.md: the share of each kind of road cell that a filter keeps, and the road error.

24 tiles of the benchmark with a halo of 50 m; the core is scored. With FLEXROAD_REAL_DATA, two real
towns follow; canopies are added to their DSM, and road is all paved ground. A cell is sound if the DSM shows
the ground, with noise, or is within `SOUND_M` of the truth.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from bench.towns import ARCHIVES, PAVED, Town
from flexroad.catalog import Grid
from flexroad.tasks import sample
from flexroad.tasks.filter import ecsrc, planar
from flexroad.tasks.fit import nurbs
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.types import Bools, RoadClusters, RoadMask, TileData
from flexroad.tools.synthetic import gerod, make_scene
from flexroad.tools.synthetic.spoilers import BARE, Kind

TILES, SEED, HALO_M = 24, 1, 50
SOUND_M = 0.15
SPOILERS = {
    "parked cars": Kind.PARKED_CAR,
    "moving cars": Kind.MOVING_CAR,
    "crowns": Kind.CROWN,
    "roofs": Kind.BUILDING,
    "plants": Kind.PLANTS,
}

Filter = Callable[[TileData, RoadMask], RoadClusters]
FILTERS: dict[str, Filter] = {
    "off": lambda data, road: ecsrc.ecsrc(data, road, ecsrc.Options(method="off")),
    "paper": lambda data, road: ecsrc.ecsrc(data, road, ecsrc.Options(keep_largest=None)),
    "planar": lambda data, road: planar.ecsrc(data, road, planar.Options()),
}


@dataclass(frozen=True, eq=False)
class Case:
    """A tile with its road mask and the true kind of each cell."""

    data: TileData
    road: RoadMask
    kind: np.ndarray


def main() -> None:
    cases = [benchmark(*place) for place in gerod.survey(TILES, SEED)]
    print(f"{TILES} tiles of the benchmark, seed {SEED}; cells kept (%)")
    show(cases)
    if folder := os.environ.get("FLEXROAD_REAL_DATA"):
        for name in ARCHIVES:
            print(f"\n{name}: DSM and canopies; truth is the DTM")
            show([town(name, Path(folder))])


def show(cases: list[Case]) -> None:
    rows = {}
    for name, function in FILTERS.items():
        found = [(case, function(case.data, case.road)) for case in cases]
        counts = sum(counted(case, clusters.mask) for case, clusters in found)
        rows[name] = 100 * counts["kept"] / counts["all"]
        rows[name]["road L2 (m)"] = np.mean([road_l2(case, clusters) for case, clusters in found])
    print(pd.DataFrame(rows).T.dropna(axis=1).round(3).to_string(), flush=True)


def counted(case: Case, kept: Bools) -> pd.DataFrame:
    """Return the numbers of kept and of all cells by kind; precision is the share of sound kept cells."""
    data, core = case.data, case.data.grid.window(case.data.core)
    off = np.abs(data.dsm - data.reference)
    points = case.road.mask & np.isfinite(data.dsm)
    sound = points & (np.isin(case.kind, BARE) | (off <= SOUND_M))
    kinds = {name: points & (case.kind == kind) & (off > SOUND_M) for name, kind in SPOILERS.items()}
    pairs = {"precision": (kept & sound, kept), "recall": (kept & sound, sound)}
    for name, cells in {"decks": points & (case.kind == Kind.DECK), **kinds}.items():
        pairs[name] = kept & cells, cells
    table = {name: [cells[core].sum() for cells in pair] for name, pair in pairs.items()}
    return pd.DataFrame(table, index=["kept", "all"]).T


def road_l2(case: Case, clusters: RoadClusters) -> float:
    """Return the road error of the paper's fit (m)."""
    surface = nurbs.fit(case.data, clusters, nurbs.Options(spacing_m=7.3))
    mesh = sample.sample(surface, case.road, clusters, sample.Options())
    return evaluate.evaluate(mesh, case.data, case.road, surface, evaluate.Options()).l2_road_m


def benchmark(tile_id: str, core: Grid, stratum: str, options: gerod.Options) -> Case:
    grid = core.buffered(HALO_M)
    scene = make_scene(grid, SEED, stratum, options)
    mask, truth = scene.road_mask, scene.reference
    data = TileData(tile_id, grid, core, scene.dsm, scene.dtm, mask, truth, scene.reference_road)
    return Case(data, RoadMask(grid, core, mask, np.zeros_like(mask)), scene.kind)


def town(name: str, data: Path) -> Case:
    with tempfile.TemporaryDirectory() as scratch:
        made = Town.unpacked(name, data, Path(scratch))
    grid = Grid("EPSG:25832", 0.0, float(made.dtm.shape[0]), 1.0, made.dtm.shape[1], made.dtm.shape[0])
    high = np.where(made.dsm - made.dtm > SOUND_M, Kind.BUILDING, Kind.GROUND)
    kind = np.where(made.covered, Kind.CROWN, high)
    mask = (made.cover == PAVED) & np.isfinite(made.dsm) & np.isfinite(made.dtm)
    tile = TileData(name, grid, grid, made.dsm, made.dtm, mask, made.dtm)
    return Case(tile, RoadMask(grid, grid, mask, ~np.isfinite(made.dtm)), kind)


if __name__ == "__main__":
    main()
