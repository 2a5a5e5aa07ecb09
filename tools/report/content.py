"""The content of a report: tables computed from a run's rows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
import yaml

from flexroad.catalog.storage.paths import exists
from flexroad.catalog.text import count
from flexroad.pipeline.run.lock import exit_reason, owner
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import TileStatus, Track, open_database, recorded, summary, untracked
from flexroad.pipeline.run.summary import Summary
from flexroad.pipeline.store.records import TileState, needs_look
from flexroad.pipeline.store.tables import METRICS, level_rows, metrics_frame, read_metrics
from flexroad.tasks.errors import MeshFault
from flexroad.tools.report.steps import Results, add_results, edge_steps

MAIN = "Mean over tiles"
WORST_ROADS = "Worst tiles by road L2"
WORST_ESTIMATES = "Worst tiles by error estimate, without ground truth"
HELD_OUT = "Error estimates at withheld squares"
MESHES = "Meshes"
STEPS = "Steps between neighbouring tiles"
LARGEST_STEPS = "Largest steps between neighbouring tiles"
"""Titles of tables."""
FIGURES = {
    "l2_road_m": "L2 road (m)",
    "l2_terrain_m": "L2 terrain (m)",
    "mad_road_deg": "MAD road (°)",
    "mad_terrain_deg": "MAD terrain (°)",
    "triangles": "T",
}
"""The columns of the paper's Table I."""
FURTHER = {
    "rmse_road_m": "RMSE road (m)",
    "rmse_terrain_m": "RMSE terrain (m)",
    "nmad_road_m": "NMAD road (m)",
    "p95_road_m": "p95 road (m)",
    "mesh_p95_road_m": "mesh distance road p95 (m)",
    "mesh_p95_terrain_m": "mesh distance terrain p95 (m)",
    "completeness": "completeness",
    "seconds": "seconds",
}
"""Further columns."""
WITH_ROADS = "with roads"
"""Column with the number of tiles with figures of roads; left out if all tiles have them."""
WORST = 10
"""Rows in the tables of the worst tiles."""
MESH_COLUMNS = ["method", "meshes", "faces", "meshes with faults", "result"]
MESH_MEANING = (
    "A mesh has no fault if all numbers are finite, all faces have an area and look up, no faces overlap in "
    "plan, edges meet at vertices only, and no vertex is unused or there twice. A tile that has a mesh with "
    "faults is failed; only faces of the other meshes are counted."
)
FAULT = f"evaluate: {MeshFault.__name__}: "
"""Start of the error of a row whose mesh has a fault."""
ESTIMATES = {
    "error_estimate_m": "error estimate (m)",
    "worst_error_estimate_m": "of its worst 25 m² (m)",
    "max_unexplained_area_m2": "largest unexplained patch (m²)",
    "residual_p95_m": "p95 to its road points (m)",
    "curvature_per_m": "curvature (1/m)",
    "edge_step_m": "edge step (m)",
    "off_dtm_road": "off the DTM (%)",
    "dropped_road": "dropped (%)",
    "bounded_weights": "weights at bounds (%)",
}
HEIGHT_SOURCE = {"measured_road": "measured (%)", "dtm_road": "DTM (%)", "inferred_road": "inferred (%)"}
"""Shares of the road by the height source of the surface."""
ESTIMATE_MEANING = (
    "The error estimate follows from what the surface leaves of the heights that it was fitted to, around "
    "each cell of the raw road mask, and from the scatter of the DSM that the filter kept. It estimates the "
    "road L2; errors common to DSM and DTM are not detected. Flags are set by the thresholds of `assess`; "
    "docs/quality.md explains each flag."
)
DECKS = {
    "tile_id": "tile",
    "level": "level",
    "area_m2": "area (m²)",
    "abutments": "abutments",
    "clearance_m": "clearance (m)",
    "error_estimate_m": ESTIMATES["error_estimate_m"],
    "measured_road": HEIGHT_SOURCE["measured_road"],
    "flags": "flags",
}
"""Columns of the table of decks and tunnels."""
DECKS_MEANING = (
    "Levels above 0 are decks, levels below 0 tunnels. Abutments are ends where a road of level 0 continues, "
    "clearance is the median height between the level and level 0. docs/levels.md explains the flags."
)
HOLDOUT = "A second fit left out these squares of road (`assess.holdout`); 90% intervals contain 90% of them."


@dataclass(frozen=True, eq=False)
class Content:
    """The tables of one run."""

    title: str
    state: str
    """Tiles done, failed, pending, in one line."""
    counts: Summary
    states: dict[str, TileState]
    """State of every tile by id, in the order of the catalog."""
    rows: pd.DataFrame
    """The rows of metrics.parquet."""
    variant: str
    """The variant that is exported first."""
    reference: str
    """The reference of the figures, in one paragraph."""
    tables: dict[str, tuple[pd.DataFrame, str]]
    """Table and explanation by title, in the order of the page; tables without figures are empty."""
    versions: dict[str, str]
    config: str
    tiles: tuple[str, ...]
    """Ids of the finished tiles, in the order of the catalog."""
    running: bool = False
    """Whether another process is computing tiles of the run."""
    results: Results = field(default_factory=dict)
    """Places of the finished tiles' surfaces in the store."""


