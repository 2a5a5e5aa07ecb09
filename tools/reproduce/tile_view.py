"""Data of one tile for the figures: its rasters, the results of the paper's methods, a vehicle's path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra

from flexroad.catalog import Grid
from flexroad.pipeline.config.models import Chain, Config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import peek_statuses
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.mesh_distance import drape
from flexroad.tasks.types import Bools, Floats, Mesh, Metrics

EIGHT = np.ones((3, 3), dtype=bool)
EDGE_COST = 8.0
"""Extra cost of a step near the road's edge: factor 1 + EDGE_COST / d^2 at d cells from the edge."""
SMOOTHING_CELLS = 3.0
"""Standard deviation of the Gaussian that smooths the path."""
STEP_CELLS = 0.5
"""Distance between the points of the path."""
SIDE = 0.5
"""Shift to the right, as a fraction of the distance from the middle of the road to its edge."""


Roles = dict[str, str]
"""Names of the variants by method: ``full``, the full pipeline, and ``plane``, ``rgt``, ``wo_nurbs`` and
``wo_ecsrc`` if the run has such a variant."""


def roles_of(config: Config) -> Roles:
    """Return the roles of a configuration's variants; FlexRoad is the first exported variant."""
    full = config.export.variants[0]
    roles = {"full": full}
    for name, chain in config.chains.items():
        if role := _role(chain, config.chains[full]):
            roles.setdefault(role, name)
    return roles


def _role(chain: Chain, full: Chain) -> str:
    """Return the role of a variant, or an empty string."""
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
    """Name of `truth` for captions: the reference surface, else the DTM."""
    street: Bools
    """Road cells: the catalog's reference road mask, else the filtered mask."""
    dropped: Bools
    """Cells of the segmented mask that the filter dropped."""
    results: dict[str, Result]
    """By role."""

    def error(self, role: str) -> Floats:
        """Return the absolute vertical distance of a mesh from `truth`, ``(H, W)``, m."""
        return np.abs(self.results[role].height - self.truth)

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
    try:
        return _view(FinishedTile.of(run, status, roles["full"]), roles)
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
        {role: _result(tile.in_variant(variant), core) for role, variant in roles.items()},
    )


def _result(tile: FinishedTile, core: Grid) -> Result:
    mesh = tile.mesh
    return Result(mesh, drape(mesh, core) + mesh.origin[2], mean_angles(mesh), tile.metrics)


def missing_roles(view: TileView, methods: Mapping[str, str]) -> str:
    """Return a message on methods without a variant in the run; empty if all methods have a variant.

    - `methods`: role of each method that a figure needs, by label.
    """
    missing = [label for label, role in methods.items() if role not in view.results]
    if not missing:
        return ""
    return f"the run has no variant for {' and '.join(missing)}; `--config ablation` has all variants"


def vehicle_trajectory(road: Bools) -> tuple[Floats, Floats]:
    """Return the path as rows and columns, `STEP_CELLS` apart; empty if there is no road.

    The path is the longest of all shortest paths (with a cost that keeps to the middle of the road) between
    two cells of the largest connected road. It is computed by two searches, the second from the far
    end of the first, which is exact on roads without loops. It is then moved to the right, halfway to the
    edge of the road.

    - `road`: road cells, ``(H, W)``.
    """
    if not road.any():
        return np.empty(0), np.empty(0)
    parts, _ = ndimage.label(road, EIGHT)
    road = parts == np.argmax(np.bincount(parts.ravel())[1:]) + 1
    # Padded, because roads continue beyond the tile.
    clear = ndimage.distance_transform_edt(np.pad(road, 16, mode="edge"))[16:-16, 16:-16]
    # Paths start and end in the middle of the road: at cells with the largest edge distance in 3 x 3 cells.
    middle = road & (clear == ndimage.maximum_filter(clear, 3))
    number = np.cumsum(road).reshape(road.shape) - 1
    graph = _steps(road, clear, number)
    ends = number[middle]
    start = ends[np.argmax(dijkstra(graph, directed=False, indices=ends[0])[ends])]
    cost, previous = dijkstra(graph, directed=False, indices=start, return_predecessors=True)
    path = [ends[np.argmax(cost[ends])]]
    while path[-1] != start:
        path.append(previous[path[-1]])
    middle_row, middle_col = (axis[path].astype(np.float64) for axis in np.nonzero(road))
    row, col = _smooth(*_to_the_right(middle_row, middle_col, SIDE * clear[road][path]))
    return _inside(row, col, road.shape)


def _steps(road: Bools, clear: Floats, number: np.ndarray) -> sparse.coo_array:
    """Return the graph of the steps between neighbouring road cells (8 neighbours) with their costs."""
    a, b, cost = [], [], []
    height, width = road.shape
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - down), slice(max(0, -right), width - max(0, right))
        there = slice(down, height), slice(max(0, right), width + min(0, right))
        both = road[here] & road[there]
        a.append(number[here][both])
        b.append(number[there][both])
        edge_distance = np.minimum(clear[here][both], clear[there][both])
        cost.append(np.hypot(down, right) * (1 + EDGE_COST / edge_distance**2))
    n = int(road.sum())
    return sparse.coo_array((np.concatenate(cost), (np.concatenate(a), np.concatenate(b))), shape=(n, n))


def _to_the_right(row: Floats, col: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Move a path to the right, at right angles to its direction, by a distance in cells."""
    if row.size < 2:
        return row, col
    # Smoothed, because the path from cell to cell has only eight directions.
    south, east = (
        np.gradient(ndimage.gaussian_filter1d(a, SMOOTHING_CELLS, mode="nearest")) for a in (row, col)
    )
    length = np.maximum(np.hypot(south, east), 1e-9)
    return row + distance * east / length, col - distance * south / length


def _inside(row: Floats, col: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Cut off the ends outside the tile, as on a road that leaves the tile at an angle."""
    last = shape[0] - 1, shape[1] - 1
    inside = np.flatnonzero((row >= 0) & (row <= last[0]) & (col >= 0) & (col <= last[1]))
    kept = slice(inside[0], inside[-1] + 1) if inside.size else slice(0)
    return row[kept].clip(0, last[0]), col[kept].clip(0, last[1])


def _smooth(row: Floats, col: Floats) -> tuple[Floats, Floats]:
    """Smooth the corners of a path and resample it at steps of `STEP_CELLS`."""
    row, col = (ndimage.gaussian_filter1d(axis, SMOOTHING_CELLS, mode="nearest") for axis in (row, col))
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(row), np.diff(col)))])
    at = np.arange(0.0, along[-1], STEP_CELLS)
    return np.interp(at, along, row), np.interp(at, along, col)
