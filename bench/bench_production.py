"""The production settings against the paper's: on the benchmark and in two real towns.

``PYTHONPATH=. python bench/bench_production.py 240`` gives the table of docs/fit.md; without a number 4 tiles
of the benchmark are used. Stages and options come from configs/paper.yaml and configs/production.yaml, tile
by tile as in a run. Only the benchmark's tiles have no halo, because they have no neighbours.

If FLEXROAD_REAL_DATA is set, Barbican and Gothenburg follow. Their canopies are added to the DSM, and their
DTM is degraded (noise and scars); truth is the original DTM. Intervals are 95% intervals of a bootstrap over
tiles or over squares of `BLOCK_M`.
"""

from __future__ import annotations

import os

os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from bench.towns import ARCHIVES, Town
from flexroad.catalog import Catalog, Tile
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.config.stages import STAGE_NAMES, STAGES
from flexroad.tasks.options import stage_function
from flexroad.tasks.types import Bools, Floats, RoadMask, TileData
from flexroad.tools.synthetic import gerod, make_scene
from flexroad.tools.synthetic.scenes import TRUE_CATALOG, write_scenes
from flexroad.tools.synthetic.spoilers import Kind

TILES, SEED = 4, 1
OVER_M = 2.0
"""A road cell is hidden if the DSM is this much above the true road (m)."""
BLOCK_M = 50
NOISE_M, SCAR_M, SCAR_SHARE_M2 = 0.1, 0.5, 2500
"""Degraded DTM: white noise (m), depth of a scar (m), area per scar (m2)."""
CHAINS = {name: load_config(name).chains["flexroad"] for name in ("paper", "production")}


@dataclass(frozen=True, eq=False)
class Result:
    """Results of one configuration for one tile."""

    data: TileData
    road: RoadMask
    figures: dict[str, float]
    heights: Floats
    """Heights of the surface at the cells of the core, ``(H, W)``, m."""


def run_stages(tile: Tile, name: str, halo: bool = True) -> Result:
    """Run the stages of a configuration on a tile."""
    chain = dict(CHAINS[name])
    if not halo:
        chain["load"] = chain["load"].model_copy(update={"halo_m": 0.0})
    results: dict[str, object] = {}
    for stage in STAGE_NAMES[: STAGE_NAMES.index("evaluate") + 1]:
        inputs = [results[name] for name in STAGES[stage]] or [tile]
        results[stage] = stage_function(stage, chain[stage])(*inputs, chain[stage])
    data, core = results["load"], tile.grid
    surface, metrics = results["fit"], results["evaluate"]
    figures = {
        "road L2 (m)": metrics.l2_road_m,
        "road RMSE (m)": metrics.rmse_road_m,
        "road MAD (deg)": metrics.mad_road_deg,
        "terrain L2 (m)": metrics.l2_terrain_m,
        "T": metrics.triangles,
    }
    return Result(data, results["segment"], figures, surface.lattice(core.eastings, core.northings))


def interval(paper: Floats, production: Floats) -> str:
    """Return mean, interval and number of the paired differences as text."""
    differences = (production - paper)[np.isfinite(production - paper)]
    means = np.random.default_rng(0).choice(differences, (2000, differences.size)).mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    share = np.mean(differences < 0)
    return (
        f"{differences.mean():+.4f} [{low:+.4f}, {high:+.4f}], n = {differences.size}, lower on {share:.0%}"
    )


def show(rows: pd.DataFrame) -> None:
    """Print the mean metrics of each configuration and the intervals of their differences."""
    print(rows.groupby("config", sort=False).mean(numeric_only=True).round(4).to_string())
    paper, production = (rows[rows.config == name].reset_index() for name in CHAINS)
    for figure in rows.columns.drop(["config", "T"]):
        print(f"  {figure}: {interval(paper[figure].to_numpy(), production[figure].to_numpy())}")