def gather(run: Run, track: Track = untracked) -> Content:
    """Collect the tables of a run; if it is not finished, the tables of the tiles so far."""
    rows = _rows(run)
    done = rows[rows.status == "done"]
    states: dict[str, TileState] = {}
    results: Results = {}
    of_levels: list[dict[str, Any]] = []

    def keep(status: TileStatus, state: TileState) -> None:
        states[status.graph.tile.id] = state
        add_results(results, status)
        if status.done and status.last_record:
            of_levels.extend(level_rows(status.last_record.rows))

    counts = summary(run, track, keep)
    variants = [name for name in run.config.chains if name in set(done.variant)]
    exported = run.config.export.variants[0]
    failures = pd.DataFrame(
        [(f.tile_id, f.stage, f.kind, f.message, f.file) for f in counts.failures],
        columns=["tile", "stage", "error", "message", "file"],
    )
    steps, largest_steps, which = edge_steps(run, results, track)
    return Content(
        title=f"FlexRoad: {run.config.name} over {count(counts.tiles, 'tile')}",
        state=_state(counts),
        counts=counts,
        states=states,
        rows=rows,
        variant=exported,
        reference=_reference(run, set(done.tile_id)),
        tables={
            MAIN: (_over_tiles(done, variants, FIGURES, "mean"), ""),
            "Median over tiles": (_over_tiles(done, variants, FIGURES, "median"), ""),
            "Further figures, mean over tiles": (_over_tiles(done, variants, FURTHER, "mean"), ""),
            "Per stratum, mean over tiles": (_per_stratum(done, variants), ""),
            WORST_ROADS: (_worst(done, exported), ""),
            WORST_ESTIMATES: (highest_error_estimates(done, exported, WORST), ESTIMATE_MEANING),
            "Error estimates and height source, mean over tiles": (over_tiles(done, variants), ""),
            "Decks and tunnels": (decks_and_tunnels(of_levels, exported), DECKS_MEANING),
            HELD_OUT: (held_out(done, variants), HOLDOUT),
            MESHES: (mesh_checks(rows, run.config.chains), MESH_MEANING),
            STEPS: (steps, which),
            LARGEST_STEPS: (largest_steps.head(10), ""),
            "Failures": (failures, ""),
        },
        versions=run.versions,
        config=yaml.safe_dump(run.config.raw, sort_keys=False),
        tiles=tuple(dict.fromkeys(done.tile_id)),
        results=results,
        running=bool((holder := owner(run.path)) and exit_reason(holder) is None),
    )


def _rows(run: Run) -> pd.DataFrame:
    """Return the metrics: from metrics.parquet if the run has ended, else from the tiles finished so far."""
    if exists(run.path / METRICS):
        return read_metrics(run.path)
    with open_database(run) as database:
        records = [record for _, _, record in recorded(run, database) if record]
    return metrics_frame([row for record in records for row in record.rows])


def _state(counts: Summary) -> str:
    without = f" ({counts.without_roads} of them without roads)" if counts.without_roads else ""
    states = f"{counts.done} done{without}, {counts.failed} failed, {counts.pending} pending"
    return f"Tiles: {states}{counts.files_skipped}{counts.to_look_at}"


def _over_tiles(
    done: pd.DataFrame, variants: list[str], columns: dict[str, str], statistic: str
) -> pd.DataFrame:
    tiles = done.groupby("variant")
    table = tiles[list(columns)].agg(statistic).reindex(variants).rename(columns=columns)
    table.insert(0, "tiles", tiles.size().reindex(variants))
    # Tiles without road have no figures of roads (NaN). The statistic leaves them out.
    if done.l2_road_m.isna().any():
        table.insert(1, WITH_ROADS, tiles.l2_road_m.count().reindex(variants))
    return table.reset_index().rename(columns={"variant": "method"})


