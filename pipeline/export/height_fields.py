"""Height fields of the tiles, with the same steps of height for all, so that they fit together."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from flexroad.catalog.ids import safe_name
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.pieces import Piece, write_pieces
from flexroad.pipeline.export.source import FinishedTile, Source
from flexroad.tasks.errors import TaskError
from flexroad.tasks.export import heightfield
from flexroad.tasks.export.heightfield import HeightField

VERSION = heightfield.VERSION
SPACING_M = 1.0
"""Largest distance of nodes (m)."""


@dataclass(frozen=True)
class Scene:
    """What the fields of all tiles share."""

    vertical: str | None
    """Vertical CRS of the heights."""
    nodes: Literal["power", "unreal"]
    """Family of numbers of nodes."""
    limits: tuple[float, float] | None = None
    """Heights of the values 0 and 65535 (m); None: the lowest and highest of the field."""


def write_fields(
    source: Source, tiles: Iterable[FinishedTile], folder: Location, options: Options, executor: Executor
) -> None:
    """Write the height field of each tile in several formats.

    Raises
    ------
    ConfigError
        If a tile's results cannot be read, or it has no heights.
    """
    own = Scene(source.vertical, options.nodes)
    scene = Scene(own.vertical, own.nodes, _common_limits(source, own))
    for _ in write_pieces(tiles, folder, VERSION, piece, scene, executor):
        pass


def _common_limits(source: Source, scene: Scene) -> tuple[float, float]:
    """Return whole metres below the lowest and above the highest node of all fields.

    With whole metres another tile rarely changes them, and the files of the others remain valid.
    """
    low, high = math.inf, -math.inf
    for tile in source.finished():
        try:
            field = _field(tile, scene)
        except TaskError as error:
            raise ConfigError(f"tile {tile.id}: {error}") from error
        low, high = min(low, field.low), max(high, field.high)
    return float(math.floor(low)), float(max(math.ceil(high), math.floor(low) + 1))


def piece(tile: FinishedTile, scene: Scene) -> Piece:
    """Return the surface of a tile as height fields, with what engines must know as JSON."""
    field = _field(tile, scene)
    files = {
        heightfield.NAME_PNG: heightfield.encode_png(field),
        heightfield.NAME_R16: heightfield.encode_r16(field),
        heightfield.NAME_MUJOCO: heightfield.encode_mujoco(field),
        heightfield.NAME_SIDECAR: heightfield.encode_sidecar(field, tile.tile.grid.crs, scene.vertical),
    }
    return Piece({f"{safe_name(tile.id)}{name}": data for name, data in files.items()}, {})


def _field(tile: FinishedTile, scene: Scene) -> HeightField:
    # Neighbours take the same positions for nodes on their edge.
    bounds = tile.tile.grid.exact_bounds
    size = heightfield.size_at_spacing(bounds, SPACING_M, scene.nodes)
    return heightfield.sampled(tile.surface, bounds, size, scene.limits)