def benchmark(tiles: int, scratch: Path) -> None:
    """Compare on synthetic tiles: all road, road below crowns, and road below any high object."""
    catalog = Catalog.read(write_scenes(scratch, tiles, SEED, preset="gerod").with_name(TRUE_CATALOG))
    scenes = {name: place for name, *place in gerod.survey(tiles, SEED)}
    rows, hidden = [], []
    for tile in catalog.tiles:
        grid, stratum, options = scenes[tile.id]
        kind = make_scene(grid, SEED, stratum, options).kind
        for name in CHAINS:
            result = run_stages(tile, name, halo=False)
            errors = np.abs(result.heights - result.data.reference)
            below = {
                "below crowns": result.data.reference_road & (kind == Kind.CROWN),
                "below anything high": result.data.reference_road
                & (result.data.dsm - result.data.reference > OVER_M),
            }
            rows.append({"config": name, **result.figures})
            hidden += [
                {"config": name, "cells": k, "sum": errors[m].sum(), "n": m.sum()} for k, m in below.items()
            ]
    print(f"{tiles} tiles of the benchmark, seed {SEED}")
    show(pd.DataFrame(rows))
    sums = pd.DataFrame(hidden).groupby(["cells", "config"])[["sum", "n"]].sum()
    mean = (sums["sum"] / sums["n"]).unstack()
    print("road L2 (m), mean over cells")
    print(
        mean.assign(ratio=mean["production"] / mean["paper"], n=sums["n"].unstack()["paper"])
        .round(4)
        .to_string()
    )


def town(name: str, data: Path, scratch: Path) -> None:
    """Compare in a real town, cell by cell of its tiles' cores."""
    made = Town.unpacked(name, data, scratch)
    scarred = with_scars(made.dtm, np.random.default_rng(0))
    catalog = made.catalog(made.dsm, scarred, reference=made.patterns["dtm"])
    rows, blocks = [], []
    for tile in catalog.tiles:
        for config in CHAINS:
            result = run_stages(tile, config)
            core = result.data.grid.window(result.data.core)
            errors = np.abs(result.heights - result.data.reference[core])
            road = result.road.mask[core] & np.isfinite(errors)
            rows.append({"config": config, **result.figures})
            blocks += [{"config": config, **b} for b in squares(errors, road, int(BLOCK_M / tile.grid.cell))]
    print(f"\n{name}: {len(catalog.tiles)} tiles; road is all paved ground")
    print(pd.DataFrame(rows).groupby("config", sort=False).mean().round(4).to_string())
    table = pd.DataFrame(blocks)
    paper, production = (table[table.config == c].mean_m.to_numpy() for c in CHAINS)
    print(f"  road L2 by squares of {BLOCK_M} m: {interval(paper, production)}")


def squares(errors: Floats, road: Bools, side: int) -> Iterator[dict[str, float]]:
    """Yield the mean distance on the road of each square with enough road cells."""
    for r in range(0, errors.shape[0], side):
        for c in range(0, errors.shape[1], side):
            here = np.s_[r : r + side, c : c + side]
            if road[here].sum() >= side:
                yield {"mean_m": float(errors[here][road[here]].mean())}


def with_scars(dtm: Floats, rng: np.random.Generator) -> Floats:
    """Return a DTM with noise and with tilted, shifted patches of 8 to 20 m, as left by removed houses."""
    dtm = dtm + NOISE_M * rng.standard_normal(dtm.shape)
    row, col = np.indices(dtm.shape)
    for _ in range(dtm.size // SCAR_SHARE_M2):
        i, j = rng.uniform(0, 1, 2) * dtm.shape
        turn, (length, width) = rng.uniform(0, np.pi), rng.uniform(4, 10, 2)
        u = (col - j) * np.cos(turn) + (row - i) * np.sin(turn)
        v = (row - i) * np.cos(turn) - (col - j) * np.sin(turn)
        off = rng.normal(0, SCAR_M) + rng.normal(0, SCAR_M / 2) * u / length
        dtm += np.where((np.abs(u) < length) & (np.abs(v) < width), off, 0)
    return dtm


def main() -> None:
    tiles = int(sys.argv[1]) if len(sys.argv) > 1 else TILES
    with tempfile.TemporaryDirectory() as made:
        scratch = Path(made)
        if tiles:
            benchmark(tiles, scratch / "made")
        if folder := os.environ.get("FLEXROAD_REAL_DATA"):
            print(f"\nDSM with canopies; DTM with {NOISE_M} m of noise and with scars")
            for name in ARCHIVES:
                town(name, Path(folder), scratch)


if __name__ == "__main__":
    main()
