"""Step B of the paper, road extraction: M^r from vectors, as areas or as centre lines with a width."""

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
    """Which features are roads, how wide they are, and how the mask is tidied."""

    method: Literal["vector"] = "vector"
    cleanup: Cleanup = Field(NOTHING, description="tidying of the mask; by default it is left as it is")


def segment(data: TileData, options: Options) -> RoadMask:
    """Return the cells whose centre is on a road of the catalog's vectors; those on bridges are flagged.

    Raises
    ------
    TaskError
        If the tile has no vectors, they cannot be used, or none of its cells is road.
    """
    found = rasterise.roads(data.roads, data.grid, options)
    burnt = rasterise.cells(found.areas, data.grid)
    mask = clean(burnt, data, options.cleanup)
    if not mask[data.grid.window(data.core)].any():
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
        bridge=rasterise.cells(found.areas[found.bridge], data.grid) & mask,
        notes=found.notes,
    )
