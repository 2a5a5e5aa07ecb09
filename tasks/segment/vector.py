"""Step B of the paper, road extraction: M^r from vector areas, or from centre lines with a width."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flexroad.tasks.errors import TaskError
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.roads.mask_cleanup import NOTHING, Cleanup, clean
from flexroad.tasks.types import RoadMask, TileData

VERSION = 1
READS = ("roads",)


class Options(rasterise.Options):
    """Selection of the road features, widths of the lines, and cleanup of the mask."""

    method: Literal["vector"] = "vector"
    cleanup: Cleanup = Field(NOTHING, description="cleanup of the mask; none by default")


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the cells whose centre lies on a road of the catalog's vectors, with those on bridges flagged.

    Raises
    ------
    TaskError
        If the tile has no vectors, they cannot be read, or no cell of its core is road.
    """
    roads = rasterise.roads(data.roads, data.grid, options)
    mask = clean(rasterise.cells(roads.areas, data.grid), data, options.cleanup)
    if data.lacks_road(mask):
        files = ", ".join(path.name for path in data.roads.paths) if data.roads else ""
        raise TaskError(
            f"no road of {files} lies on this tile: leave the tile out, or check segment.layer, "
            "segment.where and segment.left_out",
            layer="roads",
        )
    return RoadMask(
        grid=data.grid,
        core=data.core,
        mask=mask,
        outside=beyond_extent(data),
        bridge=rasterise.cells(roads.areas[roads.bridge], data.grid) & mask,
        notes=roads.notes,
    )
