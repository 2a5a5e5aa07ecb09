"""The data of one tile that the figures show: its rasters, and the results of the paper's methods."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from flexroad.catalog import Grid
from flexroad.pipeline.config.models import Chain, Config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.types import Bools, Floats, Mesh, Metrics


@dataclass(frozen=True)
class Roles:
    """Names of the variants by method; None if the run has no such variant."""

    full: str
    """FlexRoad, the full pipeline, which the others are compared with."""
    plane: str | None = None
    rgt: str | None = None
    wo_nurbs: str | None = None
    wo_ecsrc: str | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all variants in use."""
        names = (self.full, self.plane, self.rgt, self.wo_nurbs, self.wo_ecsrc)
        return tuple(name for name in names if name is not None)


def roles_of(config: Config) -> Roles:
    """Return the roles of a configuration's variants; FlexRoad is the first exported variant."""
    full = config.export.variants[0]
    roles: dict[str, str] = {}
    for name, chain in config.chains.items():
        role = _role(chain, config.chains[full])
        if role:
            roles.setdefault(role, name)
    return Roles(full, **roles)


def _role(chain: Chain, full: Chain) -> str:
    """Return the name of the field of `Roles` for a variant, or an empty string."""
    fit = chain["fit"].model_dump()
    if fit["method"] == "plane":
        return "plane"
    if fit["method"] == "raster" and fit["road"] == "dsm":
        return {"dsm": "rgt", "dtm": "wo_nurbs"}[fit["terrain"]]
    return "wo_ecsrc" if changes(chain, full) == {"ecsrc.method"} else ""


def changes(chain: Chain, full: Chain) -> set[str]:
    """Return the options in which a variant differs from the full pipeline, each as ``stage.option``.

    For a stage with another method, that is ``stage.method`` only: options of two methods cannot be compared.
    """
    changed = set()
    for stage, options in chain.items():
        own, other = options.model_dump(), full[stage].model_dump()
        if own.get("method") != other.get("method"):
            changed.add(f"{stage}.method")
        else:
            changed |= {f"{stage}.{key}" for key in own if own[key] != other[key]}
    return changed


@dataclass(frozen=True, eq=False)
class Result:
    """The result of one variant on the tile."""

    mesh: Mesh
    height: Floats
    """Height of the mesh at every cell centre, ``(H, W)``, m; NaN outside the mesh."""
    angles: Floats
    """Mean angle of each face to its neighbours, ``(F,)``, degrees."""
    metrics: Metrics
    """The variant's row in the run's table."""


@dataclass(frozen=True, eq=False)
class TileView:
    """One tile with its results; all rasters cover its core, ``(H, W)``."""

    tile_id: str
    stratum: str
    grid: Grid
    dsm: Floats
    truth: Floats
    """Heights that errors are measured against (m)."""
    against: str
    """Name of `truth` for captions: the reference surface, or the DTM if there is none."""
    street: Bools
    """Road cells: the catalog's reference road mask, or the filtered mask if there is none."""
    dropped: Bools
    """Cells of the segmented mask that the filter dropped."""
    results: dict[str, Result]
    """By variant."""

    def error(self, variant: str) -> Floats:
        """Return the absolute vertical distance of a variant's mesh from `truth`, ``(H, W)``, m."""
        return np.abs(self.results[variant].height - self.truth)

    def __str__(self) -> str:
        return f"Tile {self.tile_id}{f' ({self.stratum})' if self.stratum else ''}"


def typical_tile(done: pd.DataFrame, variant: str) -> str:
    """Return the id of the finished tile with the variant's median road L2."""
    table = done[(done.variant == variant) & done.l2_road_m.notna()].sort_values(["l2_road_m", "tile_id"])
    if table.empty:
        raise ConfigError(f"variant {variant} has no tile with a road; give the tile to draw with --tile")
    return str(table.tile_id.iloc[(len(table) - 1) // 2])


def read_tile_view(run: Run, tile_id: str, roles: Roles) -> TileView:
    """Read a tile's results from the store; results that are not stored are recomputed."""
    (tile,) = run.catalog.select([tile_id]).tiles
    (status,) = peek_statuses(run, [tile])
    graph = status.graph
    for variant in roles.names:
        if variant not in graph.variants:
            raise ConfigError(f"{run.path} has no variant {variant!r}; it has {', '.join(graph.variants)}")
    try:
        return _view(FinishedTile.of(run, status, roles.full), roles)
    except ConfigError as error:
        raise ConfigError(f"{error}; choose another tile with --tile") from error


def _view(tile: FinishedTile, roles: Roles) -> TileView:
    data, road, clusters = tile.data, tile.road, tile.clusters
    core, window = data.core, data.grid.window(data.core)
    street = clusters.mask if data.reference_road is None else data.reference_road
    return TileView(
        tile.id,
        tile.tile.stratum,
        core,
        data.dsm[window],
        (data.dtm if data.reference is None else data.reference)[window],
        "the DTM" if data.reference is None else "the reference surface",
        street[window] & ~road.outside[window],
        (road.mask & ~clusters.mask)[window],
        {variant: _result(tile.in_variant(variant), core) for variant in roles.names},
    )


def _result(tile: FinishedTile, core: Grid) -> Result:
    mesh = tile.mesh
    return Result(mesh, drape(mesh, core) + mesh.origin[2], mean_angles(mesh), tile.metrics)


def missing_roles(methods: Iterable[tuple[str, str | None]]) -> str:
    """Return which methods have no variant in the run, as a message; empty if all have one.

    - `methods`: label and variant of each method that a figure needs.
    """
    missing = [label for label, variant in methods if variant is None]
    if not missing:
        return ""
    return f"the run has no variant for {' and '.join(missing)}; `--config ablation` has all variants"
