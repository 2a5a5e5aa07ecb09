"""What a report says, before it is a page: tables over the run's rows."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd
import yaml

from flexroad.pipeline.report.quality import most_doubtful, over_tiles
from flexroad.pipeline.report.steps import edge_steps
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import summary
from flexroad.pipeline.store.tables import read_metrics

FIGURES = {
    "l2_road_m": "L2 road (m)",
    "l2_terrain_m": "L2 terrain (m)",
    "mad_road_deg": "MAD road (°)",
    "mad_terrain_deg": "MAD terrain (°)",
    "triangles": "T",
}
"""The columns of the paper's Table I."""
BESIDE = {
    "rmse_road_m": "RMSE road (m)",
    "rmse_terrain_m": "RMSE terrain (m)",
    "nmad_road_m": "NMAD road (m)",
    "p95_road_m": "p95 road (m)",
    "completeness": "completeness",
    "seconds": "seconds",
}
WORST = 10


@dataclass(frozen=True, eq=False)
class Content:
    """The tables of one run."""

    title: str
    state: str
    """Tiles done, failed, pending, in one line."""
    reference: str
    """What the figures were measured against."""
    main: pd.DataFrame
    """Mean over tiles per variant: the paper's table."""
    median: pd.DataFrame
    beside: pd.DataFrame
    """Further figures, mean over tiles."""
    strata: pd.DataFrame
    """The main table per stratum; empty where the catalog names none."""
    worst: pd.DataFrame
    """Tiles with the highest road L2 of the exported variant."""
    trust: pd.DataFrame
    """What the surfaces tell of themselves, mean over tiles; empty for runs that did not ask them."""
    doubtful: pd.DataFrame
    """Tiles of the exported variant to look at first; needs no ground truth."""
    steps: pd.DataFrame
    """Height steps between neighbouring tiles."""
    steps_of: str
    """Which tiles that is about, if not all."""
    failures: pd.DataFrame
    versions: dict[str, str]
    config: str
    tiles: tuple[str, ...]
    """Ids of the finished tiles, in the catalog's order."""


def gather(run: Run) -> Content:
    """Collect the tables of a run.

    Raises
    ------
    ConfigError
        If the run has no rows yet.
    """
    rows = read_metrics(run.path)
    done = rows[rows.status == "done"]
    how = summary(run)
    steps, steps_of = edge_steps(run)
    variants = [name for name in run.config.chains if name in set(done.variant)]
    shown = run.config.export.variants[0]
    failures = pd.DataFrame(
        [(f.tile_id, f.stage, f.kind, f.message, f.file) for f in how.failures],
        columns=["tile", "stage", "error", "message", "file"],
    )
    return Content(
        title=f"FlexRoad: {run.config.name} over {how.tiles} tile{'s' * (how.tiles != 1)}",
        state=f"Tiles: {how.done} done, {how.failed} failed, {how.pending} pending",
        reference=_reference(run, set(done.tile_id)),
        main=_over_tiles(done, variants, FIGURES, "mean"),
        median=_over_tiles(done, variants, FIGURES, "median"),
        beside=_over_tiles(done, variants, BESIDE, "mean"),
        strata=_per_stratum(done, variants),
        worst=_worst(done, shown),
        trust=over_tiles(done, variants),
        doubtful=most_doubtful(done, shown, WORST),
        steps=steps,
        steps_of=steps_of,
        failures=failures,
        versions=run.versions,
        config=yaml.safe_dump(run.config.raw, sort_keys=False),
        tiles=tuple(dict.fromkeys(done.tile_id)),
    )


def _over_tiles(done: pd.DataFrame, variants: list[str], columns: dict[str, str], how: str) -> pd.DataFrame:
    table = done.groupby("variant")[list(columns)].agg(how).reindex(variants).rename(columns=columns)
    table.insert(0, "tiles", done.groupby("variant").size().reindex(variants))
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
    table = done[done.variant == variant].nlargest(WORST, "l2_road_m")
    columns = {"tile_id": "tile"} | FIGURES | {"p95_road_m": BESIDE["p95_road_m"]}
    return table[list(columns)].rename(columns=columns)


def _reference(run: Run, done: set[str]) -> str:
    tiles = [tile for tile in run.catalog.tiles if tile.id in done]
    if not tiles:
        return "No tile is done: there is nothing to measure."
    truth = sum(tile.layer("reference") is not None for tile in tiles)
    roads = sum(tile.layer("reference_road") is not None for tile in tiles)
    heights = (
        "Heights are measured against the catalog's reference surface"
        if truth == len(tiles)
        else f"Heights: {len(tiles) - truth} of {len(tiles)} tiles have no reference surface; "
        "their DTM stands in (with the bridge decks the catalog has), which also supports the fit, "
        "so their terrain figures are optimistic"
    )
    segmented = any(chain["evaluate"].classes == "segmented" for chain in run.config.chains.values())
    classes = (
        "cells are classed by the raw segmented mask (evaluate.classes)"
        if segmented
        else "cells are classed by the catalog's reference road mask"
        if roads == len(tiles)
        else f"cells of {len(tiles) - roads} of {len(tiles)} tiles are classed by the raw segmented mask"
    )
    data = "; ".join(sorted({tile.dataset for tile in tiles if tile.dataset}))
    return f"{f'Data: {data}. ' if data else ''}{heights}; {classes}."
