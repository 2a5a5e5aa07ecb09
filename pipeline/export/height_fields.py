"""Height fields of the tiles, with the same steps of height for all, so that they fit together."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

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

VERSION = heightfield.VERSION
SPACING_M = 1.0
"""Largest distance of nodes (m)."""
BEYOND = "nodes beyond the survey are flat, and holes in the mask"
NO_LIMITS = (math.nan, math.nan)


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
) -> dict[str, Any]:
    """Write the height field of each tile in several formats; return the figures of all.

    Raises
    ------
    ConfigError
        If a tile's results cannot be read, or it has no heights.
    """
    own = Scene(source.vertical, options.nodes)
    scene = Scene(own.vertical, own.nodes, _common_limits(source, own, executor))
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
    named = {f"{safe_name(tile.id)}{name}": data for name, data in files.items()}
    note = {"note": BEYOND} if np.isnan(field.heights).any() else {}
    return Piece(named, {"height_error_m": field.step_m / 2} | note)


def _field(tile: FinishedTile, scene: Scene) -> HeightField:
    # Neighbours take the same positions for nodes on their edge.
    bounds = tile.tile.grid.exact_bounds
    size = heightfield.size_at_spacing(bounds, SPACING_M, scene.nodes)
    return heightfield.sampled(tile.surface, bounds, size, scene.limits, tile.road)