def _per_stratum(done: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    parts = [
        _over_tiles(part, variants, FIGURES, "mean").assign(stratum=stratum)
        for stratum, part in done.groupby("stratum")
        if stratum
    ]
    if not parts:
        return pd.DataFrame()
    table = pd.concat(parts, ignore_index=True)
    return table[["stratum", *table.columns.drop("stratum")]]


def _worst(done: pd.DataFrame, variant: str) -> pd.DataFrame:
    table = done[(done.variant == variant) & done.l2_road_m.notna()].nlargest(WORST, "l2_road_m")
    columns = {"tile_id": "tile"} | FIGURES | {"p95_road_m": FURTHER["p95_road_m"]}
    return table[list(columns)].rename(columns=columns)


def _reference(run: Run, done: set[str]) -> str:
    tiles = [tile for tile in run.catalog.tiles if tile.id in done]
    if not tiles:
        return "No tile is done."
    references = sum(tile.layer("reference") is not None for tile in tiles)
    roads = sum(tile.layer("reference_road") is not None for tile in tiles)
    heights = (
        "Heights are measured against the catalog's reference surface"
        if references == len(tiles)
        else f"{len(tiles) - references} of {len(tiles)} tiles have no reference surface: there heights are "
        "measured against the DTM (with the catalog's bridge decks), which also supports the fit, so that "
        "their terrain figures are optimistic"
    )
    segmented = any(chain["evaluate"].classes == "segmented" for chain in run.config.chains.values())
    classes = (
        "cells are classed as road or terrain by the raw segmented mask (evaluate.classes)"
        if segmented
        else "cells are classed as road or terrain by the catalog's reference road mask"
        if roads == len(tiles)
        else f"cells of {len(tiles) - roads} of {len(tiles)} tiles are classed as road or terrain by the raw "
        "segmented mask"
    )
    data = "; ".join(sorted({tile.dataset for tile in tiles if tile.dataset}))
    return f"{f'Data: {data}. ' if data else ''}{heights}; {classes}."


def mesh_checks(rows: pd.DataFrame, variants: Iterable[str]) -> pd.DataFrame:
    """Return one row per variant that has meshes, columns `MESH_COLUMNS`, from the rows of a run."""
    table = []
    for variant in variants:
        own = rows[rows.variant == variant]
        faces = own.triangles[own.status == "done"]
        faulty = int(own.error.fillna("").str.startswith(FAULT).sum())
        if meshes := len(faces) + faulty:
            result = f"error: {faulty} of {meshes} meshes have faults" if faulty else "no fault"
            table.append((variant, meshes, int(faces.sum()), faulty, result))
    return pd.DataFrame(table, columns=MESH_COLUMNS)


def over_tiles(done: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    """Return the means over tiles and the number of flagged tiles per variant; empty without estimates.

    A tile is not counted as flagged if its only flag is that it has no road.
    """
    if not done["error_estimate_m"].notna().any():
        return pd.DataFrame()
    table = done.groupby("variant")[[*ESTIMATES, *HEIGHT_SOURCE]].mean().reindex(variants)
    flagged = done["flags"].map(needs_look).groupby(done.variant).sum()
    table = _labelled(table)
    table.insert(0, "flagged tiles", flagged.reindex(variants))
    return table.reset_index().rename(columns={"variant": "method"})


def decks_and_tunnels(rows: list[dict[str, Any]], variant: str) -> pd.DataFrame:
    """Return one row per tile and level of a variant, rows with flags first; empty without levels."""
    own = [row for row in rows if row["variant"] == variant]
    if not own:
        return pd.DataFrame()
    table = pd.DataFrame(own)[list(DECKS)].sort_values("flags", key=lambda flags: flags == "", kind="stable")
    table = table.assign(measured_road=100 * table.measured_road.astype("float64"))
    return table.assign(flags=table["flags"].replace("", "–")).rename(columns=DECKS)


def held_out(done: pd.DataFrame, variants: list[str]) -> pd.DataFrame:
    """Return the errors of a second fit and its intervals at withheld squares; empty without such squares."""
    counted = done[done["holdout_squares"].fillna(0) > 0]
    if counted.empty:
        return pd.DataFrame()
    squares = counted["holdout_squares"]
    sums = pd.DataFrame(
        {
            "withheld squares": squares,
            "mean difference (m)": counted["holdout_error_m"] * squares,
            "within the 90% interval (%)": 100 * counted["holdout_covered"] * squares,
        }
    )
    table = sums.groupby(counted["variant"]).sum().reindex(variants).dropna()
    table.iloc[:, 1:] = table.iloc[:, 1:].div(table["withheld squares"], axis=0)
    table["withheld squares"] = table["withheld squares"].astype(int)
    return table.reset_index().rename(columns={"variant": "method"})


def highest_error_estimates(done: pd.DataFrame, variant: str, most: int) -> pd.DataFrame:
    """Return the tiles of a variant with the highest error estimate, highest first, with their flags."""
    table = done[(done.variant == variant) & done["error_estimate_m"].notna()].nlargest(
        most, "error_estimate_m"
    )
    result = _labelled(table[[*ESTIMATES, *HEIGHT_SOURCE]])
    result.insert(0, "tile", table.tile_id)
    places = table[["worst_easting", "worst_northing"]].itertuples(index=False)
    result["worst at (E / N)"] = [
        f"{east:.0f} / {north:.0f}" if math.isfinite(east) else "–" for east, north in places
    ]
    return result.assign(flags=table["flags"].replace("", "–"))


def _labelled(table: pd.DataFrame) -> pd.DataFrame:
    """Rename columns to their labels, and convert shares to percent."""
    names = ESTIMATES | HEIGHT_SOURCE
    shares = [name for name in names if "%" in names[name]]
    return table.assign(**{name: 100 * table[name] for name in shares}).rename(columns=names)
