"""Readings of the paper's text, each over all 19 rows of Table II, and how close each comes to the paper.

The readings differ in what the text leaves open or what `paper.yaml` decides otherwise: the plan of the
surface, the places of the control points, the weights, the start, the step that is the result, and (against
the text, which names L1) a squared loss. Nothing is tuned. The means go to docs/results/readings.csv.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.graph.graph import tile_graph
from flexroad.pipeline.report.content import FIGURES
from flexroad.pipeline.reproduce.bootstrap import Means
from flexroad.pipeline.reproduce.published import TABLE_II
from flexroad.pipeline.reproduce.sections import distances_of
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator
from flexroad.tasks import sample
from flexroad.tasks.errors import TaskError
from flexroad.tasks.fit import nurbs
from flexroad.tasks.metrics import evaluate
from flexroad.tasks.spline import adam, objective
from flexroad.tasks.spline.moving import WEIGHTS, MovingNurbs, moving
from flexroad.tasks.spline.space import start_heights, surface_on
from flexroad.tasks.spline.surface import dense

TILES, SEED = 6, 1
RESULTS = Path(__file__).parents[1] / "docs" / "results" / "readings.csv"
LITERAL = {"plan": "moving", "weights": "softplus", "result": "last"}
FREE = {"weights": "softplus", "result": "last"}


@dataclass(frozen=True)
class Reading:
    """Options of the fit that replace those of ablation.yaml."""

    fit: dict[str, Any] = field(default_factory=dict)
    squared: bool = False
    """Whether the loss is squared."""


READINGS = {
    "ours": Reading(),
    "ours, unbounded weights, last step": Reading(FREE),
    "literal": Reading(LITERAL),
    "literal, level start": Reading(LITERAL | {"start": "level"}),
    "literal, uniform points": Reading(LITERAL | {"plan": "uniform"}),
    "literal, uniform points, level start": Reading(LITERAL | {"plan": "uniform", "start": "level"}),
    "literal, uniform points, unit weights": Reading(
        {"plan": "uniform", "weights": "unit", "result": "last"}
    ),
    "literal, squared loss": Reading(LITERAL, squared=True),
}


def main() -> None:
    tiles = int(sys.argv[1]) if len(sys.argv) > 1 else TILES
    with tempfile.TemporaryDirectory() as scratch:
        catalog = Catalog.read(write_scenes(Path(scratch), tiles, SEED, preset="gerod"))
        store = ArtefactStore(Path(scratch) / "store")
        rows = pd.DataFrame(row for tile in catalog.tiles for row in readings_of(tile, store))
    means = means_of(rows)
    means.to_csv(RESULTS, index=False, float_format="%.6g")
    print(f"{tiles} tiles of the benchmark, seed {SEED}; classes by the segmented mask")
    print(table(means))
    print(factors(means).round(2).to_string())


def readings_of(tile, store: ArtefactStore) -> Iterator[dict[str, float | str]]:
    config = load_config("ablation")
    pull = Evaluator(tile_graph(tile, config), store)
    for name, reading in READINGS.items():
        surfaces: dict[str, Any] = {}
        for row in TABLE_II:
            chain, made = config.chains[row.variant], pull.graph.variants[row.variant]
            data, road, clusters = (pull(made[stage]) for stage in ("load", "segment", "ecsrc"))
            if chain["fit"].method == "nurbs":
                options = nurbs.Options.model_validate(chain["fit"].model_dump() | reading.fit)
                key = made["ecsrc"] + options.model_dump_json()
                if key not in surfaces:
                    surfaces[key] = (squared if reading.squared else nurbs.fit)(data, clusters, options)
                surface = surfaces[key]
            else:
                surface = pull(made["fit"])
            yield {"reading": name, "variant": row.variant, "tile_id": tile.id} | figures_of(
                surface, data, road, clusters, chain
            )
        print(tile.id, name, file=sys.stderr, flush=True)


def figures_of(surface, data, road, clusters, chain) -> dict[str, float]:
    folds = folded(surface) if isinstance(surface, MovingNurbs) else 0.0
    try:
        mesh = sample.sample(surface, road, clusters, chain["sample"])
        metrics = evaluate.evaluate(mesh, data, road, surface, chain["evaluate"])
    except TaskError as error:
        print(data.tile_id, error, file=sys.stderr)
        return dict.fromkeys(FIGURES, float("nan")) | {"folded": folds}
    return {figure: float(getattr(metrics, figure)) for figure in FIGURES} | {"folded": folds}


def folded(surface: MovingNurbs) -> float:
    """Return the share of the 1 m squares of (u, v) that are turned over in plan."""
    west, south, east, north = surface.bounds
    places = np.meshgrid(np.arange(west, east + 0.5), np.arange(south, north + 0.5))
    x, y = surface.moved(*places)
    (x_u, y_u), (x_v, y_v) = ([np.diff(part, axis=axis) for part in (x, y)] for axis in (1, 0))
    return float((x_u[:-1] * y_v[:, :-1] - x_v[:, :-1] * y_u[:-1] <= 0).mean())


def squared(data, clusters, options: nurbs.Options) -> MovingNurbs:
    """Fit like `nurbs.fit` with a squared data term; plan moving, weights softplus, last step."""
    space = nurbs.space_of(data, options)
    start, datum = start_heights(data.dsm, data.dtm, clusters.mask, space, options.terrain)
    loss = nurbs.objective_of(data, clusters.mask, space, datum, options)
    m, n = start.shape
    along_u, along_v = dense(loss.start_u, loss.along_u.T, n), dense(loss.start_v, loss.along_v, m)
    weights = WEIGHTS["softplus"]

    def at(variables):
        z, w = variables[0], weights.value(variables[1])
        below = along_v @ w @ along_u.T
        heights = along_v @ (w * z) @ along_u.T / below
        difference = heights - loss.target
        pull = 2 * loss.factor * difference / below
        by_a, by_w = along_v.T @ pull @ along_u, -along_v.T @ (pull * heights) @ along_u
        by_z = by_a * w
        total = (loss.factor * difference**2).sum()
        total += objective.range_term(z, loss.lambda_reg, objective.NEIGHBOURS, by_z)
        return total, np.stack([by_z, (by_a * z + by_w) * weights.slope(variables[1])])

    schedule = adam.Schedule(
        options.learning_rate, options.iterations, options.stop_tolerance, options.stop_window, last=True
    )
    variables = np.stack([start - datum, np.full_like(start, weights.start)])
    (z, s), _ = adam.minimise(at, variables, np.array(np.inf), schedule)
    w = weights.value(s)
    return moving(surface_on(space, data.grid, data.grid.hull, w * z, w, datum))


def means_of(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the means over tiles by reading and variant, in the order of `READINGS`."""
    order = {name: number for number, name in enumerate(READINGS)}
    means = rows.groupby(["reading", "variant"], sort=False).mean(numeric_only=True).reset_index()
    means.insert(2, "tiles", rows.tile_id.nunique())
    return means.sort_values("reading", key=lambda names: names.map(order), kind="stable")


