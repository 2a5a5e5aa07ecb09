"""How much the weights of the loss, which the paper does not give, change rows of Table II.

lambda_reg and lambda_terrain take values from 0.003 to 1 one at a time, on 6 tiles of the benchmark. The
means are written to docs/results/lambdas.csv, and drawn to docs/images/lambdas.webp; with the argument
``draw`` the stored means are drawn.
"""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib import rc_context

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.graph import tile_graph
from flexroad.pipeline.report.pictures import webp
from flexroad.pipeline.reproduce.layout import (
    DPI,
    FLEXROAD,
    PATH,
    PLANE,
    SMALL_PX,
    STYLE,
    TRUTH,
    new_figure,
)
from flexroad.pipeline.reproduce.published import published
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator
from flexroad.tasks import sample
from flexroad.tasks.fit import nurbs
from flexroad.tasks.metrics import evaluate

TILES, SEED = 6, 1
VALUES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
ROWS = {"flexroad": "Full Pipeline", "wo_ecsrc": "w/o ECSRC", "grid_55": "Grid: 55 × 55"}
FIGURES = ("l2_road_m", "l2_terrain_m", "mad_road_deg", "mad_terrain_deg")
COLOURS = {"flexroad": FLEXROAD, "wo_ecsrc": PATH, "grid_55": PLANE}
OURS = {"lambda_reg": 0.01, "lambda_terrain": 1.0}
DOCS = Path(__file__).parents[1] / "docs"
RESULTS, PICTURE = DOCS / "results" / "lambdas.csv", DOCS / "images" / "lambdas.webp"


def main() -> None:
    if sys.argv[1:] == ["draw"]:
        PICTURE.write_bytes(picture(pd.read_csv(RESULTS)))
        return
    with tempfile.TemporaryDirectory() as scratch:
        catalog = Catalog.read(write_scenes(Path(scratch), TILES, SEED, preset="gerod"))
        store = ArtefactStore(Path(scratch) / "store")
        rows = pd.DataFrame(row for tile in catalog.tiles for row in results_of(tile, store))
    means = rows.groupby(["option", "value", "variant"], sort=False).mean(numeric_only=True).reset_index()
    means.insert(3, "tiles", TILES)
    means.to_csv(RESULTS, index=False, float_format="%.6g")
    PICTURE.write_bytes(picture(means))
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
                metrics = evaluate.evaluate(mesh, data, road, surface, chain["evaluate"])
                figures = {figure: getattr(metrics, figure) for figure in FIGURES}
                yield {"option": option, "value": value, "variant": variant} | figures
    print(tile.id, file=sys.stderr, flush=True)


def picture(means: pd.DataFrame) -> bytes:
    """Return a WebP picture of road L2 and road MAD by value; dotted: the paper's figures."""
    with rc_context(STYLE):
        figure = new_figure(3.6)
        panels = figure.subplots(2, len(OURS), sharex="col", sharey="row")
        for row, (column, label) in enumerate(
            (("l2_road_m", "road L2 (m)"), ("mad_road_deg", "road MAD (°)"))
        ):
            panels[row, 0].set_ylabel(label)
            for axes, (option, ours) in zip(panels[row], OURS.items(), strict=True):
                axes.axvline(ours, color=TRUTH, linewidth=0.6)
                for variant, colour in COLOURS.items():
                    part = means[(means.option == option) & (means.variant == variant)].sort_values("value")
                    axes.loglog(
                        part.value, part[column], "o-", color=colour, markersize=3, label=ROWS[variant]
                    )
                    axes.axhline(getattr(published(variant), column), color=colour, ls=":", lw=0.9)
        for axes, option in zip(panels[1], OURS, strict=True):
            axes.set_xlabel(option)
        panels[0, 0].legend()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI)
    return webp(buffer.getvalue(), SMALL_PX)


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
