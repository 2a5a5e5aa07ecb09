"""Step B of the paper, road extraction: M^r from an existing mask layer."""

from __future__ import annotations

from typing import Literal

from flexroad.tasks import options
from flexroad.tasks.errors import LayerMissing, TaskError
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.types import RoadMask, TileData

VERSION = 1


class Options(options.Options):
    """Use the catalog's road mask; there are no options."""

    method: Literal["mask"] = "mask"


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the road cells of the catalog's mask layer.

    Raises
    ------
    TaskError
        If the tile has no road mask, or no cell of its core is road.
    """
    if data.road_mask is None:
        raise LayerMissing(
            "no road mask layer in the catalog and none configured: "
            "give --road-mask to `flexroad catalog rasters`"
        )
    if data.lacks_road(data.road_mask):
        raise TaskError(
            "the road mask has no road cell on this tile: leave the tile out, or give the values that mean "
            "road with --road-value of `flexroad catalog rasters`",
            layer="road_mask",
        )
    return RoadMask(grid=data.grid, core=data.core, mask=data.road_mask, outside=beyond_extent(data))