def factors(means: pd.DataFrame) -> pd.DataFrame:
    """Return the typical factor from the paper by row and reading, of the figures and of the changes."""
    columns = {}
    for name, part in means.groupby("reading", sort=False):
        values = part.set_index("variant")[list(FIGURES)].stack().to_dict()
        for kind in ("figures", "changes"):
            distances = distances_of(TABLE_II, Means(values, {}), kind == "changes")
            columns[name, kind] = np.exp([*distances.mean(axis=1), distances.mean()])
    return pd.DataFrame(columns, index=[*(row.label for row in TABLE_II), "all"])


def table(means: pd.DataFrame) -> str:
    """Return the table of causes.md: the full pipeline and w/o ECSRC by reading, and the factors."""
    by_row = factors(means)
    # In these rows all readings are equal: there is no nearest one.
    equal = {"figures": "w/o NURBS", "changes": "Full Pipeline"}
    nearest = {
        kind: by_row.drop(["all", row]).xs(kind, axis=1, level=1).idxmin(axis=1).value_counts()
        for kind, row in equal.items()
    }
    lines = [
        "| reading | road / terrain L2 (m) | road / terrain MAD (°) | w/o ECSRC: road L2 (m) / MAD (°) "
        "| factor, figures | factor, changes | folded |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, part in means.groupby("reading", sort=False):
        rows = part.set_index("variant")
        full, without = rows.loc["flexroad"], rows.loc["wo_ecsrc"]
        of_rows = {
            kind: f"{by_row[name, kind]['all']:.2f} ({nearest[kind].get(name, 0)})" for kind in nearest
        }
        lines.append(
            f"| {name} | {full.l2_road_m:.3f} / {full.l2_terrain_m:.3f} | "
            f"{full.mad_road_deg:.2f} / {full.mad_terrain_deg:.2f} | "
            f"{without.l2_road_m:.3f} / {without.mad_road_deg:.2f} | {of_rows['figures']} | "
            f"{of_rows['changes']} | {full.folded:.1%} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
