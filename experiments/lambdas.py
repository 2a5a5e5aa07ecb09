"""How much the weights of the loss, which the paper does not give, change rows of Table II.

lambda_reg and lambda_terrain take values from 0.003 to 1 one at a time, on 6 tiles of the benchmark. The
means are written to docs/results/lambdas.csv.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.graph import tile_graph
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator
from flexroad.tasks import sample
from flexroad.tasks.fit import nurbs
from flexroad.tasks.metrics import evaluate

TILES, SEED = 6, 1
VALUES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
ROWS = {"flexroad": "Full Pipeline", "wo_ecsrc": "w/o ECSRC", "grid_55": "Grid: 55 × 55"}
FIGURES = ("l2_road_m", "l2_terrain_m", "mad_road_deg", "mad_terrain_deg")
RESULTS = Path(__file__).parents[1] / "docs" / "results" / "lambdas.csv"


def main() -> None:
    with tempfile.TemporaryDirectory() as scratch:
        catalog = Catalog.read(write_scenes(Path(scratch), TILES, SEED, preset="gerod"))
        store = ArtefactStore(Path(scratch) / "store")
        rows = pd.DataFrame(row for tile in catalog.tiles for row in results_of(tile, store))
    means = rows.groupby(["option", "value", "variant"], sort=False).mean(numeric_only=True).reset_index()
    means.insert(3, "tiles", TILES)
    means.to_csv(RESULTS, index=False, float_format="%.6g")
    print(table(means))


def results_of(tile, store: ArtefactStore) -> Iterator[dict[str, Any]]:
    config = load_config("ablation")
    pull = Evaluator(tile_graph(tile, config), store)
    for variant in ROWS:
        chain, made = config.chains[variant], pull.graph.variants[variant]
        data, road, clusters = (pull(made[stage]) for stage in ("load", "segment", "ecsrc"))
        for option in ("lambda_reg", "lambda_terrain"):
            for value in VALUES:
                options = nurbs.Options.model_validate(chain["fit"].model_dump() | {option: value})
                surface = nurbs.fit(data, clusters, options)
                mesh = sample.sample(surface, road, clusters, chain["sample"])
                metrics = evaluate.evaluate(mesh, data, road, chain["evaluate"])
                figures = {figure: getattr(metrics, figure) for figure in FIGURES}
                yield {"option": option, "value": value, "variant": variant} | figures
    print(tile.id, file=sys.stderr, flush=True)


def table(means: pd.DataFrame) -> str:
    """Return the table of causes.md: L2 (m) and MAD (degrees) of road and terrain by value."""
    lines = [
        "| weight | row | " + " | ".join(f"{value:g}" for value in VALUES) + " |",
        "| --- | --- |" + " ---: |" * len(VALUES),
    ]
    for (option, variant), part in means.groupby(["option", "variant"], sort=False):
        cells = (
            f"{row.l2_road_m:.3f} / {row.l2_terrain_m:.3f} m, "
            f"{row.mad_road_deg:.2f} / {row.mad_terrain_deg:.2f}°"
            for row in part.sort_values("value").itertuples()
        )
        lines.append(f"| `{option}` | {ROWS[str(variant)]} | {' | '.join(cells)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
