"""Height fields of the tiles, with the same steps of height for all, so that they fit together."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flexroad.catalog import Tile
from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.pieces import Piece, figures, write_pieces
from flexroad.pipeline.export.source import Options, Source
from flexroad.pipeline.run.finished import FinishedTile
from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import heightfield
from flexroad.tasks.export.heightfield import HeightField
from flexroad.tasks.spline.levelled import top_of

VERSION = heightfield.VERSION
SAME_M = 1e-3
"""Edges that differ by less are one (m)."""
SPACING_M = 1.0
"""Largest distance of nodes (m)."""
BEYOND = "nodes beyond the survey are flat, and holes in the mask"
NO_LIMITS = (math.nan, math.nan)


@dataclass(frozen=True)
class Lattice:
    """The lattice of square tiles of one size."""

    west: float
    north: float
    """Edges of the westernmost and of the northernmost tile (m)."""
    side_m: float

    @classmethod
    def of(cls, tiles: Sequence[Tile]) -> Lattice | None:
        """Return that of tiles; None if they have none, or two of them the same place."""
        bounds = np.array([tile.grid.exact_bounds for tile in tiles])
        sides = np.concatenate([bounds[:, 2] - bounds[:, 0], bounds[:, 3] - bounds[:, 1]])
        west, north, side = bounds[:, 0].min(), bounds[:, 3].max(), sides[0]
        steps = np.stack([bounds[:, 0] - west, north - bounds[:, 3]], axis=1) / side
        places = np.rint(steps)
        regular = np.ptp(sides) < SAME_M and np.abs(steps - places).max() * side < SAME_M
        distinct = len(np.unique(places, axis=0)) == len(tiles)
        return cls(float(west), float(north), float(side)) if regular and distinct else None

    def place(self, tile: Tile) -> tuple[int, int]:
        """Return column, from the west, and row, from the north, of a tile."""
        west, _, _, north = tile.grid.exact_bounds
        return round((west - self.west) / self.side_m), round((self.north - north) / self.side_m)


@dataclass(frozen=True)
class Scene:
    """What the fields of all tiles share."""

    vertical: str | None
    """Vertical CRS of the heights."""
    nodes: Literal["power", "unreal"]
    """Family of numbers of nodes."""
    limits: tuple[float, float] | None = None
    """Heights of the values 0 and 65535 (m); None: the lowest and highest of the field."""
    lattice: Lattice | None = None
    """That of the tiles, for the names of Unreal's files; None: files are named by the ids of tiles."""


def write_fields(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> dict[str, Any]:
    """Write the height field of each tile in several formats; return the figures of all.

    Raises
    ------
    ConfigError
        If a tile's results cannot be read, or it has no heights.
    """
    own = Scene(source.vertical, options.nodes)
    lattice = Lattice.of(source.tiles) if options.nodes == "unreal" else None
    scene = replace(own, limits=_common_limits(source, own, executor), lattice=lattice)
    return figures(write_pieces(tiles, folder, VERSION, piece, scene, executor))


def _common_limits(source: Source, scene: Scene, executor: Executor) -> tuple[float, float]:
    """Return whole metres below the lowest and above the highest node of all fields.

    With whole metres another tile rarely changes them, and the files of the others remain valid.
    """
    low, high = math.inf, -math.inf
    jobs = ((tile, scene) for tile in source.finished())
    for limits, failure in executor.map(_limits, jobs, _lost):
        if failure:
            raise ConfigError(failure)
        low, high = min(low, limits[0]), max(high, limits[1])
    return float(math.floor(low)), float(max(math.ceil(high), math.floor(low) + 1))


def _limits(job: tuple[FinishedTile, Scene]) -> tuple[tuple[float, float], str]:
    """Return the lowest and highest node of a tile, or the reason why it has none."""
    tile, scene = job
    try:
        field = _field(tile, scene)
    except ConfigError as error:
        return NO_LIMITS, str(error)
    except TaskError as error:
        return NO_LIMITS, f"{tile.label}: {error}"
    return (field.low, field.high), ""


def _lost(job: tuple[FinishedTile, Scene], reason: str) -> tuple[tuple[float, float], str]:
    return NO_LIMITS, f"{job[0].label}: {reason}"


def piece(tile: FinishedTile, scene: Scene) -> Piece:
    """Return the surface of a tile as height fields, with what engines must know as JSON."""
    field = _field(tile, scene)
    files = {
        heightfield.NAME_PNG: heightfield.encode_png(field),
        heightfield.NAME_HOLES: heightfield.encode_holes(field),
        heightfield.NAME_R16: heightfield.encode_r16(field),
        heightfield.NAME_MUJOCO: heightfield.encode_mujoco(field),
        heightfield.NAME_SIDECAR: heightfield.encode_sidecar(field, tile.tile.grid.crs, scene.vertical),
    }
    named = {_name(tile.tile, name, scene.lattice): data for name, data in files.items()}
    note = {"note": BEYOND} if np.isnan(field.heights).any() else {}
    return Piece(named, {"height_error_m": field.step_m / 2} | note)


def _name(tile: Tile, ending: str, lattice: Lattice | None) -> str:
    """Return the name of a file: Unreal finds the tiles of a landscape by column and row at its end."""
    if lattice is None:
        return f"{safe_name(tile.id)}{ending}"
    kind, column, row = Path(ending.removeprefix("_")), *lattice.place(tile)
    return f"{kind.stem}_x{column}_y{row}{kind.suffix}"


def _field(tile: FinishedTile, scene: Scene) -> HeightField:
    # Neighbours take the same positions for nodes on their edge.
    bounds = tile.tile.grid.exact_bounds
    size = heightfield.size_at_spacing(bounds, SPACING_M, scene.nodes)
    return heightfield.sampled(top_of(tile.surface), bounds, size, scene.limits, tile.road)
