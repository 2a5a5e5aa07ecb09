"""One tile as the figures see it: its rasters, and what each variant made of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from flexroad.catalog import Grid
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.graph import TileGraph
from flexroad.pipeline.reproduce.figures.roles import Roles
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.pipeline.store.artefacts import ArtefactStore
from flexroad.pipeline.worker.evaluator import Evaluator, StageError
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.types import Bools, Floats, Mesh, Metrics, RoadClusters, RoadMask, TileData


@dataclass(frozen=True, eq=False)
class Result:
    """What a variant made of the tile."""

    mesh: Mesh
    height: Floats
    """Of the mesh at every cell centre, ``(H, W)``, m; NaN where it has none."""
    angles: Floats
    """Mean angle of each face to its neighbours, ``(F,)``, degrees."""
    metrics: Metrics
    """Its row in the run's table."""


@dataclass(frozen=True, eq=False)
class TileView:
    """One tile; all rasters on its core, ``(H, W)``."""

    tile_id: str
    stratum: str
    grid: Grid
    dsm: Floats
    truth: Floats
    """Heights that errors are measured against (m)."""
    against: str
    """What they are: the catalog's reference, or the DTM in its place."""
    street: Bools
    """Where vehicles drive: the true roads, or the filtered mask where they are not known."""
    dropped: Bools
    """Cells of the segmented mask that the filter took away."""
    results: dict[str, Result]
    """By variant."""

    def error(self, variant: str) -> Floats:
        """Return the vertical distance of a variant's mesh from the truth, ``(H, W)``, m."""
        return np.abs(self.results[variant].height - self.truth)

    def __str__(self) -> str:
        return f"Tile {self.tile_id}{f' ({self.stratum})' if self.stratum else ''}"


def typical_tile(done: pd.DataFrame, variant: str) -> str:
    """Return the id of the tile whose road L2 is the median of the variant's finished tiles."""
    table = done[(done.variant == variant) & done.l2_road_m.notna()].sort_values(["l2_road_m", "tile_id"])
    if table.empty:
        raise ConfigError(f"variant {variant} has no tile with a road; name a tile to draw with --tile")
    return str(table.tile_id.iloc[(len(table) - 1) // 2])


def read_tile_view(run: Run, tile_id: str, roles: Roles) -> TileView:
    """Read a tile's results from the store, and make those again that are not kept there.

    Raises
    ------
    CatalogError
        If the tile is unknown.
    ConfigError
        If a variant is, or a stage fails on the tile.
    """
    (tile,) = run.catalog.select([tile_id]).tiles
    (found,) = peek_statuses(run, [tile])
    graph = found.graph
    for variant in roles.names:
        if variant not in graph.variants:
            raise ConfigError(f"{run.path} has no variant {variant!r}; it has {', '.join(graph.variants)}")
    try:
        return _view(graph, Evaluator(graph, ArtefactStore(run.store)), roles)
    except StageError as error:
        raise ConfigError(f"tile {tile_id}: {error}; name another with --tile") from error


def _view(graph: TileGraph, pull: Evaluator, roles: Roles) -> TileView:
    made = graph.variants[roles.full]
    data: TileData = pull(made["load"])
    road: RoadMask = pull(made["segment"])
    clusters: RoadClusters = pull(made["ecsrc"])
    core, window = data.core, data.grid.window(data.core)
    street = clusters.mask if data.reference_road is None else data.reference_road
    return TileView(
        graph.tile.id,
        graph.tile.stratum,
        core,
        data.dsm[window],
        (data.dtm if data.reference is None else data.reference)[window],
        "the DTM" if data.reference is None else "the reference surface",
        street[window] & ~road.outside[window],
        (road.mask & ~clusters.mask)[window],
        {variant: _result(graph, pull, variant, core) for variant in roles.names},
    )


def _result(graph: TileGraph, pull: Evaluator, variant: str, core: Grid) -> Result:
    mesh: Mesh = pull(graph.variants[variant]["sample"])
    metrics: Metrics = pull(graph.variants[variant]["evaluate"])
    return Result(mesh, drape(mesh, core) + mesh.origin[2], mean_angles(mesh), metrics)


def missing_roles(parts: Iterable[tuple[str, str | None]]) -> str:
    """Return why a figure cannot be drawn: the parts no variant of the run plays; empty if there are none."""
    missing = [label for label, variant in parts if variant is None]
    return f"the run has no variant for {' and '.join(missing)}; `--config ablation` has" if missing else ""
