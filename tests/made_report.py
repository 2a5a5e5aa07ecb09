"""Runs and contents of reports with invented figures, without computing a tile."""

import dataclasses

import numpy as np
import pandas as pd

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.tables import metrics_frame
from flexroad.tools.report.content import (
    MAIN,
    MESH_COLUMNS,
    MESHES,
    STEPS,
    WORST_ESTIMATES,
    WORST_ROADS,
    Content,
)
from flexroad.tools.report.steps import CHECK
from tests.builders import make_grid

SIDE_M = 250
FURTHER = "off_dtm_m residual_median_m measured_road dtm_road completeness max_unexplained_area_m2".split()
"""Figures of a row that have any value."""


def made_run(folder, survey, ids, columns=None) -> Run:
    """Return a run of tiles with these ids, row by row from the south-west; none is computed."""
    tile = Catalog.read(survey).tiles[0]
    columns = columns or max(1, round(len(ids) ** 0.5))
    tiles = []
    for i, name in enumerate(ids):
        west, north = 588_000.0 + SIDE_M * (i % columns), 5_519_000.0 + SIDE_M * (1 + i // columns)
        grid = make_grid(SIDE_M, SIDE_M, west=west, north=north)
        tiles.append(dataclasses.replace(tile, id=name, grid=grid))
    return Run.create(folder, load_config("production"), Catalog(tuple(tiles)))


def made_row(name, estimate, flags="", **more):
    """Return the row of a done tile."""
    return {
        "tile_id": name,
        "variant": "flexroad",
        "method": "smoothing_spline",
        "stratum": "urban",
        "status": "done",
        "error_estimate_m": estimate,
        "l2_road_m": estimate / 2,
        "mad_road_deg": 10 * estimate,
        "curvature_per_m": 0.31,
        "triangles": 20_000,
        "seconds": 0.5,
        "flags": flags,
    } | more


def failed_row(name, error):
    return {"tile_id": name, "variant": "flexroad", "status": "failed", "error": error}


def made_content(run, rows, states=None) -> Content:
    """Return the content of a report on these rows; tiles without a row are pending."""
    frame = metrics_frame(rows)
    by_row = {row["tile_id"]: row["status"] for row in rows}
    states = {tile.id: by_row.get(tile.id, "pending") for tile in run.catalog.tiles} | (states or {})
    number = list(states.values()).count
    done = frame[frame.status == "done"]
    return Content(
        title=f"FlexRoad: invented over {len(states)} tiles",
        state="",
        counts=Summary(
            len(states),
            number("done"),
            number("failed"),
            0,
            number("pending"),
            without_roads=int(done["flags"].str.contains("no-road").sum()),
        ),
        states=states,
        rows=frame,
        variant="flexroad",
        reference="Made figures.",
        tables={
            MAIN: (
                pd.DataFrame(
                    {"method": ["flexroad"], "tiles": [len(done)], "L2 road (m)": [done.l2_road_m.mean()]}
                ),
                "",
            ),
            WORST_ROADS: (pd.DataFrame({"tile": done.nlargest(10, "l2_road_m").tile_id}), ""),
            WORST_ESTIMATES: (pd.DataFrame({"tile": done.nlargest(10, "error_estimate_m").tile_id}), ""),
            MESHES: (pd.DataFrame(columns=MESH_COLUMNS), ""),
            STEPS: (pd.DataFrame(columns=CHECK), ""),
            "Failures": (
                pd.DataFrame(
                    [(row["tile_id"], row["error"]) for row in rows if row["status"] == "failed"],
                    columns=["tile", "error"],
                ),
                "",
            ),
        },
        versions={"flexroad": "0"},
        config="made: true\n",
        tiles=tuple(done.tile_id),
    )


def many_rows(ids, seed=0):
    """Return rows with invented figures: some tiles flagged, some failed, every figure filled in."""
    rng = np.random.default_rng(seed)
    for i, name in enumerate(ids):
        if i % 97 == 5:
            yield failed_row(name, f"load: TaskError: dsm dsm/{name}.tif is missing; restore it")
            continue
        estimate = float(rng.gamma(2.0, 0.02))
        flags = "error-estimate, spike" if estimate > 0.12 else "no-road" if i % 61 == 7 else ""
        further = zip(FURTHER, rng.normal(0, 1, len(FURTHER)).tolist(), strict=True)
        yield made_row(name, estimate, flags, **dict(further))
